"""Do objects overlap at the start, and how deep? Run once per scene, before anything moves.

Touching is fine and common (cubes stacked face to face), overlapping is not, so the two must be told apart to rounding.
A broad phase on boxes (axis-aligned, then oriented: separated boxes, touching ones included, cost no more) leaves few
pairs. For two meshes python-fcl then lists the triangles that meet, and for each of these pairs of triangles it is
decided here whether they properly cross or merely touch. Points taken slightly inside one surface and tested against
the other find what no crossing shows: one body wholly inside another, or bodies whose surfaces coincide. Spheres and
capsules are points and segments with a radius and are measured exactly. A cloth is an open surface: it must not cross
anything, itself included, nor lie inside a closed body.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._mass_properties import FloatArray
from ._mesh_queries import distance_to_surface, segment_segment_distance, segment_triangle_distance
from ._surfaces import (
    Crossing,
    Solid,
    candidate_pairs,
    inset_points,
    meeting_faces,
    thin_out,
    touching_depth,
    unit_normals,
)

GROUND = -1  #: stands for the ground in `Overlap.b`

# How many of the faces by which bodies touch are tried to tell whether they share some volume there, too.
_TOUCH_SAMPLES = 512
# How many points of each kind are tried to tell how deep a body reaches into another: the error message needs no more.
_DEPTH_SAMPLES = 48
# How many vertices are projected onto how many axes at most, to find the shortest shift that separates convex bodies.
_MOST_PROJECTIONS = 20_000_000


class Overlap(NamedTuple):
    """Two solids, by index, that interpenetrate; `b` may be `GROUND`."""

    a: int
    b: int
    depth: float  #: length of the shortest shift that separates them, where `exact`; else how far below the surface of
    #: one the deepest point found of the other lies, and that shift is at least about this long  [m]
    exact: bool


def find_overlaps(solids: Sequence[Solid], ground_height: float | None, ground_radius: float) -> list[Overlap]:
    """All pairs that overlap by more than rounding, in the order of their indices, ground last for each body.

    Args:
        solids: Bodies and cloths.
        ground_height: Surface of the half-space below [m], or None.
        ground_radius: How far the ground's surface stands off that height beyond the default thickness [m].
    """
    overlaps = []
    for a, b in candidate_pairs(solids):
        depth = _pair_depth(solids[a], solids[b])
        if depth > 0.0:
            overlaps.append(Overlap(a, b, depth, _is_exact(solids[a], solids[b])))
    if ground_height is not None:
        for index, solid in enumerate(solids):
            depth = ground_height + ground_radius - float(solid.box[0][2])
            if solid.movable and depth > touching_depth(solid, solid):
                overlaps.append(Overlap(index, GROUND, depth, True))
    return sorted(overlaps, key=lambda overlap: (overlap.a, overlap.b == GROUND, overlap.b))


@dataclass(frozen=True)
class SelfCrossing:
    """Triangles of a surface that cross."""

    a: int  #: the first pair, by index
    b: int
    count: int  #: how many pairs


def find_self_crossing(surface: Solid) -> SelfCrossing | None:
    """Triangles of a surface that cross, along a piece of line longer than rounding; None if there are none.

    Neighbours may be folded onto each other: of triangles that share a vertex, the edges across from it are tried
    against the other triangle; two that share an edge cannot cross.
    """
    pairs = meeting_faces(surface, surface)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    corners = surface.faces[pairs]
    shared = (corners[:, 0, :, None] == corners[:, 1, None, :]).sum(axis=(1, 2))
    tolerance = touching_depth(surface, surface)
    apart, neighbours = pairs[shared == 0], pairs[shared == 1]
    first, second = surface.triangles[apart].transpose(1, 0, 2, 3)
    crossing = [apart[Crossing.of(first, second, tolerance).proper]]
    for own, other in ((0, 1), (1, 0)):
        mine, others = surface.faces[neighbours[:, own]], surface.faces[neighbours[:, other]]
        free = (mine[:, :, None] != others[:, None, :]).all(axis=2)  # two corners of each
        start, end = surface.vertices[mine[free].reshape(-1, 2)].transpose(1, 0, 2)
        crossing.append(neighbours[_pierces(start, end, surface.vertices[others], tolerance)])
    found = np.unique(np.concatenate(crossing), axis=0)
    return SelfCrossing(int(found[0, 0]), int(found[0, 1]), len(found)) if len(found) else None


def _pierces(start: FloatArray, end: FloatArray, triangles: FloatArray, tolerance: float) -> NDArray[np.bool_]:
    """Whether segments (k, 3) pass through the inside of triangles (k, 3, 3), further from its edges than rounding."""
    normal = unit_normals(triangles)
    h0 = np.einsum("ki,ki->k", start - triangles[:, 0], normal)
    h1 = np.einsum("ki,ki->k", end - triangles[:, 0], normal)
    through = (np.minimum(np.abs(h0), np.abs(h1)) > tolerance) & ((h0 > 0.0) != (h1 > 0.0))
    point = start + np.where(through, h0 / np.where(through, h0 - h1, 1.0), 0.0)[:, None] * (end - start)
    for k in range(3):
        along = triangles[:, (k + 1) % 3] - triangles[:, k]
        inwards = np.cross(normal, along) / np.linalg.norm(along, axis=1, keepdims=True)
        through &= np.einsum("ki,ki->k", inwards, point - triangles[:, k]) > tolerance
    return np.asarray(through)


# ---- Narrow phase -----------------------------------------------------------------------------------------------


def _pair_depth(a: Solid, b: Solid) -> float:
    """How deep two bodies overlap; 0 if they are apart or touch [m]."""
    tolerance = touching_depth(a, b)
    if len(a.faces) and len(b.faces):
        depth = _mesh_mesh_depth(a, b, tolerance)
    elif len(a.faces) or len(b.faces):
        depth = _segment_mesh_depth(a, b) if len(b.faces) else _segment_mesh_depth(b, a)
    else:
        gap = segment_segment_distance(a.vertices[0], a.vertices[-1], b.vertices[0], b.vertices[-1])
        depth = a.radius + b.radius - float(gap)
    if depth > tolerance and (len(a.faces) or len(b.faces)) and _is_exact(a, b):
        shift = _least_shift(a, b)
        if shift > tolerance:  # else it is their radii that overlap, which was measured
            depth = shift + a.radius + b.radius
    return depth if depth > tolerance else 0.0


def _is_exact(a: Solid, b: Solid) -> bool:
    """Whether the depth of the two is the length of the shortest shift that separates them."""
    axes = len(a.faces) + len(b.faces) + 9 * max(1, len(a.faces)) * max(1, len(b.faces)) // 4
    return a.convex and b.convex and axes * (len(a.vertices) + len(b.vertices)) <= _MOST_PROJECTIONS


def _least_shift(a: Solid, b: Solid) -> float:
    """The shortest shift that separates two convex bodies, their radii left out; not positive if they are apart [m].

    It is along a face's normal, or across an edge of each [the separating axis theorem].
    """
    edges_a, edges_b = _edge_directions(a), _edge_directions(b)
    crossed = np.cross(edges_a[:, None], edges_b[None]).reshape(-1, 3)
    length = np.linalg.norm(crossed, axis=1)
    crossed = crossed[length > 1e-6] / length[length > 1e-6, None]  # of parallel edges it is rounding
    axes = np.concatenate([*(unit_normals(solid.triangles) for solid in (a, b) if len(solid.faces)), crossed])
    along_a, along_b = a.vertices @ axes.T, b.vertices @ axes.T
    ahead, behind = along_a.max(axis=0) - along_b.min(axis=0), along_b.max(axis=0) - along_a.min(axis=0)
    return float(np.minimum(ahead, behind).min())


def _edge_directions(solid: Solid) -> FloatArray:
    """Unit vectors along all edges, shape (k, 3)."""
    if len(solid.faces):
        pairs = np.stack([solid.faces, np.roll(solid.faces, -1, axis=1)], axis=-1).reshape(-1, 2)
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]  # each edge of a closed surface once
    else:
        pairs = np.array([[0, 1]])[: len(solid.vertices) - 1]
    along = solid.vertices[pairs[:, 1]] - solid.vertices[pairs[:, 0]]
    return np.asarray(along / np.linalg.norm(along, axis=1, keepdims=True))


def _segment_mesh_depth(segment: Solid, mesh: Solid) -> float:
    """Depth of a sphere or capsule in a mesh [m]; negative or zero when apart."""
    radius = segment.radius + mesh.radius
    p0, p1 = segment.vertices[0], segment.vertices[-1]
    low, high = mesh.triangle_boxes
    near = ((low <= np.maximum(p0, p1) + radius) & (high >= np.minimum(p0, p1) - radius)).all(axis=1)
    depth = -np.inf
    if near.any():
        depth = radius - float(segment_triangle_distance(p0, p1, mesh.triangles[near]).min())
    inside = segment.vertices[mesh.contains(segment.vertices)]
    if len(inside):
        depth = max(depth, radius + float(distance_to_surface(inside, mesh.triangles).max()))
    return depth


def _mesh_mesh_depth(a: Solid, b: Solid, tolerance: float) -> float:
    """Depth of one mesh in another [m]; zero when apart or touching."""
    face_pairs = meeting_faces(a, b)
    crossing = Crossing.of(a.triangles[face_pairs[:, 0]], b.triangles[face_pairs[:, 1]], tolerance)
    crosses = bool(crossing.proper.any())
    depth = 0.0
    sides = ((a, b, 0, crossing.t_a), (b, a, 1, crossing.t_b))
    if not crosses:
        for solid, other, own, _ in sides:
            for faces in (solid.component_faces, np.unique(face_pairs[:, own])):
                depth = max(depth, _deepest(inset_points(solid, faces, tolerance), other, _TOUCH_SAMPLES))
    if crosses or depth > tolerance:  # they overlap: look closer, so as to say how deep
        for solid, other, own, t in sides:
            cuts = _points_between_cuts(solid, face_pairs[crossing.proper, own], t[crossing.proper])
            centers = solid.triangles[face_pairs[:, own]].mean(axis=1)
            for points in (cuts, centers, solid.vertices, solid.inner_points):
                depth = max(depth, _deepest(points, other, _DEPTH_SAMPLES))
    if crosses and depth <= tolerance:
        # Nothing is enclosed: one of the two is an open surface. How far do the triangles reach through each other?
        depth = max(float(crossing.reach[crossing.proper].max()), 2.0 * tolerance)
    radius = a.radius + b.radius
    if radius > 0.0:
        gap = 0.0 if len(face_pairs) else _surface_distance(a, b)
        depth = depth + radius if depth > tolerance else radius - gap
    return depth


def _surface_distance(a: Solid, b: Solid) -> float:
    import fcl

    request, result = fcl.DistanceRequest(), fcl.DistanceResult()
    return max(0.0, float(fcl.distance(a.collision_object, b.collision_object, request, result)))


def _points_between_cuts(solid: Solid, faces: NDArray[np.int64], t: FloatArray) -> FloatArray:
    """Middles of the pieces into which the planes of the faces they cross cut the edges of these faces."""
    edge = np.stack([solid.faces[faces], np.roll(solid.faces[faces], -1, axis=1)], axis=-1).reshape(-1, 2)
    flip = edge[:, 0] > edge[:, 1]
    t = np.where(flip, 1.0 - t.ravel(), t.ravel())
    edge, index = np.unique(np.sort(edge, axis=1), axis=0, return_inverse=True)
    hit = ~np.isnan(t)
    count = np.arange(len(edge))
    index = np.concatenate([count, count, index.reshape(-1)[hit]])
    t = np.concatenate([np.zeros(len(edge)), np.ones(len(edge)), t[hit]])
    order = np.lexsort((t, index))
    index, t = index[order], t[order]
    same = index[:-1] == index[1:]
    middle = 0.5 * (t[:-1] + t[1:])[same]
    start, end = solid.vertices[edge[index[:-1][same]]].transpose(1, 0, 2)
    return np.asarray(start + middle[:, None] * (end - start))


def _deepest(points: FloatArray, solid: Solid, samples: int) -> float:
    """Depth below the surface of the deepest point enclosed, 0 if none is [m]; `samples` of the points are tried."""
    low, high = solid.box
    points = points[((points > low) & (points < high)).all(axis=1)]
    points = thin_out(points, samples)
    inside = points[solid.contains(points)]
    return float(distance_to_surface(inside, solid.triangles).max()) if len(inside) else 0.0
