"""Small scenes that tests of the layer share, and how states are compared there."""

from __future__ import annotations

from typing import Any

import torch

import diffsim as ds
from diffsim.scene import PackedScene

STATE_FIELDS = ("position", "orientation", "velocity", "angular_velocity")
BOX = (1.0, 0.7, 0.4)
CUBE = ds.shapes.box(1.0)
# Sums of a few terms of order one, in another order.
ROUNDING = 1e-12
# The same where contact, stiff as it is, multiplies what rounding leaves.
CONTACT_ROUNDING = 1e-9


def make_scene() -> ds.Scene:
    scene = ds.Scene()
    scene.add_body(
        ds.shapes.box(BOX),
        density=2.0,
        position=(0, 0, 5),
        orientation=(0.8, 0.6, 0, 0),
        velocity=(1, 0, 2),
        angular_velocity=(1.0, -2.0, 0.5),
        name="box",
    )
    scene.add_sphere(0.25, density=3.0, position=(4, 0, 5), velocity=(0, 1, 0), name="ball")
    return scene


def one_body(**arguments: Any) -> PackedScene:
    """A scene's arrays: of a cube of 1000 kg, unless the arguments of `add_body` say otherwise."""
    scene = ds.Scene()
    scene.add_body(arguments.pop("mesh", CUBE), **{"density": 1000.0, **arguments})
    return scene.pack()


def open_box() -> ds.shapes.Mesh:
    vertices, faces = CUBE
    return vertices, faces[2:]


def falling_box(**options: Any) -> ds.Simulator:
    """A tilted box about to hit the ground."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(
        ds.shapes.box(BOX), density=2.0, position=(0, 0, 0.6), orientation=(1, 0.3, 0.1, 0), velocity=(0, 0, -5)
    )
    return ds.Simulator(scene, dt=0.01, **options)


def landing_box() -> ds.Simulator:
    """A tilted box that lands on the ground in its third step."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(
        ds.shapes.box(BOX),
        density=2.0,
        position=(0, 0, 0.5),
        orientation=(1, 0.3, 0.1, 0),
        velocity=(1, 0, -3),
    )
    return ds.Simulator(scene, dt=0.01)


def assert_same(a: ds.State, b: ds.State) -> None:
    for name in STATE_FIELDS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def only_read(sim: ds.Simulator, control: ds.Control) -> ds.Control:
    """The control with zeros where nothing would read it: what is not zero there is refused."""
    kind, pinned = torch.from_numpy(sim._packed.kind), torch.from_numpy(sim._packed.pinned)
    reads = {"force": kind == 0, "torque": kind == 0, "body_velocity": kind == 2, "body_angular_velocity": kind == 2}
    given = {name: getattr(control, name) for name in (*reads, "node_velocity")}
    reads["node_velocity"] = pinned == 1
    return control.replace(**{name: t * reads[name][:, None] for name, t in given.items() if t is not None})
