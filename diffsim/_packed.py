"""A scene as arrays: what the core is built from."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from . import _core
from ._arguments import KINDS, Kind, positive
from ._body_shape import Shape
from ._cloth_shape import ClothShape
from ._mass_properties import FloatArray, IntArray
from .materials import ClothMaterial

# The default thickness of an object as a fraction of its smallest extent; of a scene without objects, of one metre.
_RELATIVE_THICKNESS = 1e-3
# And at most this fraction of the smallest height of a cloth's triangles: neighbours at rest are that far apart, and
# the contact between them must stay out of it when the cloth is compressed and folded sharply.
_HEIGHT_FRACTION = 0.1
# A closed mesh whose box is thinner than this fraction of its second shortest side is flat up to rounding in float32.
_FLAT = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class PackedScene:
    """A scene as arrays, its n bodies and c cloths in the order they were added.

    The body frame has its origin at the centre of mass, and the axes of the mesh. Arrays of nodes and triangles hold
    those of all cloths, one cloth after the other.
    """

    names: list[str]  #: of the bodies
    kind: IntArray  #: 0 dynamic, 1 static, 2 kinematic, shape (n,)
    margin: FloatArray  #: distance of the collision surface from the mesh, resolved, shape (n,)  [m]
    vertex_count: IntArray  #: shape (n,)
    vertices: FloatArray  #: of all bodies, one after the other, body frame, shape (sum of vertex_count, 3)  [m]
    face_count: IntArray  #: 0 for spheres (one vertex) and capsules (two), shape (n,)
    faces: IntArray  #: of all bodies, indices local to each body, shape (sum of face_count, 3)
    position: FloatArray  #: centre of mass, world, shape (n, 3)  [m]
    orientation: FloatArray  #: unit quaternion w, x, y, z, body to world, shape (n, 4)
    velocity: FloatArray  #: of the centre of mass, world, shape (n, 3)  [m/s]
    angular_velocity: FloatArray  #: world, shape (n, 3)  [rad/s]
    mass: FloatArray  #: 0 for static and kinematic bodies, shape (n,)  [kg]
    inertia: FloatArray  #: body frame, zeros for static and kinematic bodies, shape (n, 3, 3)  [kg·m²]
    mesh_offset: FloatArray  #: centre of mass in the frame of the mesh as given, shape (n, 3)  [m]
    cloth_names: list[str]
    cloth_margin: FloatArray  #: resolved, shape (c,)  [m]
    cloth_poisson: FloatArray  #: shape (c,)
    cloth_density: FloatArray  #: shape (c,)  [kg/m²]
    cloth_stretch: FloatArray  #: shape (c,)  [N/m]
    cloth_shear: FloatArray  #: shape (c,)  [N/m]
    cloth_bend: FloatArray  #: shape (c,)  [N·m]
    cloth_damping: FloatArray  #: shape (c,)  [s]
    node_count: IntArray  #: shape (c,)
    triangle_count: IntArray  #: shape (c,)
    triangles: IntArray  #: indices local to each cloth, shape (sum of triangle_count, 3)
    warp: FloatArray  #: unit vector in the frame of `node_rest`, shape (c, 3)
    pinned: NDArray[np.uint8]  #: 1 for nodes that move as told, shape (sum of node_count,)
    node_rest: FloatArray  #: the rest shape, in the frame of the mesh as given, shape (sum of node_count, 3)  [m]
    node_position: FloatArray  #: world, shape (sum of node_count, 3)  [m]
    node_velocity: FloatArray  #: world, zero for pinned nodes, shape (sum of node_count, 3)  [m/s]
    friction: FloatArray  #: bodies, then cloths, then the ground if there is one, shape (n_objects,)
    restitution: FloatArray  #: likewise
    gravity: FloatArray  #: shape (3,)  [m/s²]
    has_ground: bool
    ground_height: float  #: the half-space z <= ground_height is solid; 0 without ground  [m]
    ground_margin: float | None  #: None: half the thickness of what meets the ground; 0 without ground  [m]
    thickness: float  #: distance kept between surfaces of default margin: the largest of `object_thickness`  [m]
    #: of bodies, then cloths, shape (n + c,): twice the default margin; a pair's is the mean of both  [m]
    object_thickness: FloatArray


@dataclass(frozen=True, eq=False)
class Body:
    name: str
    kind: Kind
    shape: Shape
    position: FloatArray  #: of the mesh's frame, world [m]
    orientation: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    friction: float
    restitution: float


@dataclass(frozen=True, eq=False)
class Cloth:
    name: str
    shape: ClothShape
    material: ClothMaterial
    position: FloatArray  #: of the mesh's frame, world [m]
    orientation: FloatArray
    velocity: FloatArray
    margin: float | None
    friction: float
    restitution: float


@dataclass(frozen=True)
class Ground:
    height: float
    friction: float
    restitution: float
    margin: float | None


def pack_scene(
    bodies: Sequence[Body],
    cloths: Sequence[Cloth],
    ground: Ground | None,
    gravity: FloatArray,
    thickness: float | None,
) -> PackedScene:
    """As `Scene.pack` says."""
    ground_margin = 0.0 if ground is None else ground.margin
    if thickness is None:
        own = _default_thickness(bodies, cloths)
        thickness = float(own.max()) if own.size else _RELATIVE_THICKNESS
    else:
        thickness = positive(thickness, "thickness", "m")
        own = np.full(len(bodies) + len(cloths), thickness)
        ground_margin = _resolve(ground_margin, thickness)
    cloth_margin = [_resolve(c.margin, t) for c, t in zip(cloths, own[len(bodies) :], strict=True)]
    shapes = [body.shape for body in bodies]
    sheets = [cloth.shape for cloth in cloths]
    objects: list[Body | Cloth | Ground] = [*bodies, *cloths, *([] if ground is None else [ground])]
    for cloth, margin in zip(cloths, cloth_margin, strict=True):
        _require_coarser_than_thick(cloth, margin)
    orientation = _stack([b.orientation for b in bodies], (4,))
    mesh_offset = _stack([s.center for s in shapes], (3,))
    placed = [b.position + rotation_matrix(b.orientation) @ b.shape.center for b in bodies]
    return PackedScene(
        names=[b.name for b in bodies],
        kind=np.array([KINDS.index(b.kind) for b in bodies], dtype=np.int32),
        margin=np.array([_resolve(s.margin, t) for s, t in zip(shapes, own)], dtype=np.float64),
        vertex_count=np.array([len(s.vertices) for s in shapes], dtype=np.int32),
        vertices=np.concatenate([np.zeros((0, 3)), *(s.vertices - s.center for s in shapes)]),
        face_count=np.array([len(s.faces) for s in shapes], dtype=np.int32),
        faces=np.concatenate([np.zeros((0, 3), dtype=np.int32), *(s.faces for s in shapes)]),
        position=_stack(placed, (3,)),
        orientation=orientation,
        velocity=_stack([b.velocity for b in bodies], (3,)),
        angular_velocity=_stack([b.angular_velocity for b in bodies], (3,)),
        mass=np.array([s.mass for s in shapes], dtype=np.float64),
        inertia=_stack([s.inertia for s in shapes], (3, 3)),
        mesh_offset=mesh_offset,
        cloth_names=[c.name for c in cloths],
        cloth_margin=np.array(cloth_margin, dtype=np.float64),
        **{
            f"cloth_{field.name}": np.array([getattr(c.material, field.name) for c in cloths], dtype=np.float64)
            for field in fields(ClothMaterial)
        },
        node_count=np.array([len(s.vertices) for s in sheets], dtype=np.int32),
        triangle_count=np.array([len(s.triangles) for s in sheets], dtype=np.int32),
        triangles=np.concatenate([np.zeros((0, 3), dtype=np.int32), *(s.triangles for s in sheets)]),
        warp=_stack([s.warp for s in sheets], (3,)),
        pinned=np.concatenate([np.zeros(0, dtype=np.uint8), *(s.pinned for s in sheets)]),
        node_rest=np.concatenate([np.zeros((0, 3)), *(s.rest for s in sheets)]),
        node_position=np.concatenate([np.zeros((0, 3)), *(_placed(c) for c in cloths)]),
        node_velocity=np.concatenate(
            [np.zeros((0, 3)), *(np.where(c.shape.pinned[:, None] == 1, 0.0, c.velocity) for c in cloths)]
        ),
        friction=np.array([o.friction for o in objects], dtype=np.float64),
        restitution=np.array([o.restitution for o in objects], dtype=np.float64),
        gravity=gravity.copy(),
        has_ground=ground is not None,
        ground_height=0.0 if ground is None else ground.height,
        ground_margin=ground_margin,
        thickness=thickness,
        object_thickness=own,
    )


def _default_thickness(bodies: Sequence[Body], cloths: Sequence[Cloth]) -> FloatArray:
    """Of each object, bodies first."""
    of_bodies = [_RELATIVE_THICKNESS * _smallest_extent(body.shape) for body in bodies]
    of_cloths = [
        min(_RELATIVE_THICKNESS * _sides(cloth.shape.vertices)[1], _HEIGHT_FRACTION * cloth.shape.smallest_height)
        for cloth in cloths
    ]
    # What does not yield may be a landscape: what moves over it does not see how large it is.
    moves = [body.kind == "dynamic" for body in bodies]
    most = max([*(t for t, yields in zip(of_bodies, moves) if yields), *of_cloths], default=math.inf)
    return np.array([t if yields else min(t, most) for t, yields in zip(of_bodies, moves)] + of_cloths)


def _smallest_extent(shape: Shape) -> float:
    """Shortest side of its box; of a surface that is open or flat the second: how far it is from flat is no extent."""
    if shape.margin is not None:
        return float(_sides(shape.vertices)[0] + 2.0 * shape.margin)
    shortest, second, _ = _sides(shape.vertices)
    return float(shortest if shape.closed and shortest > _FLAT * second else second)


def _sides(vertices: FloatArray) -> FloatArray:
    """Of their box, the shortest first, shape (3,)."""
    return np.asarray(np.sort(np.ptp(vertices, axis=0)))


def _placed(cloth: Cloth) -> FloatArray:
    """Its nodes in the world."""
    return np.asarray(cloth.shape.vertices @ rotation_matrix(cloth.orientation).T + cloth.position)


def _require_coarser_than_thick(cloth: Cloth, margin: float) -> None:
    height = cloth.shape.smallest_height
    if 2.0 * margin >= height:
        raise ValueError(
            f"cloth {cloth.name!r}: its smallest triangle is {height:.3g} m high, and the cloth is {2.0 * margin:.3g} "
            "m thick (twice its margin), so that neighbours would push each other apart at rest; give a smaller "
            "margin= or thickness=, or a coarser mesh"
        )


def _resolve(margin: float | None, thickness: float) -> float:
    return 0.5 * thickness if margin is None else margin


def _stack(rows: list[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(len(rows), *shape)


def rotation_matrix(q: FloatArray) -> FloatArray:
    """Of a unit quaternion w, x, y, z, shape (3, 3)."""
    w, x, y, z = q
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )


def core_model(p: PackedScene) -> _core.Model:
    return _core.Model(
        names=list(p.names),
        kind=p.kind,
        margin=p.margin,
        vertex_count=p.vertex_count,
        vertices=p.vertices,
        face_count=p.face_count,
        faces=p.faces,
        has_ground=p.has_ground,
        ground_height=p.ground_height,
        ground_margin=p.ground_margin,
        thickness=p.object_thickness,
        cloth_names=list(p.cloth_names),
        cloth_margin=p.cloth_margin,
        cloth_poisson=p.cloth_poisson,
        node_count=p.node_count,
        triangle_count=p.triangle_count,
        triangles=p.triangles,
        node_rest=p.node_rest,
        warp=p.warp,
        pinned=p.pinned,
    )
