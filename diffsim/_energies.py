"""Energies, momenta and frames of a state, as differentiable torch expressions, float64 inside.

Mass and inertia of static and kinematic bodies are zero, so that sums over bodies are over the dynamic ones.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .rotation import to_matrix
from .state import State

_F64 = torch.float64


def _spin(state: State, inertia: Tensor) -> Tensor:
    """I(R) ω = R I_b Rᵀ ω  [kg·m²/s], (..., n_bodies, 3)"""
    R = to_matrix(state.orientation.to(_F64))
    w_body = R.mT @ state.angular_velocity.to(_F64).unsqueeze(-1)
    return (R @ (inertia.to(_F64) @ w_body)).squeeze(-1)


def kinetic_energy(state: State, mass: Tensor, inertia: Tensor) -> Tensor:
    velocity, w = state.velocity.to(_F64), state.angular_velocity.to(_F64)
    twice = mass.to(_F64) * velocity.square().sum(-1) + (w * _spin(state, inertia)).sum(-1)
    return twice.sum(-1).div(2).to(state.dtype)


def potential_energy(state: State, mass: Tensor, gravity: Tensor) -> Tensor:
    height = (state.position.to(_F64) * gravity.to(_F64).unsqueeze(-2)).sum(-1)
    return -(mass.to(_F64) * height).sum(-1).to(state.dtype)


def momentum(state: State, mass: Tensor) -> Tensor:
    return (mass.to(_F64).unsqueeze(-1) * state.velocity.to(_F64)).sum(-2).to(state.dtype)


def angular_momentum(state: State, mass: Tensor, inertia: Tensor) -> Tensor:
    orbital: Tensor = torch.linalg.cross(state.position.to(_F64), mass.to(_F64).unsqueeze(-1) * state.velocity.to(_F64))
    return (orbital + _spin(state, inertia)).sum(-2).to(state.dtype)


def _frames(R: Tensor, origin: Tensor) -> Tensor:
    top = torch.cat((R, origin.unsqueeze(-1)), dim=-1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=_F64).expand(*R.shape[:-2], 1, 4)
    return torch.cat((top, bottom), dim=-2)


def pose_matrix(state: State) -> Tensor:
    """Body frames (origin at the centre of mass) to world, float64, (..., n_bodies, 4, 4)."""
    return _frames(to_matrix(state.orientation.to(_F64)), state.position.to(_F64))


def mesh_transform(state: State, mesh_offset: Tensor) -> Tensor:
    R = to_matrix(state.orientation.to(_F64))
    origin = state.position.to(_F64) - (R @ mesh_offset.unsqueeze(-1)).squeeze(-1)
    return _frames(R, origin).to(state.dtype)


def world_vertices(state: State, vertices: Tensor, body_of_vertex: Tensor) -> Tensor:
    """World positions R p + t of the vertices p of all bodies: (n_vertices, 3) -> (..., n_vertices, 3)."""
    R = to_matrix(state.orientation.to(_F64)).index_select(-3, body_of_vertex)
    t = state.position.to(_F64).index_select(-2, body_of_vertex)
    return ((R @ vertices.unsqueeze(-1)).squeeze(-1) + t).to(state.dtype)
