"""Geometry of one cloth, from what a user gives: mesh, rest shape, warp direction and pinned nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._arguments import finite_array
from ._mass_properties import FloatArray, IntArray
from ._mesh import check_triangles, read_mesh_in_order, to_numpy

# A triangle lower than this fraction of its longest edge, at rest, has no strain worth the name (csrc/model/cloth.cpp).
_LEAST_HEIGHT = 1e-6
# The warp's direction must not be shorter than this, or it is a mistake rather than a direction.
_SHORTEST_DIRECTION = 1e-12


@dataclass(frozen=True)
class ClothShape:
    """Geometry in the frame of the mesh as given: node i is vertex i."""

    vertices: FloatArray  #: where the nodes start, shape (n, 3) [m]
    rest: FloatArray  #: where nothing is strained or bent, shape (n, 3) [m]
    triangles: IntArray  #: shape (m, 3)
    warp: FloatArray  #: unit vector in the frame of `rest`, shape (3,)
    pinned: NDArray[np.uint8]  #: 1 for nodes that move as told, shape (n,)
    smallest_height: float  #: of the triangles, at rest or at the start, over their longest edge [m]


def cloth_shape(mesh: Any, rest: Any, warp: Any, pinned: Any, where: str) -> ClothShape:
    """Check everything that is given.

    Raises: TypeError, ValueError naming the object, what is wrong, and the mend.
    """
    vertices, triangles = read_mesh_in_order(mesh, where)
    _require_sheet(vertices, triangles, where)
    at_rest = vertices.copy()
    if rest is not None:
        at_rest = finite_array(rest, f"{where}: rest", vertices.shape)
    what = f"{where}: {'mesh' if rest is None else 'rest shape'}"
    check_triangles(at_rest, triangles, what, "give it some height", least_height=_LEAST_HEIGHT)
    direction = np.array([1.0, 0.0, 0.0]) if warp is None else finite_array(warp, f"{where}: warp", (3,))
    length = float(np.linalg.norm(direction))
    if length < _SHORTEST_DIRECTION:
        raise ValueError(f"{where}: warp must be a direction, got {direction.tolist()}; along x is (1, 0, 0)")
    return ClothShape(
        vertices=vertices,
        rest=at_rest,
        triangles=triangles,
        warp=direction / length,
        pinned=_pinned_nodes(pinned, len(vertices), where),
        smallest_height=min(_smallest_height(points[triangles]) for points in (vertices, at_rest)),
    )


def _require_sheet(vertices: FloatArray, triangles: IntArray, where: str) -> None:
    """Every vertex in some triangle and at a place of its own; every edge with one triangle or two, all different."""
    used = np.zeros(len(vertices), dtype=bool)
    used[triangles] = True
    if not used.all():
        first = int(np.argmin(used))
        raise ValueError(
            f"{where}: mesh vertex {first} is in no triangle ({np.count_nonzero(~used)} of {len(vertices)} vertices), "
            "and every vertex becomes a node; remove such vertices (trimesh: mesh.remove_unreferenced_vertices())"
        )
    _, index, place = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)
    first_there = index[place.reshape(-1)]
    repeated = first_there != np.arange(len(vertices))
    if repeated.any():
        second = int(np.argmax(repeated))
        raise ValueError(
            f"{where}: mesh vertices {first_there[second]} and {second} are at the same place, "
            f"{vertices[second].tolist()} ({np.count_nonzero(repeated)} vertices repeat another's place); merge them "
            "(trimesh: mesh.merge_vertices()) or, where the cloth is slit, move them apart"
        )
    corners = np.sort(triangles, axis=1)
    _, index, place = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    first_there = index[place.reshape(-1)]
    repeated = first_there != np.arange(len(triangles))
    if repeated.any():
        second = int(np.argmax(repeated))
        raise ValueError(
            f"{where}: mesh triangles {first_there[second]} and {second} have the same corners, "
            f"{corners[second].tolist()}; remove one (trimesh: mesh.update_faces(mesh.unique_faces()))"
        )
    edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    if (count > 2).any():
        first = int(np.argmax(count > 2))
        raise ValueError(
            f"{where}: the mesh is not a sheet: {count[first]} triangles meet at the edge of vertices "
            f"{unique[first].tolist()} ({np.count_nonzero(count > 2)} such edges), and a cloth has at most two there; "
            "remove the others, or add them as a cloth of their own"
        )


def _pinned_nodes(pinned: Any, count: int, where: str) -> NDArray[np.uint8]:
    """A mask from indices, in any order and repeated or not, or from a mask."""
    mask = np.zeros(count, dtype=np.uint8)
    if pinned is None:
        return mask
    given = to_numpy(pinned, f"{where}: pinned")
    if given.size == 0 and given.dtype.kind != "b":  # an empty list has a dtype of its own
        return mask
    if given.ndim != 1 or given.dtype.kind not in "iub":
        got = f"shape {given.shape}" if given.ndim != 1 else f"dtype {given.dtype}"
        raise TypeError(f"{where}: pinned must be a list of node indices or one boolean per node, got {got}")
    if given.dtype.kind == "b":
        if len(given) != count:
            raise ValueError(f"{where}: pinned must have one boolean per node, {count}, got {len(given)}")
        mask[given] = 1
        return mask
    outside = (given < 0) | (given >= count)
    if outside.any():
        raise ValueError(
            f"{where}: pinned node {given[np.argmax(outside)]} is out of range: the cloth has {count} nodes, 0 to "
            f"{count - 1}"
        )
    mask[given] = 1
    return mask


def _smallest_height(corners: FloatArray) -> float:
    """The smallest height of any of the triangles (m, 3, 3): nearest distance of a corner to the edge across [m]."""
    edges = np.roll(corners, -1, axis=1) - corners
    double_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    return float((double_area / np.linalg.norm(edges, axis=2).max(axis=1)).min())
