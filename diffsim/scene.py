"""What is simulated: bodies, cloths and the ground, described once, checked, and packed into arrays."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from ._arguments import (
    KINDS,
    Kind,
    body_kind,
    coefficient,
    finite_array,
    number,
    positive,
    unavailable_restitution,
    unit_quaternion,
)
from ._body_shape import Shape, mesh_shape, round_shape
from ._cloth_shape import cloth_shape
from ._handles import BodyCount, BodyHandle, ClothHandle
from ._interpenetration import GROUND, find_overlaps, find_self_crossing
from ._mass_properties import capsule_mass_properties, sphere_mass_properties
from ._mesh import read_mesh
from ._packed import Body, Cloth, Ground, PackedScene, pack_scene, rotation_matrix
from ._surfaces import Solid
from ._units import UnitsWarning, density_slip, require_resolvable_cloth, size_slip
from .materials import ClothMaterial

__all__ = ["BodyHandle", "ClothHandle", "PackedScene", "Scene"]

_SCALE_MEND = "for a mesh in other units give scale=, the metres in one of them (0.001 for millimetres)"


class Scene:
    """Bodies, cloths, the ground and gravity. Build it, hand it to `Simulator`.

    Adding an object checks it and raises at once, so that the error points at the line that is wrong; what concerns
    several objects (do they overlap?) is checked by the simulator through `validate`.

    A scene holds numbers. What gradients reach is the `State` a simulator makes of it, and the simulator's parameters.

    Args:
        gravity: Acceleration [m/s²], world, shape (3,).
    Raises: ValueError if gravity is not three finite numbers.
    """

    def __init__(self, gravity: Any = (0.0, 0.0, -9.81)) -> None:
        self._gravity = finite_array(gravity, "Scene: gravity", (3,))
        self._bodies: list[Body] = []
        self._cloths: list[Cloth] = []
        self._body_count = BodyCount()  # cloth handles hold on to it
        self._names: set[str] = set()
        self._ground: Ground | None = None
        self._warned_of_units = False

    def add_ground(
        self, height: float = 0.0, friction: float = 0.0, restitution: float = 0.0, margin: float | None = None
    ) -> None:
        """Make everything below z = height solid. A scene has one ground at most.

        Args:
            height: [m]
            friction: Coulomb's coefficient μ, as for `add_body`.
            restitution: 0, as for `add_body`.
            margin: Distance of the collision surface above `height` [m]. Default: half the thickness of what meets it.
        Raises: ValueError, NotImplementedError as `add_body`; ValueError for a second ground.
        """
        if self._ground is not None:
            raise ValueError(f"ground: the scene already has a ground, at height {self._ground.height:g} m")
        self._ground = Ground(
            height=number(height, "ground: height"),
            friction=coefficient(friction, "ground"),
            restitution=unavailable_restitution(restitution, "ground"),
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
        scale: float = 1.0,
        name: str | None = None,
    ) -> BodyHandle:
        """Add a rigid body whose surface is a triangle mesh, convex or not.

        A dynamic body needs either `density` or `mass`, and a closed mesh to distribute it over; with both `mass` and
        `inertia` the mesh may be open, and its frame's origin is taken for the centre of mass. If all faces of a closed
        mesh point inwards they are turned around. No volume may count twice: parts of a mesh may touch, and one whose
        faces point inwards is a cavity of the part around it, but they must not overlap, repeat or contain one another
        (with both `mass` and `inertia` they may, and are treated as an open mesh). Static and kinematic bodies need
        none of this: their mesh may be open (a terrain, whose frame's origin then serves as centre of mass), or closed
        with its faces inwards (a room).

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
            friction: Coulomb's coefficient μ, not negative; of two objects in contact the geometric mean acts.
            restitution: 0; contact is inelastic for now.
            margin: Distance of the collision surface from the mesh [m]. Default: half of the body's thickness, see
                `pack`.
            scale: Metres in a unit of the mesh: 0.001 for a mesh in millimetres. Vertices are multiplied with it before
                anything is made of them; all other arguments are in SI units and are not.
            name: For error messages and pictures, unique. Default: "body_" and its index.
        Returns: A handle that is the body's index.
        Raises:
            ValueError: What the error names: a degenerate or open mesh, a value out of range, a name already in use.
            TypeError: An argument of the wrong type.
            FileNotFoundError: The mesh's file.
            NotImplementedError: Restitution other than 0.
        Warns: UnitsWarning, once per scene, of a dynamic body or a cloth longer than 100 m or shorter than 0.1 mm, or a
            dynamic body of less than 5 kg/m³: most of these are slips of units.
        """
        where, name = self._name(name, "body", len(self._bodies))
        kind = body_kind(kind, where)
        vertices, faces = read_mesh(mesh, where)
        vertices *= positive(scale, f"{where}: scale", "m per unit of the mesh")
        shape = mesh_shape(vertices, faces, density, mass, inertia, kind, margin, where)
        motion = (position, orientation, velocity, angular_velocity)
        return self._add(name, where, kind, shape, motion, friction, restitution, _SCALE_MEND)

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
        """Add an exact sphere: one vertex with a margin of `radius`. Solid, unless `inertia` says otherwise.

        The radius [m] takes the place of `add_body`'s mesh, margin and scale; all other arguments are as there.

        Returns: A handle that is the body's index.
        Raises: As `add_body`; ValueError for a radius that is not positive.
        """
        where, name = self._name(name, "body", len(self._bodies))
        kind = body_kind(kind, where)
        radius = positive(radius, f"{where}: radius", "m")
        properties = sphere_mass_properties(radius)
        shape = round_shape(np.zeros((1, 3)), radius, properties, density, mass, inertia, kind, where)
        motion = (position, orientation, velocity, angular_velocity)
        return self._add(name, where, kind, shape, motion, friction, restitution, "a radius is given in them")

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
        """Add an exact capsule about the body's z axis: two vertices `length` apart with a margin of `radius`.

        Its length from end to end is `length + 2 radius` [m]. Solid, unless `inertia` says otherwise. The radius and
        the length take the place of `add_body`'s mesh, margin and scale; all other arguments are as there.

        Returns: A handle that is the body's index.
        Raises: As `add_body`; ValueError for a radius or length that is not positive.
        """
        where, name = self._name(name, "body", len(self._bodies))
        kind = body_kind(kind, where)
        radius = positive(radius, f"{where}: radius", "m")
        length = positive(length, f"{where}: length", "m")
        ends = np.array([[0.0, 0.0, -0.5 * length], [0.0, 0.0, 0.5 * length]])
        properties = capsule_mass_properties(radius, length)
        shape = round_shape(ends, radius, properties, density, mass, inertia, kind, where)
        motion = (position, orientation, velocity, angular_velocity)
        return self._add(name, where, kind, shape, motion, friction, restitution, "a radius is given in them")

    def add_cloth(
        self,
        mesh: Any,
        material: ClothMaterial | None = None,
        *,
        pinned: Any = (),
        position: Any = (0.0, 0.0, 0.0),
        orientation: Any = (1.0, 0.0, 0.0, 0.0),
        velocity: Any = (0.0, 0.0, 0.0),
        rest: Any = None,
        warp: Any = None,
        margin: float | None = None,
        scale: float = 1.0,
        friction: float = 0.0,
        restitution: float = 0.0,
        name: str | None = None,
    ) -> ClothHandle:
        """Add a cloth: a sheet whose nodes are the vertices of a triangle mesh, in the mesh's order.

        The mesh need not be closed, flat or connected. What it must be is a sheet: at most two triangles at an edge,
        every vertex in a triangle, no two vertices at the same place, none on an edge or face it is no corner of (a
        T-junction). `shapes.sheet` makes rectangular ones.

        Args:
            mesh: A path trimesh can read (vertices the file repeats at the same place become one), a
                `trimesh.Trimesh`, or (vertices, faces) of shapes (n, 3) [m] and (m, 3).
            material: Default: `ClothMaterial()`, a plain cotton.
            pinned: Indices of nodes that move as told by `Control.node_velocity`, by default not at all; or one boolean
                per node. None: no nodes.
            position: Origin of the mesh's frame, world, shape (3,) [m].
            orientation: Of the mesh's frame, quaternion w, x, y, z, shape (4,); normalised here.
            velocity: Of all nodes that are not pinned, world, shape (3,) [m/s].
            rest: Where the cloth is neither strained nor bent, shape (n, 3) [m]; only the shape matters, not its place.
                Default: the mesh's vertices.
            warp: Direction of the warp's threads in the frame of the rest shape, shape (3,); on each triangle, what of
                it lies in its plane. Default: the x axis.
            margin: Distance of the collision surface from the mesh, to both sides [m]: half of the cloth's thickness.
                Default: half of the simulator's thickness, or of its own, see `pack`.
            scale: Metres in a unit of the mesh, and of `rest`, as for `add_body`.
            friction: Coulomb's coefficient μ, as for `add_body`.
            restitution: 0, as for `add_body`.
            name: For error messages and pictures, unique. Default: "cloth_" and its index.
        Returns: A handle with the cloth's slice of the node axis, and its indices.
        Raises:
            ValueError: What the error names: a mesh that is no sheet, a pinned node out of range, a name in use.
            TypeError: An argument of the wrong type.
            FileNotFoundError: The mesh's file.
            NotImplementedError: Restitution other than 0.
        Warns: UnitsWarning, as `add_body`.
        """
        where, name = self._name(name, "cloth", len(self._cloths))
        scale = positive(scale, f"{where}: scale", "m per unit of the mesh")
        if material is None:
            material = ClothMaterial()
        if not isinstance(material, ClothMaterial):
            raise TypeError(f"{where}: material must be a diffsim.ClothMaterial, got {type(material).__name__}")
        cloth = Cloth(
            name=name,
            shape=cloth_shape(mesh, rest, warp, pinned, scale, where),
            material=material,
            position=finite_array(position, f"{where}: position", (3,)),
            orientation=unit_quaternion(orientation, where),
            velocity=finite_array(velocity, f"{where}: velocity", (3,)),
            margin=None if margin is None else positive(margin, f"{where}: margin", "m"),
            friction=coefficient(friction, where),
            restitution=unavailable_restitution(restitution, where),
        )
        self._warn_of_units(size_slip(where, float(np.ptp(cloth.shape.rest, axis=0).max()), _SCALE_MEND), 3)
        first = sum(len(c.shape.vertices) for c in self._cloths)
        self._cloths.append(cloth)
        self._names.add(name)
        nodes = slice(first, first + len(cloth.shape.vertices))
        return ClothHandle(len(self._cloths) - 1, nodes, name, self._body_count)

    def pack(self, thickness: float | None = None) -> PackedScene:
        """The scene as arrays.

        Args:
            thickness: Distance kept between surfaces of default margin [m]. Default: each object has its own, and a
                pair keeps the mean of both: 1e-3 of the shortest side of its bounding box along its mesh's axes, a
                margin that was given (so also the radius of spheres and capsules) included; of the second shortest for
                a mesh that is open, or flat up to rounding, and for a cloth (its width). A cloth has at most 0.1 of the
                smallest height of its triangles, which must stay clear of each other; static and kinematic bodies at
                most what the thickest object has that yields; the ground takes that of what meets it.
        Returns: One array per field, see `PackedScene`.
        Raises: ValueError for a thickness that is not positive, or a cloth with triangles smaller than it is thick.
        """
        return pack_scene(self._bodies, self._cloths, self._ground, self._gravity, thickness)

    def validate(self, packed: PackedScene) -> None:
        """Refuse objects that interpenetrate, with each other, the ground or themselves, as `packed` places them.

        The surfaces that must not overlap are the meshes, offset by their margin where one was given. Touching, and
        being nearer than the thickness, is fine; so is overlap up to 1e-9 of the smaller object's size, which is
        rounding. Static and kinematic bodies may overlap each other and the ground. A cloth must neither cross another
        surface nor lie inside a closed body, must not cross itself, and must not be so small and stiff that rounding
        bends it with more force than its weight.

        Args:
            packed: What `pack` returned for this scene; its positions and orientations may have been replaced.
        Raises: ValueError naming the pair that overlaps most and how deep, and how many more there are; ValueError
            naming a cloth that is too small; ValueError if `packed` is not of this scene.
        """
        names = [body.name for body in self._bodies], [cloth.name for cloth in self._cloths]
        if (packed.names, packed.cloth_names) != names:
            raise ValueError("validate: the packed arrays are of another scene, or objects were added since pack()")
        require_resolvable_cloth(packed)
        solids = self._solids(packed)
        ground_radius = (self._ground.margin or 0.0) if self._ground else 0.0
        overlaps = find_overlaps(solids, packed.ground_height if packed.has_ground else None, ground_radius)
        if overlaps:
            worst = max(overlaps, key=lambda overlap: overlap.depth)
            titles = [*(f"body {name!r}" for name in packed.names), *(f"cloth {name!r}" for name in packed.cloth_names)]
            first = titles[worst.a]
            second = "the ground" if worst.b == GROUND else titles[worst.b]
            others = "" if len(overlaps) == 1 else f" (the deepest of {len(overlaps)} pairs that do)"
            if worst.b == GROUND:
                mend = f"raise {(packed.names + packed.cloth_names)[worst.a]!r} by that much (touching is fine)"
            else:
                mend = "move them apart until they touch at most"
            depth = f"{worst.depth:.6g}" if worst.exact else f"about {worst.depth:.2g}"
            raise ValueError(f"{first} and {second} interpenetrate at the start, by {depth} m{others}; {mend}")
        for name, sheet in zip(packed.cloth_names, solids[len(self._bodies) :], strict=True):
            crossing = find_self_crossing(sheet)
            if crossing is not None:
                raise ValueError(
                    f"cloth {name!r} crosses itself at the start: triangles {crossing.a} and {crossing.b} do"
                    f"{'' if crossing.count == 1 else f' (and {crossing.count - 1} more pairs)'}; start from a shape"
                    " in which it touches itself at most"
                )

    def __repr__(self) -> str:
        kinds = [body.kind for body in self._bodies]
        counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in KINDS if kind in kinds) or "none"
        cloths = ""
        if self._cloths:
            nodes = sum(len(cloth.shape.vertices) for cloth in self._cloths)
            cloths = f"; {len(self._cloths)} {'cloth' if len(self._cloths) == 1 else 'cloths'} of {nodes} nodes"
        ground = "no ground" if self._ground is None else f"ground at {self._ground.height:g} m"
        return f"Scene({len(kinds)} bodies: {counts}{cloths}; {ground}; gravity {tuple(self._gravity.tolist())} m/s²)"

    def _name(self, name: str | None, what: str, index: int) -> tuple[str, str]:
        """How error messages call the object to be added, the `index`-th of its sort, and its name."""
        if name is None:
            number = index
            while f"{what}_{number}" in self._names:
                number += 1
            name = f"{what}_{number}"
        if not isinstance(name, str):
            raise TypeError(f"{what} {index}: name must be a string, got {type(name).__name__}")
        if not name:
            raise ValueError(f"{what} {index}: name must not be empty; leave it out to have one made up")
        if name in self._names:
            raise ValueError(f"{what} {name!r}: the name is already in use; names are unique within a scene")
        return f"{what} {name!r}", name

    def _add(
        self,
        name: str,
        where: str,
        kind: Kind,
        shape: Shape,
        motion: tuple[Any, Any, Any, Any],
        friction: float,
        restitution: float,
        units_mend: str,
    ) -> BodyHandle:
        position, orientation, velocity, angular_velocity = motion
        body = Body(
            name=name,
            kind=kind,
            shape=shape,
            position=finite_array(position, f"{where}: position", (3,)),
            orientation=unit_quaternion(orientation, where),
            velocity=finite_array(velocity, f"{where}: velocity", (3,)),
            angular_velocity=finite_array(angular_velocity, f"{where}: angular_velocity", (3,)),
            friction=coefficient(friction, where),
            restitution=unavailable_restitution(restitution, where),
        )
        if kind == "static":
            for field in ("velocity", "angular_velocity"):
                value = getattr(body, field)
                if value.any():
                    raise ValueError(
                        f"{where}: {field} must be zero for a static body, got {value.tolist()}; use kind='kinematic' "
                        "for a body that moves as told"
                    )
        if kind == "dynamic":
            extent = float(np.ptp(shape.vertices, axis=0).max()) + 2.0 * (shape.margin or 0.0)
            slip = size_slip(where, extent, units_mend)
            if slip is None and shape.density is not None:
                slip = density_slip(where, shape.density, units_mend)
            self._warn_of_units(slip, 4)
        self._bodies.append(body)
        self._body_count.value += 1
        self._names.add(name)
        return BodyHandle(len(self._bodies) - 1, name)

    def _warn_of_units(self, text: str | None, level: int) -> None:
        if text is not None and not self._warned_of_units:
            self._warned_of_units = True
            warnings.warn(text, UnitsWarning, stacklevel=level)  # the line that adds the object

    def _solids(self, packed: PackedScene) -> list[Solid]:
        solids = []
        ends = np.cumsum(packed.vertex_count)
        for index, body in enumerate(self._bodies):
            rotation = rotation_matrix(packed.orientation[index])
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
        ends = np.cumsum(packed.node_count)
        for index, cloth in enumerate(self._cloths):
            solids.append(
                Solid(
                    vertices=packed.node_position[ends[index] - packed.node_count[index] : ends[index]],
                    faces=cloth.shape.triangles,
                    radius=cloth.margin or 0.0,
                    closed=False,  # also where it is: what a bag of cloth holds is outside of the cloth
                    movable=True,
                    R_world_body=rotation_matrix(cloth.orientation),
                )
            )
        return solids
