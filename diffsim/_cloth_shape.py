"""Geometry of one cloth, from what a user gives: mesh, rest shape, warp direction and pinned nodes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._arguments import finite_array
from ._mass_properties import FloatArray, IntArray
from ._mesh import check_triangles, find_repeated, read_mesh_in_order, to_numpy
from ._mesh_queries import point_triangle_distance, segment_segment_distance

# A triangle lower than this fraction of its longest edge, at rest, has no strain worth the name (csrc/model/cloth.cpp).
_LEAST_HEIGHT = 1e-6
# The warp's direction must not be shorter than this, or it is a mistake rather than a direction.
_SHORTEST_DIRECTION = 1e-12
# A vertex nearer to a triangle than this fraction of its longest edge lies on it, up to the rounding of files that keep
# single precision.
_TOUCHING = 1e-6
_CELLS_A_BOX = 16  # that a triangle covers on average at most, while looking for vertices near it

Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ClothShape:
    """Geometry in the frame of the mesh as given: node i is vertex i."""

    vertices: FloatArray  #: where the nodes start, shape (n, 3) [m]
    rest: FloatArray  #: where nothing is strained or bent, shape (n, 3) [m]
    triangles: IntArray  #: shape (m, 3)
    warp: FloatArray  #: unit vector in the frame of `rest`, shape (3,)
    pinned: NDArray[np.uint8]  #: 1 for nodes that move as told, shape (n,)
    smallest_height: float  #: of the triangles, at rest or at the start, over their longest edge [m]


def cloth_shape(mesh: Any, rest: Any, warp: Any, pinned: Any, scale: float, where: str) -> ClothShape:
    """Check everything that is given.

    Raises: TypeError, ValueError naming the object, what is wrong, and the mend.
    """
    vertices, triangles = read_mesh_in_order(mesh, where)
    _require_sheet(vertices, triangles, where)
    vertices *= scale
    at_rest = vertices.copy()
    if rest is not None:
        at_rest = scale * finite_array(rest, f"{where}: rest", vertices.shape)
    what = f"{where}: {'mesh' if rest is None else 'rest shape'}"
    check_triangles(at_rest, triangles, what, "give it some height", least_height=_LEAST_HEIGHT)
    _require_apart(at_rest, triangles, what)
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
    if (found := find_repeated(vertices + 0.0)) is not None:
        first, second, count = found
        raise ValueError(
            f"{where}: mesh vertices {first} and {second} are at the same place, "
            f"{vertices[second].tolist()} ({count} vertices repeat another's place); merge them "
            "(trimesh: mesh.merge_vertices()) or, where the cloth is slit, move them apart"
        )
    corners = np.sort(triangles, axis=1)
    if (found := find_repeated(corners)) is not None:
        first, second, _ = found
        raise ValueError(
            f"{where}: mesh triangles {first} and {second} have the same corners, "
            f"{corners[second].tolist()}; remove one (trimesh: mesh.update_faces(mesh.unique_faces()))"
        )
    edges = np.sort(np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    unique, faces_at = np.unique(edges, axis=0, return_counts=True)
    if (faces_at > 2).any():
        first = int(np.argmax(faces_at > 2))
        raise ValueError(
            f"{where}: the mesh is not a sheet: {faces_at[first]} triangles meet at the edge of vertices "
            f"{unique[first].tolist()} ({np.count_nonzero(faces_at > 2)} such edges), and a cloth has at most two "
            "there; remove the others, or add them as a cloth of their own"
        )


def _require_apart(rest: FloatArray, triangles: IntArray, what: str) -> None:
    """At rest no vertex on the edge or face of a triangle not its own: contact could not tell them apart."""
    vertices, faces = _vertices_on_triangles(rest, triangles)
    if len(vertices) == 0:
        return
    vertex, face = int(vertices[0]), int(faces[0])
    count = len(np.unique(vertices))
    others = "" if count == 1 else f" ({count} vertices lie on triangles of others)"
    corners = triangles[face].tolist()
    for k in range(3):
        start, end, across = (corners[(k + i) % 3] for i in range(3))
        length = float(np.linalg.norm(rest[end] - rest[start]))
        if segment_segment_distance(rest[vertex], rest[vertex], rest[start], rest[end]) <= _TOUCHING * length:
            raise ValueError(
                f"{what} vertex {vertex} lies on the edge of vertices [{start}, {end}] but is no corner of their "
                f"triangle {face}{others}: at such a T-junction the cloth is not joined, and it would touch itself at "
                f"rest; replace triangle {face} by [{start}, {vertex}, {across}] and [{vertex}, {end}, {across}]"
            )
    raise ValueError(
        f"{what} vertex {vertex} lies on triangle {face} of vertices {corners}{others}, so that the cloth would touch "
        "itself at rest; move it off the triangle by the cloth's thickness, or make it a corner of triangles there"
    )


def _vertices_on_triangles(vertices: FloatArray, triangles: IntArray) -> tuple[Indices, Indices]:
    """Vertices that lie on triangles they are no corners of, and these triangles, in the order of the vertices."""
    corners = vertices[triangles]
    reach = _TOUCHING * np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2).max(axis=1)
    low, high = corners.min(axis=1) - reach[:, None], corners.max(axis=1) + reach[:, None]
    face, vertex = _sharing_cells(vertices, low, high)
    near = ((vertices[vertex] >= low[face]) & (vertices[vertex] <= high[face])).all(axis=1)
    near &= (triangles[face] != vertex[:, None]).all(axis=1)
    vertex, face = vertex[near], face[near]
    touching = point_triangle_distance(vertices[vertex], corners[face]) <= reach[face]
    vertex, face = vertex[touching], face[touching]
    sequence = np.lexsort((face, vertex))
    return vertex[sequence], face[sequence]


def _sharing_cells(points: FloatArray, low: FloatArray, high: FloatArray) -> tuple[Indices, Indices]:
    """Pairs of a box (low, high) and a point in one of the cells it covers, of a grid across the two longest sides."""
    axes = np.argsort(np.ptp(points, axis=0))[1:]
    origin = low.min(axis=0)[axes]
    points, low, high = points[:, axes] - origin, low[:, axes] - origin, high[:, axes] - origin
    cell = float(np.median((high - low).max(axis=1)))
    while True:
        first = np.floor(low / cell).astype(np.int64)
        size = np.floor(high / cell).astype(np.int64) - first + 1
        count = size.prod(axis=1)
        if count.sum() <= _CELLS_A_BOX * len(low):
            break
        cell *= 2.0  # some boxes are much larger than most
    box = np.repeat(np.arange(len(low)), count)
    within = np.arange(len(box)) - np.repeat(np.cumsum(count) - count, count)
    stride = int((first + size).max()) + 2
    key = (first[box, 0] + within % size[box, 0]) * stride + first[box, 1] + within // size[box, 0]
    place = np.floor(points / cell).astype(np.int64)
    own = place[:, 0] * stride + place[:, 1]
    order = np.argsort(own, kind="stable")
    begin, end = (np.searchsorted(own[order], key, side=side) for side in ("left", "right"))
    box = np.repeat(box, end - begin)
    within = np.arange(len(box)) - np.repeat(np.cumsum(end - begin) - (end - begin), end - begin)
    return box, order[np.repeat(begin, end - begin) + within]


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
