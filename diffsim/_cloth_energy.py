"""What stretching, shearing and bending cloth costs: the energy of csrc/dynamics/cloth_elasticity.hpp, in plain torch.

Differentiable as often as one likes, and slow: for measurements, and to hold the core's derivatives against.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from . import _core
from ._mass_properties import FloatArray
from ._packed import PackedScene

# Sine of the warp's angle with a triangle's normal below which another axis takes its place, as in the core.
_LEAST_WARP_SINE = 0.1


@dataclass(frozen=True, eq=False)
class ClothElements:
    """Nodes, triangles and hinges of all cloths of a scene, and which cloth each belongs to."""

    node_area: Tensor  #: a third of the area of the triangles around, at rest, shape (n,) [m²]
    node_cloth: Tensor  #: shape (n,)
    free: Tensor  #: 1 for nodes that are not pinned, 0 for those that are, float64, shape (n,)
    triangles: Tensor  #: nodes, shape (t, 3)
    rest_inverse: Tensor  #: of [x1 - x0, x2 - x0] in material coordinates (warp, weft), shape (t, 2, 2) [1/m]
    area: Tensor  #: at rest, shape (t,) [m²]
    triangle_cloth: Tensor  #: shape (t,)
    hinges: Tensor  #: nodes: ends of the shared edge, then the corners across from it, shape (h, 4)
    rest_angle: Tensor  #: shape (h,) [rad]
    weight: Tensor  #: of each by itself (csrc/model/hinge_weights.hpp), shape (h,)
    couplings: Tensor  #: pairs of hinges, shape (k, 2)
    coupling_weight: Tensor  #: shape (k,)
    hinge_cloth: Tensor  #: shape (h,)
    poisson: Tensor  #: of each cloth, shape (c,)


def cloth_elements(packed: PackedScene, model: _core.Model) -> ClothElements:
    """Everything that follows from the rest shapes; the hinges are the model's own."""
    cloths = np.arange(len(packed.cloth_names))
    first_node = np.cumsum(packed.node_count) - packed.node_count
    triangle_cloth = np.repeat(cloths, packed.triangle_count)
    triangles = packed.triangles.astype(np.int64) + first_node[triangle_cloth, None]
    corners = packed.node_rest[triangles]
    edges = corners[:, 1:] - corners[:, :1]
    normal = np.cross(edges[:, 0], edges[:, 1])
    double_area = np.linalg.norm(normal, axis=1)
    normal /= double_area[:, None]
    warp, weft = _material_axes(normal, packed.warp[triangle_cloth])
    shape = np.stack([np.einsum("ti,tki->tk", warp, edges), np.einsum("ti,tki->tk", weft, edges)], axis=1)
    hinges, rest_angle, weight, couplings, coupling_weight = model.hinges()
    area = 0.5 * double_area
    node_area = np.bincount(triangles.ravel(), weights=np.repeat(area / 3.0, 3), minlength=len(packed.node_rest))
    node_cloth = np.repeat(cloths, packed.node_count)
    return ClothElements(
        node_area=torch.from_numpy(node_area),
        node_cloth=torch.from_numpy(node_cloth),
        free=torch.from_numpy(1.0 - packed.pinned),
        triangles=torch.from_numpy(triangles),
        rest_inverse=torch.from_numpy(np.linalg.inv(shape)),
        area=torch.from_numpy(area),
        triangle_cloth=torch.from_numpy(triangle_cloth),
        hinges=torch.from_numpy(hinges),
        rest_angle=torch.from_numpy(rest_angle),
        weight=torch.from_numpy(weight),
        couplings=torch.from_numpy(couplings),
        coupling_weight=torch.from_numpy(coupling_weight),
        hinge_cloth=torch.from_numpy(node_cloth[hinges[:, 0]]),
        poisson=torch.from_numpy(packed.cloth_poisson),
    )


def _material_axes(normal: FloatArray, warp: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Warp projected onto each triangle's plane, and weft = normal x warp, unit vectors, shape (t, 3)."""
    sine = np.linalg.norm(np.cross(normal, warp), axis=1)
    other = np.eye(3)[np.abs(warp).argmin(axis=1)]
    warp = np.where(sine[:, None] < _LEAST_WARP_SINE, other, warp)
    along = warp - normal * np.einsum("ti,ti->t", normal, warp)[:, None]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return along, np.cross(normal, along)


def dihedral_angle(x: Tensor, hinges: Tensor) -> Tensor:
    """Angle between the two triangles of each hinge, 0 where flat, in (-π, π]: (..., n, 3) -> (..., h) [rad]."""
    p0, p1, a, b = (x.index_select(-2, hinges[:, k]) for k in range(4))
    edge = p1 - p0
    normal_a, normal_b = torch.linalg.cross(edge, a - p0), torch.linalg.cross(b - p0, edge)
    sine = (torch.linalg.cross(normal_a, normal_b) * edge).sum(-1) / torch.linalg.vector_norm(edge, dim=-1)
    return torch.atan2(sine, (normal_a * normal_b).sum(-1))


def green_strain(x: Tensor, elements: ClothElements) -> Tensor:
    """ε = ½ (FᵀF - 1) of each triangle as ε11, ε22, ε12: (..., n, 3) -> (..., t, 3)."""
    x0, x1, x2 = (x.index_select(-2, elements.triangles[:, k]) for k in range(3))
    F = torch.stack([x1 - x0, x2 - x0], dim=-1) @ elements.rest_inverse
    strain = 0.5 * (F.mT @ F - torch.eye(2, dtype=x.dtype, device=x.device))
    return torch.stack([strain[..., 0, 0], strain[..., 1, 1], strain[..., 0, 1]], dim=-1)


def membrane_energy(strain: Tensor, elements: ClothElements, stretch: Tensor, shear: Tensor) -> Tensor:
    """Σ area (½ E/(1 - ν²) (ε11² + ε22² + 2 ν ε11 ε22) + ½ G (2 ε12)²), (..., t, 3) -> (...) [J]."""
    e11, e22, e12 = strain.unbind(-1)
    nu = elements.poisson
    c = (stretch / (1.0 - nu * nu)).index_select(-1, elements.triangle_cloth)
    nu, G = nu[elements.triangle_cloth], shear.index_select(-1, elements.triangle_cloth)
    density = 0.5 * c * (e11 * e11 + e22 * e22 + 2.0 * nu * e11 * e22) + 2.0 * G * e12 * e12
    return (density * elements.area).sum(-1)


def bending_energy(angle: Tensor, elements: ClothElements, bend: Tensor) -> Tensor:
    """Σ ½ bend W_ij (θ_i - θ0_i) (θ_j - θ0_j), differences the shorter way round, (..., h) -> (...) [J]."""
    turn = angle - elements.rest_angle
    turn = turn - 2.0 * torch.pi * torch.ceil(turn.detach() / (2.0 * torch.pi) - 0.5)  # into (-π, π]
    first, second = elements.couplings.unbind(-1)
    bend = bend.index_select(-1, elements.hinge_cloth)
    alone = 0.5 * bend * elements.weight * turn * turn
    coupled = bend.index_select(-1, first) * elements.coupling_weight
    coupled = coupled * turn.index_select(-1, first) * turn.index_select(-1, second)
    return alone.sum(-1) + coupled.sum(-1)


def elastic_energy(x: Tensor, elements: ClothElements, stretch: Tensor, shear: Tensor, bend: Tensor) -> Tensor:
    """Of all cloths with nodes at x, (..., n, 3) -> (...) [J], without what damping makes of it during a step."""
    membrane = membrane_energy(green_strain(x, elements), elements, stretch, shear)
    return membrane + bending_energy(dihedral_angle(x, elements.hinges), elements, bend)


def node_mass(elements: ClothElements, density: Tensor) -> Tensor:
    """Of nodes that are not pinned; 0 for the others, as for kinematic bodies. (c,) -> (n,) [kg]."""
    return density.index_select(-1, elements.node_cloth) * elements.node_area * elements.free
