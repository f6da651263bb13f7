"""Small scenes, each about one kind of contact. They start off the symmetric position: there, gradients have a kink."""

from __future__ import annotations

import math

import numpy as np

from .. import rotation
from ..scene import Scene
from ..shapes import box, l_shape, prism, tetrahedron, u_channel

_TILT = (0.20, 0.30, 0.40)  # roll, pitch, yaw [rad]: no edge or face parallel to another


def resting_box(*, height: float = 0.0) -> Scene:
    """A unit cube on the ground, face down, `height` [m] above touching."""
    scene = Scene()
    scene.add_ground()
    scene.add_body(box(1.0), density=1000.0, position=(0.0, 0.0, 0.5 + height), name="box")
    return scene


def tilted_box(*, height: float = 1.0, velocity: tuple[float, float, float] = (0.5, 0.2, -1.0)) -> Scene:
    """A brick that comes down on the ground with one corner first; `height` [m] is that of its centre."""
    scene = Scene()
    scene.add_ground()
    scene.add_body(
        box((1.0, 0.8, 0.6)),
        density=1000.0,
        position=(0.0, 0.0, height),
        orientation=_quaternion(_TILT),
        velocity=velocity,
        angular_velocity=(0.3, -0.2, 0.5),
        name="box",
    )
    return scene


def box_on_box(*, fixed: bool = True) -> Scene:
    """A tilted cube falls on a larger box, which is fixed, or free and stands on the ground."""
    scene = Scene()
    scene.add_ground()
    scene.add_body(
        box((1.6, 1.4, 0.8)),
        density=1000.0,
        position=(0.0, 0.0, 0.4 if fixed else 0.42),
        kind="static" if fixed else "dynamic",
        name="base",
    )
    scene.add_body(
        box(1.0),
        density=1000.0,
        position=(0.12, 0.07, 1.75),
        orientation=_quaternion((0.15, 0.10, 0.30)),
        velocity=(0.1, 0.0, -1.0),
        name="box",
    )
    return scene


def tetrahedron_on_box() -> Scene:
    """A spinning tetrahedron falls on a fixed box, point down: vertex on face, then edge on face."""
    scene = Scene()
    scene.add_body(box((2.0, 2.0, 0.5)), kind="static", position=(0.0, 0.0, -0.25), name="base")
    scene.add_body(
        tetrahedron(1.0),
        density=1000.0,
        position=(0.1, 0.05, 0.9),
        orientation=_quaternion((math.pi + 0.2, 0.15, 0.3)),
        velocity=(0.0, 0.0, -1.0),
        angular_velocity=(0.0, 0.4, 0.5),
        name="tetrahedron",
    )
    return scene


def tetrahedron_in_groove() -> Scene:
    """A tetrahedron falls edge down into a fixed V-shaped groove along y: edges cross edges, faces meet faces."""
    scene = Scene()
    # A block 2 m wide whose upper side falls from z = 1 at both rims to z = 0 in the middle; extruded along its own z.
    outline = [[-1.0, -0.4], [1.0, -0.4], [1.0, 1.0], [0.0, 0.0], [-1.0, 1.0]]
    groove = prism(outline, 2.0)
    scene.add_body(groove, kind="static", orientation=_quaternion((0.5 * math.pi, 0.0, 0.0)), name="groove")
    scene.add_body(
        tetrahedron(0.8),
        density=1000.0,
        position=(0.05, 0.03, 1.1),
        orientation=_quaternion((math.pi + 0.1, 0.25, 0.2)),
        velocity=(0.0, 0.0, -1.0),
        name="tetrahedron",
    )
    return scene


def two_spheres(*, mass_ratio: float = 1.0, speed: float = 1.0, gap: float = 0.2) -> Scene:
    """Two spheres of radius 0.5 m, of 1 kg and `mass_ratio` kg, on one line, closing at `speed` [m/s]; no gravity."""
    scene = Scene(gravity=(0.0, 0.0, 0.0))
    x = 0.5 + 0.5 * gap
    scene.add_sphere(0.5, mass=1.0, position=(-x, 0.0, 0.0), velocity=(0.5 * speed, 0.0, 0.0), name="left")
    scene.add_sphere(0.5, mass=mass_ratio, position=(x, 0.0, 0.0), velocity=(-0.5 * speed, 0.0, 0.0), name="right")
    return scene


def nonconvex_pair() -> Scene:
    """A non-convex angle falls into a channel that is free, too, and stands on the ground."""
    scene = Scene()
    scene.add_ground()
    scene.add_body(u_channel(1.2, 0.7, 1.2, 0.2), density=1000.0, position=(0.0, 0.0, 0.02), name="channel")
    scene.add_body(
        l_shape(0.8, 0.3, 0.4),
        density=1000.0,
        position=(0.06, 0.05, 1.25),
        orientation=_quaternion((0.5 * math.pi + 0.1, 0.15, 0.25)),
        velocity=(0.0, 0.0, -1.0),
        name="angle",
    )
    return scene


def kinematic_pusher(*, speed: float = 1.0) -> Scene:
    """A plate that moves along x at `speed` [m/s] pushes a box that stands on the ground, off its middle."""
    scene = Scene()
    scene.add_ground()
    scene.add_body(
        box((0.2, 2.0, 0.8)), kind="kinematic", position=(-1.0, 0.1, 0.5), velocity=(speed, 0.0, 0.0), name="pusher"
    )
    scene.add_body(
        box(1.0), density=1000.0, position=(0.0, 0.0, 0.51), orientation=_quaternion((0.0, 0.0, 0.2)), name="box"
    )
    return scene


def _quaternion(rpy: tuple[float, float, float]) -> list[float]:
    return [float(x) for x in rotation.from_rpy(np.array(rpy))]
