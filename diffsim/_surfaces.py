"""Surfaces placed in the world: their boxes, the pairs of them that may meet, and the triangles that do.

A broad phase on boxes (axis-aligned, then oriented: separated boxes, touching ones included, cost no more) leaves few
pairs. python-fcl then lists the triangles that meet, and for each of these pairs of triangles it is decided here
whether they properly cross or merely touch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._mass_properties import FloatArray, IntArray
from ._mesh import face_components
from ._mesh_queries import winding_number

# Overlap up to this fraction of the smaller body counts as touching: what is left when positions are sums of sizes.
_TOUCHING = 1e-9
# Rounding of a world coordinate x is about eps |x|; a few such roundings meet in every distance.
_ROUNDING = 64.0 * np.finfo(np.float64).eps
_MAX_FACE_PAIRS = 200_000
_MOST_CONVEX_FACES = 1000  # of a mesh that is tested for being convex


@dataclass(frozen=True, eq=False)
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
    def convex(self) -> bool:
        """Whether it is a segment or point, or a mesh that encloses a convex volume; large meshes are not looked at."""
        if len(self.faces) == 0:
            return True
        if not self.closed or len(self.faces) > _MOST_CONVEX_FACES:
            return False
        height = np.einsum(
            "vfi,fi->vf", self.vertices[:, None] - self.triangles[None, :, 0], unit_normals(self.triangles)
        )
        return bool(height.max() <= touching_depth(self, self))

    @cached_property
    def component_faces(self) -> NDArray[np.int64]:
        """One face of each connected part of the mesh."""
        return np.unique(face_components(self.faces), return_index=True)[1]

    @cached_property
    def inner_points(self) -> FloatArray:
        """Some points of the volume enclosed, shape (n, 3) [m]: half-way between faces, where that is inside."""
        centers = thin_out(self.triangles.mean(axis=1), 16)
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


def touching_depth(a: Solid, b: Solid) -> float:
    """Overlap up to this depth counts as touching [m]."""
    reach = max(float(np.abs(side).max()) for solid in (a, b) for side in solid.box)
    return float(_TOUCHING * min(a.size, b.size) + _ROUNDING * reach)


# ---- Broad phase ------------------------------------------------------------------------------------------------


def candidate_pairs(solids: Sequence[Solid]) -> Iterator[tuple[int, int]]:
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


# ---- Triangles -------------------------------------------------------------------------------------------------------


def meeting_faces(a: Solid, b: Solid) -> NDArray[np.int64]:
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


class Crossing(NamedTuple):
    """Pairs of triangles, and whether they properly cross: along a piece of line, each reaching through the other."""

    proper: NDArray[np.bool_]  #: shape (k,)
    reach: FloatArray  #: how far the less protruding of the two reaches beyond the other's plane, shape (k,)  [m]
    t_a: FloatArray  #: where the edges of a meet the plane of b, in [0, 1] along the edge or nan, shape (k, 3)
    t_b: FloatArray

    @staticmethod
    def of(a: FloatArray, b: FloatArray, tolerance: float) -> Crossing:
        """Args: a, b: corners of triangles that meet, shape (k, 3, 3) each."""
        normal_a, normal_b = unit_normals(a), unit_normals(b)
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
        return Crossing(proper, reach, t_a, t_b)


def unit_normals(triangles: FloatArray) -> FloatArray:
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


def inset_points(solid: Solid, faces: NDArray[np.int64], tolerance: float) -> FloatArray:
    """The middles of faces, moved inwards by a hair: inside another solid only if both share some volume there.

    Those of an open surface, which has no inside, stay where they are.
    """
    triangles = solid.triangles[faces]
    hair = 2.0 * tolerance if solid.closed else 0.0
    return np.asarray(triangles.mean(axis=1) - hair * unit_normals(triangles))


def thin_out(points: FloatArray, count: int) -> FloatArray:
    """At most `count` of the points, evenly taken."""
    return points if len(points) <= count else points[np.linspace(0, len(points) - 1, count).astype(np.int64)]
