"""Energies, momenta and frames of a state, and bodies put by their frames, as differentiable torch expressions.

All are float64 inside. Mass and inertia of static and kinematic bodies are zero, as is `node_mass` (n_nodes,) [kg] of
pinned nodes, so that sums are over what moves freely. Without cloth `node_mass` is None.
"""

from __future__ import annotations

import torch
from torch import Tensor

from .rotation import rotate, to_matrix
from .state import State

_F64 = torch.float64


def _spin(state: State, inertia: Tensor) -> Tensor:
    """I(R) ω = R I_b Rᵀ ω  [kg·m²/s], (..., n_bodies, 3)"""
    R = to_matrix(state.orientation.to(_F64))
    w_body = R.mT @ state.angular_velocity.to(_F64).unsqueeze(-1)
    return (R @ (inertia.to(_F64) @ w_body)).squeeze(-1)


def kinetic_energy(state: State, mass: Tensor, inertia: Tensor, node_mass: Tensor | None) -> Tensor:
    velocity, w = state.velocity.to(_F64), state.angular_velocity.to(_F64)
    twice = (mass.to(_F64) * velocity.square().sum(-1) + (w * _spin(state, inertia)).sum(-1)).sum(-1)
    if node_mass is not None:
        twice = twice + (node_mass * state.node_velocity.to(_F64).square().sum(-1)).sum(-1)
    return twice.div(2).to(state.dtype)


def gravitational_energy(state: State, mass: Tensor, gravity: Tensor, node_mass: Tensor | None) -> Tensor:
    """Float64, whatever the state is."""
    g = gravity.to(_F64).unsqueeze(-2)
    fallen = (mass.to(_F64) * (state.position.to(_F64) * g).sum(-1)).sum(-1)
    if node_mass is not None:
        fallen = fallen + (node_mass * (state.node_position.to(_F64) * g).sum(-1)).sum(-1)
    return -fallen


def momentum(state: State, mass: Tensor, node_mass: Tensor | None) -> Tensor:
    total = (mass.to(_F64).unsqueeze(-1) * state.velocity.to(_F64)).sum(-2)
    if node_mass is not None:
        total = total + (node_mass.unsqueeze(-1) * state.node_velocity.to(_F64)).sum(-2)
    return total.to(state.dtype)


def angular_momentum(state: State, mass: Tensor, inertia: Tensor, node_mass: Tensor | None) -> Tensor:
    orbital: Tensor = torch.linalg.cross(state.position.to(_F64), mass.to(_F64).unsqueeze(-1) * state.velocity.to(_F64))
    total = (orbital + _spin(state, inertia)).sum(-2)
    if node_mass is not None:
        impulse = node_mass.unsqueeze(-1) * state.node_velocity.to(_F64)
        total = total + torch.linalg.cross(state.node_position.to(_F64), impulse).sum(-2)
    return total.to(state.dtype)


def _frames(R: Tensor, origin: Tensor) -> Tensor:
    top = torch.cat((R, origin.unsqueeze(-1)), dim=-1)
    bottom = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=_F64, device="cpu").expand(*R.shape[:-2], 1, 4)
    return torch.cat((top, bottom), dim=-2)


def pose_matrix(state: State) -> Tensor:
    """Body frames (origin at the centre of mass) to world, float64, (..., n_bodies, 4, 4)."""
    return _frames(to_matrix(state.orientation.to(_F64)), state.position.to(_F64))


def mesh_transform(state: State, mesh_offset: Tensor) -> Tensor:
    R = to_matrix(state.orientation.to(_F64))
    origin = state.position.to(_F64) - (R @ mesh_offset.unsqueeze(-1)).squeeze(-1)
    return _frames(R, origin).to(state.dtype)


def placed(
    state: State,
    body: int,
    mesh_offset: Tensor,
    leading: torch.Size,
    position: Tensor | None,
    orientation: Tensor | None,
) -> State:
    """The state, with these leading axes, in which the mesh's frame of one body is at position and orientation; None
    keeps what there is. `mesh_offset`: its centre of mass in that frame, (3,).
    """
    q, center = state.orientation[..., body, :].to(_F64), state.position[..., body, :].to(_F64)
    origin = center - rotate(q, mesh_offset) if position is None else position.to(_F64)
    rows: dict[str, Tensor] = {}
    if orientation is not None:
        q = orientation.to(_F64)
        q = rows["orientation"] = q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)
    rows["position"] = origin + rotate(q, mesh_offset)
    fields = {name: t.expand(*leading, *t.shape[-2:]) for name, t in state.__dict__.items()}
    for name, row in rows.items():
        old = fields[name]
        new = row.to(state.dtype).expand(*leading, row.shape[-1]).unsqueeze(-2)
        fields[name] = torch.cat([old[..., :body, :], new, old[..., body + 1 :, :]], dim=-2)
    return State._make(**fields)


def world_vertices(state: State, vertices: Tensor, body_of_vertex: Tensor) -> Tensor:
    """World positions R p + t of the vertices p of all bodies: (n_vertices, 3) -> (..., n_vertices, 3)."""
    R = to_matrix(state.orientation.to(_F64)).index_select(-3, body_of_vertex)
    t = state.position.to(_F64).index_select(-2, body_of_vertex)
    return ((R @ vertices.unsqueeze(-1)).squeeze(-1) + t).to(state.dtype)
