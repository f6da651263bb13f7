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

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ._mass_properties import FloatArray, IntArray
from ._mesh import face_components
from ._mesh_queries import (
    distance_to_surface,
    segment_segment_distance,
    segment_triangle_distance,
    winding_number,
)

GROUND = -1  #: stands for the ground in `Overlap.b`

# Overlap up to this fraction of the smaller body counts as touching: what is left when positions are sums of sizes.
_TOUCHING = 1e-9
# Rounding of a world coordinate x is about eps |x|; a few such roundings meet in every distance.
_ROUNDING = 64.0 * np.finfo(np.float64).eps
# How many of the faces by which bodies touch are tried to tell whether they share some volume there, too.
_TOUCH_SAMPLES = 512
# How many points of each kind are tried to tell how deep a body reaches into another: the error message needs no more.
_DEPTH_SAMPLES = 48
_MAX_FACE_PAIRS = 200_000


@dataclass(frozen=True)
class Solid:
    """A body or a cloth placed in the world: the points within `radius` of its mesh, segment or point, and what it
    encloses.
    """

    vertices: FloatArray  #: world, shape (n, 3); one for a sphere, two for a capsule  [m]
    faces: IntArray  #: shape (m, 3); none for spheres and capsules
    radius: float  #: how far the surface stands off the mesh beyond the default thickness  [m]
    closed: bool  #: whether the faces enclose a volume
    movable: bool  #: dynamic body or cloth; pairs of bodies that are both not movable may overlap
    R_world_body: FloatArray  #: mesh axes in the world, shape (3, 3)
    box: tuple[FloatArray, FloatArray] = field(init=False)  #: world bounding box, radius included  [m]

    def __post_init__(self) -> None:
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        object.__setattr__(self, "box", (low - self.radius, high + self.radius))

    @property
    def size(self) -> float:
        """Longest side of the bounding box [m]."""
        return float((self.box[1] - self.box[0]).max())

    @cached_property
    def oriented_box(self) -> tuple[FloatArray, FloatArray]:
        """Centre (world) and half sides (along the mesh's axes) of the box around the mesh, radius included [m]."""
        along = self.vertices @ self.R_world_body
        low, high = along.min(axis=0), along.max(axis=0)
        return self.R_world_body @ (0.5 * (low + high)), 0.5 * (high - low) + self.radius

    @cached_property
    def triangles(self) -> FloatArray:
        """Corners in the world, shape (m, 3, 3) [m]."""
        return self.vertices[self.faces]

    @cached_property
    def triangle_boxes(self) -> tuple[FloatArray, FloatArray]:
        return self.triangles.min(axis=1), self.triangles.max(axis=1)

    @cached_property
    def component_faces(self) -> NDArray[np.int64]:
        """One face of each connected part of the mesh."""
        return np.unique(face_components(self.faces), return_index=True)[1]

    @cached_property
    def inner_points(self) -> FloatArray:
        """Some points of the volume enclosed, shape (n, 3) [m]: half-way between faces, where that is inside."""
        centers = _thin_out(self.triangles.mean(axis=1), 16)
        first, second = np.triu_indices(len(centers), 1)
        between = 0.5 * (centers[first] + centers[second])
        return between[self.contains(between)]

    @cached_property
    def collision_object(self) -> Any:
        """The mesh as python-fcl holds it, with its bounding volume hierarchy."""
        import fcl  # lazily: most scenes need none

        tree = fcl.BVHModel()
        tree.beginModel(len(self.vertices), len(self.faces))
        tree.addSubModel(self.vertices, self.faces)
        tree.endModel()
        return fcl.CollisionObject(tree)

    def contains(self, points: FloatArray) -> NDArray[np.bool_]:
        """Which of the points (n, 3) the mesh encloses, its radius left out; shape (n,)."""
        inside = np.zeros(len(points), dtype=bool)
        if self.closed:
            low, high = self.box
            near = np.flatnonzero(((points > low) & (points < high)).all(axis=1))
            if len(near):
                inside[near] = winding_number(points[near], self.triangles) > 0.5
        return inside


@dataclass(frozen=True)
class Overlap:
    """Two solids, by index, that interpenetrate; `b` may be `GROUND`."""

    a: int
    b: int
    depth: float  #: how far below the surface of one the deepest point found of the other lies: a shift that separates
    #: them is at least this long  [m]


def find_overlaps(solids: Sequence[Solid], ground_height: float | None, ground_radius: float) -> list[Overlap]:
    """All pairs that overlap by more than rounding, in the order of their indices, ground last for each body.

    Args:
        solids: Bodies and cloths.
        ground_height: Surface of the half-space below [m], or None.
        ground_radius: How far the ground's surface stands off that height beyond the default thickness [m].
    """
    overlaps = []
    for a, b in _candidate_pairs(solids):
        depth = _pair_depth(solids[a], solids[b])
        if depth > 0.0:
            overlaps.append(Overlap(a, b, depth))
    if ground_height is not None:
        for index, solid in enumerate(solids):
            depth = ground_height + ground_radius - float(solid.box[0][2])
            if solid.movable and depth > _tolerance(solid, solid):
                overlaps.append(Overlap(index, GROUND, depth))
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
    pairs = _meeting_faces(surface, surface)
    pairs = pairs[pairs[:, 0] < pairs[:, 1]]
    corners = surface.faces[pairs]
    shared = (corners[:, 0, :, None] == corners[:, 1, None, :]).sum(axis=(1, 2))
    tolerance = _tolerance(surface, surface)
    apart, neighbours = pairs[shared == 0], pairs[shared == 1]
    first, second = surface.triangles[apart].transpose(1, 0, 2, 3)
    crossing = [apart[_Crossing.of(first, second, tolerance).proper]]
    for own, other in ((0, 1), (1, 0)):
        mine, others = surface.faces[neighbours[:, own]], surface.faces[neighbours[:, other]]
        free = (mine[:, :, None] != others[:, None, :]).all(axis=2)  # two corners of each
        start, end = surface.vertices[mine[free].reshape(-1, 2)].transpose(1, 0, 2)
        crossing.append(neighbours[_pierces(start, end, surface.vertices[others], tolerance)])
    found = np.unique(np.concatenate(crossing), axis=0)
    return SelfCrossing(int(found[0, 0]), int(found[0, 1]), len(found)) if len(found) else None


def _pierces(start: FloatArray, end: FloatArray, triangles: FloatArray, tolerance: float) -> NDArray[np.bool_]:
    """Whether segments (k, 3) pass through the inside of triangles (k, 3, 3), further from its edges than rounding."""
    normal = _unit_normals(triangles)
    h0 = np.einsum("ki,ki->k", start - triangles[:, 0], normal)
    h1 = np.einsum("ki,ki->k", end - triangles[:, 0], normal)
    through = (np.minimum(np.abs(h0), np.abs(h1)) > tolerance) & ((h0 > 0.0) != (h1 > 0.0))
    point = start + np.where(through, h0 / np.where(through, h0 - h1, 1.0), 0.0)[:, None] * (end - start)
    for k in range(3):
        along = triangles[:, (k + 1) % 3] - triangles[:, k]
        inwards = np.cross(normal, along) / np.linalg.norm(along, axis=1, keepdims=True)
        through &= np.einsum("ki,ki->k", inwards, point - triangles[:, k]) > tolerance
    return np.asarray(through)


def _tolerance(a: Solid, b: Solid) -> float:
    """Overlap up to this depth counts as touching [m]."""
    reach = max(float(np.abs(side).max()) for solid in (a, b) for side in solid.box)
    return float(_TOUCHING * min(a.size, b.size) + _ROUNDING * reach)


# ---- Broad phase ------------------------------------------------------------------------------------------------


def _candidate_pairs(solids: Sequence[Solid]) -> Iterator[tuple[int, int]]:
    """Pairs a < b, one of them movable, whose boxes overlap by more than counts as touching."""
    if len(solids) < 2:
        return
    low, high = np.array([s.box[0] for s in solids]), np.array([s.box[1] for s in solids])
    movable = np.array([s.movable for s in solids])
    tolerance = _TOUCHING * (high - low).max(axis=1) + _ROUNDING * np.maximum(np.abs(low), np.abs(high)).max(axis=1)
    # Sweep along the axis on which the boxes are spread widest compared with their own sides.
    axis = int(np.argmax(np.ptp(low, axis=0) / ((high - low).mean(axis=0) + np.finfo(np.float64).tiny)))
    order = np.argsort(low[:, axis], kind="stable")
    last = np.searchsorted(low[order, axis], high[order, axis])
    first, second = [], []
    for position, index in enumerate(order):
        others = order[position + 1 : last[position]]
        gap = np.minimum(tolerance[index], tolerance[others])[:, None]
        overlap = np.minimum(high[index] - low[others], high[others] - low[index])
        others = others[(overlap > gap).all(axis=1) & (movable[index] | movable[others])]
        first.append(np.minimum(index, others))
        second.append(np.maximum(index, others))
    a, b = np.concatenate(first), np.concatenate(second)
    if len(a) == 0:
        return
    keep = _oriented_boxes_overlap(solids, a, b, np.minimum(tolerance[a], tolerance[b]))
    yield from sorted(zip(a[keep].tolist(), b[keep].tolist(), strict=True))


def _oriented_boxes_overlap(
    solids: Sequence[Solid], a: NDArray[np.int64], b: NDArray[np.int64], tolerance: FloatArray
) -> NDArray[np.bool_]:
    """Separating-axis test of the pairs a[k], b[k]; boxes that overlap by at most `tolerance` count as separate."""
    center, half = (np.array(x) for x in zip(*(s.oriented_box for s in solids), strict=True))
    axes = np.array([s.R_world_body.T for s in solids])  # rows: the axes of the mesh in the world
    axes_a, axes_b = axes[a], axes[b]
    crossed = np.cross(axes_a[:, :, None], axes_b[:, None]).reshape(len(a), 9, 3)
    length = np.linalg.norm(crossed, axis=-1)
    usable = length > 1e-6  # the cross product of (nearly) parallel edges is rounding, and separates nothing new
    crossed /= np.where(usable, length, 1.0)[..., None]
    candidates = np.concatenate([axes_a, axes_b, crossed], axis=1)
    reach = np.einsum("pcj,pj->pc", np.abs(np.einsum("pci,pji->pcj", candidates, axes_a)), half[a])
    reach += np.einsum("pcj,pj->pc", np.abs(np.einsum("pci,pji->pcj", candidates, axes_b)), half[b])
    overlap = reach - np.abs(np.einsum("pci,pi->pc", candidates, center[b] - center[a]))
    overlap[:, 6:][~usable] = np.inf
    overlapping: NDArray[np.bool_] = (overlap > tolerance[:, None]).all(axis=1)
    return overlapping


# ---- Narrow phase -----------------------------------------------------------------------------------------------


def _pair_depth(a: Solid, b: Solid) -> float:
    """How deep two bodies overlap; 0 if they are apart or touch [m]."""
    tolerance = _tolerance(a, b)
    if len(a.faces) and len(b.faces):
        depth = _mesh_mesh_depth(a, b, tolerance)
    elif len(a.faces) or len(b.faces):
        depth = _segment_mesh_depth(a, b) if len(b.faces) else _segment_mesh_depth(b, a)
    else:
        gap = segment_segment_distance(a.vertices[0], a.vertices[-1], b.vertices[0], b.vertices[-1])
        depth = a.radius + b.radius - float(gap)
    return depth if depth > tolerance else 0.0


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
    face_pairs = _meeting_faces(a, b)
    crossing = _Crossing.of(a.triangles[face_pairs[:, 0]], b.triangles[face_pairs[:, 1]], tolerance)
    crosses = bool(crossing.proper.any())
    depth = 0.0
    sides = ((a, b, 0, crossing.t_a), (b, a, 1, crossing.t_b))
    if not crosses:
        for solid, other, own, _ in sides:
            for faces in (solid.component_faces, np.unique(face_pairs[:, own])):
                depth = max(depth, _deepest(_inset_points(solid, faces, tolerance), other, _TOUCH_SAMPLES))
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


def _meeting_faces(a: Solid, b: Solid) -> NDArray[np.int64]:
    """Pairs of faces that meet, touching included, shape (k, 2)."""
    import fcl

    # A surface meets itself at every triangle and its neighbours, about 13 each; no pair of it may be missed.
    most = max(_MAX_FACE_PAIRS, 16 * len(a.faces)) if a is b else _MAX_FACE_PAIRS
    while True:
        request = fcl.CollisionRequest(num_max_contacts=most, enable_contact=False)
        result = fcl.CollisionResult()
        fcl.collide(a.collision_object, b.collision_object, request, result)
        if a is not b or len(result.contacts) < most:
            break
        most *= 4
    pairs = np.array([(contact.b1, contact.b2) for contact in result.contacts], dtype=np.int64).reshape(-1, 2)
    key = np.unique(pairs[:, 0] * len(b.faces) + pairs[:, 1])  # by rows takes much longer
    return np.stack([key // len(b.faces), key % len(b.faces)], axis=1)


def _surface_distance(a: Solid, b: Solid) -> float:
    import fcl

    request, result = fcl.DistanceRequest(), fcl.DistanceResult()
    return max(0.0, float(fcl.distance(a.collision_object, b.collision_object, request, result)))


@dataclass(frozen=True)
class _Crossing:
    """Pairs of triangles, and whether they properly cross: along a piece of line, each reaching through the other."""

    proper: NDArray[np.bool_]  #: shape (k,)
    reach: FloatArray  #: how far the less protruding of the two reaches beyond the other's plane, shape (k,)  [m]
    t_a: FloatArray  #: where the edges of a meet the plane of b, in [0, 1] along the edge or nan, shape (k, 3)
    t_b: FloatArray

    @staticmethod
    def of(a: FloatArray, b: FloatArray, tolerance: float) -> _Crossing:
        """Args: a, b: corners of triangles that meet, shape (k, 3, 3) each."""
        normal_a, normal_b = _unit_normals(a), _unit_normals(b)
        height_a = np.einsum("kij,kj->ki", a - b[:, :1], normal_b)
        height_b = np.einsum("kij,kj->ki", b - a[:, :1], normal_a)
        reach = np.minimum.reduce([height_a.max(1), -height_a.min(1), height_b.max(1), -height_b.min(1)])
        t_a, t_b = _plane_crossings(height_a), _plane_crossings(height_b)
        line = np.cross(normal_a, normal_b)
        line /= np.maximum(np.linalg.norm(line, axis=1, keepdims=True), np.finfo(np.float64).tiny)
        proper = reach > tolerance
        # Both cut the line in which their planes meet in an interval; the triangles cross where the intervals overlap.
        low_a, high_a = _interval(a[proper], t_a[proper], line[proper])
        low_b, high_b = _interval(b[proper], t_b[proper], line[proper])
        proper[proper] = np.minimum(high_a, high_b) - np.maximum(low_a, low_b) > tolerance
        return _Crossing(proper, reach, t_a, t_b)


def _unit_normals(triangles: FloatArray) -> FloatArray:
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return np.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True))


def _plane_crossings(height: FloatArray) -> FloatArray:
    """Where each edge, from corner i to i + 1, passes height zero: in [0, 1], or nan."""
    ahead = np.roll(height, -1, axis=1)
    crosses = (height >= 0.0) != (ahead >= 0.0)
    return np.where(crosses, height / np.where(crosses, height - ahead, 1.0), np.nan)


def _interval(triangles: FloatArray, t: FloatArray, line: FloatArray) -> tuple[FloatArray, FloatArray]:
    points = triangles + t[..., None] * (np.roll(triangles, -1, axis=1) - triangles)
    along = np.einsum("kij,kj->ki", points, line)
    return np.nanmin(along, axis=1, initial=np.inf), np.nanmax(along, axis=1, initial=-np.inf)


def _inset_points(solid: Solid, faces: NDArray[np.int64], tolerance: float) -> FloatArray:
    """The middles of faces, moved inwards by a hair: inside another solid only if both share some volume there.

    Those of an open surface, which has no inside, stay where they are.
    """
    triangles = solid.triangles[faces]
    hair = 2.0 * tolerance if solid.closed else 0.0
    return np.asarray(triangles.mean(axis=1) - hair * _unit_normals(triangles))


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


def _thin_out(points: FloatArray, count: int) -> FloatArray:
    """At most `count` of the points, evenly taken."""
    return points if len(points) <= count else points[np.linspace(0, len(points) - 1, count).astype(np.int64)]


def _deepest(points: FloatArray, solid: Solid, samples: int) -> float:
    """Depth below the surface of the deepest point enclosed, 0 if none is [m]; `samples` of the points are tried."""
    low, high = solid.box
    points = points[((points > low) & (points < high)).all(axis=1)]
    points = _thin_out(points, samples)
    inside = points[solid.contains(points)]
    return float(distance_to_surface(inside, solid.triangles).max()) if len(inside) else 0.0
