"""What is simulated: bodies and the ground, described once, checked, and packed into arrays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ._arguments import KINDS, Kind, body_kind, finite_array, number, positive, unavailable, unit_quaternion
from ._body_shape import Shape, mesh_shape, round_shape
from ._interpenetration import GROUND, Solid, find_overlaps
from ._mass_properties import FloatArray, IntArray, capsule_mass_properties, sphere_mass_properties
from ._mesh import read_mesh

# The default thickness as a fraction of the smallest extent in the scene; without any extent, of one metre.
_RELATIVE_THICKNESS = 1e-3
# A side of a mesh's box shorter than this fraction of its longest is rounding of a flat mesh, not an extent.
_FLAT = 1e-9


class BodyHandle(int):
    """The index of a body in the body axis of states, controls and parameters: `state.position[..., cube, :]`."""

    name: str  #: as given to, or made up by, the scene

    def __new__(cls, index: int, name: str) -> BodyHandle:  # noqa: D102
        handle = super().__new__(cls, index)
        handle.name = name
        return handle

    def __getnewargs__(self) -> tuple[int, str]:  # type: ignore[override]  # what pickle and deepcopy call __new__ with
        return int(self), self.name

    def __repr__(self) -> str:
        return f"BodyHandle({int(self)}, {self.name!r})"


@dataclass(frozen=True)
class PackedScene:
    """A scene as arrays, its n bodies in the order they were added.

    The body frame has its origin at the centre of mass, and the axes of the mesh.
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
    friction: FloatArray  #: bodies, then cloths, then the ground if there is one, shape (n_objects,)
    restitution: FloatArray  #: likewise
    gravity: FloatArray  #: shape (3,)  [m/s²]
    has_ground: bool
    ground_height: float  #: the half-space z <= ground_height is solid; 0 without ground  [m]
    ground_margin: float  #: resolved; 0 without ground  [m]
    thickness: float  #: distance kept between surfaces of default margin  [m]


@dataclass(frozen=True)
class _Body:
    name: str
    kind: Kind
    shape: Shape
    position: FloatArray  #: of the mesh's frame, world [m]
    orientation: FloatArray
    velocity: FloatArray
    angular_velocity: FloatArray
    friction: float
    restitution: float


@dataclass(frozen=True)
class _Ground:
    height: float
    friction: float
    restitution: float
    margin: float | None


class Scene:
    """Bodies, the ground and gravity. Build it, hand it to `Simulator`.

    Adding an object checks it and raises at once, so that the error points at the line that is wrong; what concerns
    several objects (do they overlap?) is checked by the simulator through `validate`.

    Args:
        gravity: Acceleration [m/s²], world, shape (3,).
    Raises: ValueError if gravity is not three finite numbers.
    """

    def __init__(self, gravity: Any = (0.0, 0.0, -9.81)) -> None:
        self._gravity = finite_array(gravity, "Scene: gravity", (3,))
        self._bodies: list[_Body] = []
        self._names: set[str] = set()
        self._ground: _Ground | None = None

    def add_ground(
        self, height: float = 0.0, friction: float = 0.0, restitution: float = 0.0, margin: float | None = None
    ) -> None:
        """Make everything below z = height solid. A scene has one ground at most.

        Args:
            height: [m]
            friction: 0, as for `add_body`.
            restitution: 0, as for `add_body`.
            margin: Distance of the collision surface above `height` [m]. Default: half of the simulator's thickness.
        Raises: ValueError, NotImplementedError as `add_body`; ValueError for a second ground.
        """
        if self._ground is not None:
            raise ValueError(f"ground: the scene already has a ground, at height {self._ground.height:g} m")
        self._ground = _Ground(
            height=number(height, "ground: height"),
            friction=unavailable(friction, "friction", "ground"),
            restitution=unavailable(restitution, "restitution", "ground"),
            margin=None if margin is None else positive(margin, "ground: margin", "m"),
        )

    def add_body(
        self,
        mesh: Any,
        *,
        density: float | None = None,
        mass: float | None = None,
        inertia: Any = None,
        position: Any = (0.0, 0.0, 0.0),
        orientation: Any = (1.0, 0.0, 0.0, 0.0),
        velocity: Any = (0.0, 0.0, 0.0),
        angular_velocity: Any = (0.0, 0.0, 0.0),
        kind: Kind = "dynamic",
        friction: float = 0.0,
        restitution: float = 0.0,
        margin: float | None = None,
        name: str | None = None,
    ) -> BodyHandle:
        """Add a rigid body whose surface is a triangle mesh, convex or not.

        A dynamic body needs either `density` or `mass`, and a closed mesh to distribute it over; with both `mass` and
        `inertia` the mesh may be open, and its frame's origin is taken for the centre of mass. If all faces of a closed
        mesh point inwards they are turned around. Static and kinematic bodies need none of this: their mesh may be open
        (a terrain, whose frame's origin then serves as centre of mass), or closed with its faces inwards (a room).

        Args:
            mesh: A path trimesh can read (vertices at the same place become one), a `trimesh.Trimesh`, or (vertices,
                faces) of shapes (n, 3) [m] and (m, 3). Vertices no face uses are dropped.
            density: [kg/m³]
            mass: [kg], spread evenly over the volume unless `inertia` is given.
            inertia: About the centre of mass, along the mesh's axes, shape (3, 3) [kg·m²]; replaces the mesh's.
            position: Origin of the mesh's frame, world, shape (3,) [m]. (`State.position` is the centre of mass.)
            orientation: Of the mesh's frame, quaternion w, x, y, z, shape (4,); normalised here.
            velocity: Of the centre of mass, world, shape (3,) [m/s].
            angular_velocity: World, shape (3,) [rad/s].
            kind: "dynamic", "static" (never moves) or "kinematic" (moves as told, pushes others, is not pushed).
            friction: 0; contact is frictionless for now.
            restitution: 0; contact is inelastic for now.
            margin: Distance of the collision surface from the mesh [m]. Default: half of the simulator's thickness.
            name: For error messages and pictures, unique. Default: "body_" and its index.
        Returns: A handle that is the body's index.
        Raises:
            ValueError: What the error names: a degenerate or open mesh, a value out of range, a name already in use.
            TypeError: An argument of the wrong type.
            FileNotFoundError: The mesh's file.
            NotImplementedError: Friction or restitution other than 0.
        """
        where, name = self._name(name)
        kind = body_kind(kind, where)
        vertices, faces = read_mesh(mesh, where)
        shape = mesh_shape(vertices, faces, density, mass, inertia, kind, margin, where)
        motion = (position, orientation, velocity, angular_velocity)
        return self._add(name, where, kind, shape, motion, friction, restitution)

    def add_sphere(
        self,
        radius: float,
        *,
        density: float | None = None,
        mass: float | None = None,
        inertia: Any = None,
        position: Any = (0.0, 0.0, 0.0),
        orientation: Any = (1.0, 0.0, 0.0, 0.0),
        velocity: Any = (0.0, 0.0, 0.0),
        angular_velocity: Any = (0.0, 0.0, 0.0),
        kind: Kind = "dynamic",
        friction: float = 0.0,
        restitution: float = 0.0,
        name: str | None = None,
    ) -> BodyHandle:
        """Add an exact sphere: one vertex with a margin of `radius` [m]. Solid, unless `inertia` says otherwise.

        Everything else as for `add_body`; the radius takes the place of the margin.
        """
        where, name = self._name(name)
        kind = body_kind(kind, where)
        radius = positive(radius, f"{where}: radius", "m")
        properties = sphere_mass_properties(radius)
        shape = round_shape(np.zeros((1, 3)), radius, properties, density, mass, inertia, kind, where)
        motion = (position, orientation, velocity, angular_velocity)
        return self._add(name, where, kind, shape, motion, friction, restitution)

    def add_capsule(
        self,
        radius: float,
        length: float,
        *,
        density: float | None = None,
        mass: float | None = None,
        inertia: Any = None,
        position: Any = (0.0, 0.0, 0.0),
        orientation: Any = (1.0, 0.0, 0.0, 0.0),
        velocity: Any = (0.0, 0.0, 0.0),
        angular_velocity: Any = (0.0, 0.0, 0.0),
        kind: Kind = "dynamic",
        friction: float = 0.0,
        restitution: float = 0.0,
        name: str | None = None,
    ) -> BodyHandle:
        """Add an exact capsule about the body's z axis: two vertices `length` apart with a margin of `radius` [m].

        Its total length is `length + 2 radius`. Solid, unless `inertia` says otherwise. Everything else as for
        `add_body`; the radius takes the place of the margin.
        """
        where, name = self._name(name)
        kind = body_kind(kind, where)
        radius = positive(radius, f"{where}: radius", "m")
        length = positive(length, f"{where}: length", "m")
        ends = np.array([[0.0, 0.0, -0.5 * length], [0.0, 0.0, 0.5 * length]])
        properties = capsule_mass_properties(radius, length)
        shape = round_shape(ends, radius, properties, density, mass, inertia, kind, where)
        motion = (position, orientation, velocity, angular_velocity)
        return self._add(name, where, kind, shape, motion, friction, restitution)

    def add_cloth(self, *args: Any, **kwargs: Any) -> Any:
        """Cloth is not part of this version.

        Raises: NotImplementedError, always.
        """
        raise NotImplementedError("add_cloth: cloth is not implemented yet; this version simulates rigid bodies only")

    def pack(self, thickness: float | None = None) -> PackedScene:
        """The scene as arrays.

        Args:
            thickness: Distance kept between surfaces of default margin [m]. Default: 1e-3 of the smallest extent in the
                scene, that is of the shortest side of any body's bounding box along its mesh's axes, margins that were
                given (so also the radius of spheres and capsules) included, sides of length zero (of a flat static
                mesh) left out; 1e-3 m if there is no body.
        Raises: ValueError for a thickness that is not positive.
        """
        if thickness is None:
            thickness = _RELATIVE_THICKNESS * self._smallest_extent()
        thickness = positive(thickness, "thickness", "m")
        bodies, shapes = self._bodies, [body.shape for body in self._bodies]
        objects: list[_Body | _Ground] = [*bodies, *([] if self._ground is None else [self._ground])]
        orientation = _stack([b.orientation for b in bodies], (4,))
        mesh_offset = _stack([s.center for s in shapes], (3,))
        placed = [b.position + _rotation_matrix(b.orientation) @ b.shape.center for b in bodies]
        return PackedScene(
            names=[b.name for b in bodies],
            kind=np.array([KINDS.index(b.kind) for b in bodies], dtype=np.int32),
            margin=np.array([0.5 * thickness if s.margin is None else s.margin for s in shapes], dtype=np.float64),
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
            friction=np.array([o.friction for o in objects], dtype=np.float64),
            restitution=np.array([o.restitution for o in objects], dtype=np.float64),
            gravity=self._gravity.copy(),
            has_ground=self._ground is not None,
            ground_height=0.0 if self._ground is None else self._ground.height,
            ground_margin=0.0 if self._ground is None else _resolve(self._ground.margin, thickness),
            thickness=thickness,
        )

    def validate(self, packed: PackedScene) -> None:
        """Refuse bodies that interpenetrate, with each other or the ground, as `packed` places them.

        The surfaces that must not overlap are the meshes, offset by their margin where one was given. Touching, and
        being nearer than the thickness, is fine; so is overlap up to 1e-9 of the smaller body's size, which is
        rounding. Static and kinematic bodies may overlap each other and the ground.

        Args:
            packed: What `pack` returned for this scene; its positions and orientations may have been replaced.
        Raises: ValueError naming the pair that overlaps most and how deep, and how many more there are; ValueError if
            `packed` is not of this scene.
        """
        if packed.names != [body.name for body in self._bodies]:
            raise ValueError("validate: the packed arrays are of another scene, or bodies have been added since pack()")
        solids = self._solids(packed)
        ground_radius = (self._ground.margin or 0.0) if self._ground else 0.0
        overlaps = find_overlaps(solids, packed.ground_height if packed.has_ground else None, ground_radius)
        if not overlaps:
            return
        worst = max(overlaps, key=lambda overlap: overlap.depth)
        first = f"body {packed.names[worst.a]!r}"
        second = "the ground" if worst.b == GROUND else f"body {packed.names[worst.b]!r}"
        others = "" if len(overlaps) == 1 else f" (the deepest of {len(overlaps)} pairs that do)"
        if worst.b == GROUND:
            mend = f"raise {packed.names[worst.a]!r} by that much (touching is fine)"
        else:
            mend = "move them apart until they touch at most"
        raise ValueError(f"{first} and {second} interpenetrate at the start, by {worst.depth:.6g} m{others}; {mend}")

    def __repr__(self) -> str:
        kinds = [body.kind for body in self._bodies]
        counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in KINDS if kind in kinds) or "none"
        ground = "no ground" if self._ground is None else f"ground at {self._ground.height:g} m"
        return f"Scene({len(kinds)} bodies: {counts}; {ground}; gravity {tuple(self._gravity.tolist())} m/s²)"

    def _name(self, name: str | None) -> tuple[str, str]:
        """How error messages call the object to be added, and its name."""
        if name is None:
            index = len(self._bodies)
            while f"body_{index}" in self._names:
                index += 1
            name = f"body_{index}"
        if not isinstance(name, str):
            raise TypeError(f"body {len(self._bodies)}: name must be a string, got {type(name).__name__}")
        if not name:
            raise ValueError(f"body {len(self._bodies)}: name must not be empty; leave it out to have one made up")
        if name in self._names:
            raise ValueError(f"body {name!r}: the name is already in use; names are unique within a scene")
        return f"body {name!r}", name

    def _add(
        self,
        name: str,
        where: str,
        kind: Kind,
        shape: Shape,
        motion: tuple[Any, Any, Any, Any],
        friction: float,
        restitution: float,
    ) -> BodyHandle:
        position, orientation, velocity, angular_velocity = motion
        body = _Body(
            name=name,
            kind=kind,
            shape=shape,
            position=finite_array(position, f"{where}: position", (3,)),
            orientation=unit_quaternion(orientation, where),
            velocity=finite_array(velocity, f"{where}: velocity", (3,)),
            angular_velocity=finite_array(angular_velocity, f"{where}: angular_velocity", (3,)),
            friction=unavailable(friction, "friction", where),
            restitution=unavailable(restitution, "restitution", where),
        )
        if kind == "static":
            for field in ("velocity", "angular_velocity"):
                value = getattr(body, field)
                if value.any():
                    raise ValueError(
                        f"{where}: {field} must be zero for a static body, got {value.tolist()}; use kind='kinematic' "
                        "for a body that moves as told"
                    )
        self._bodies.append(body)
        self._names.add(name)
        return BodyHandle(len(self._bodies) - 1, name)

    def _solids(self, packed: PackedScene) -> list[Solid]:
        solids = []
        ends = np.cumsum(packed.vertex_count)
        for index, body in enumerate(self._bodies):
            rotation = _rotation_matrix(packed.orientation[index])
            vertices = packed.vertices[ends[index] - packed.vertex_count[index] : ends[index]]
            solids.append(
                Solid(
                    vertices=vertices @ rotation.T + packed.position[index],
                    faces=body.shape.faces,
                    radius=body.shape.margin or 0.0,
                    closed=body.shape.closed,
                    movable=body.kind == "dynamic",
                    R_world_body=rotation,
                )
            )
        return solids

    def _smallest_extent(self) -> float:
        smallest = math.inf
        for body in self._bodies:
            sides = np.ptp(body.shape.vertices, axis=0) + 2.0 * (body.shape.margin or 0.0)
            smallest = min(smallest, float(sides[sides > _FLAT * sides.max()].min()))
        return smallest if math.isfinite(smallest) else 1.0


def _resolve(margin: float | None, thickness: float) -> float:
    return 0.5 * thickness if margin is None else margin


def _stack(rows: list[FloatArray], shape: tuple[int, ...]) -> FloatArray:
    return np.array(rows, dtype=np.float64).reshape(len(rows), *shape)


def _rotation_matrix(q: FloatArray) -> FloatArray:
    """Of a unit quaternion w, x, y, z, shape (3, 3)."""
    w, x, y, z = q
    return np.array(
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
        ]
    )
