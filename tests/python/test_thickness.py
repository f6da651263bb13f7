"""The distance kept between surfaces belongs to the objects: a thin one makes no other pair thin."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import diffsim as ds

WIRE = ds.shapes.box((1.0, 1e-4, 1e-4))  # 0.1 mm
STATE_FIELDS = ("position", "orientation", "velocity", "angular_velocity")


def falling_boxes(*, wire: bool = False, kind: str = "static") -> ds.Scene:
    """Two boxes of a metre fall on the ground, one onto the other. A wire may lie 3 m beside them."""
    scene = ds.Scene()
    scene.add_ground()
    for k in range(2):
        orientation = (1.0, 0.05 * (k + 1), 0.03, 0.1)
        scene.add_body(
            ds.shapes.box(1.0), density=1000.0, position=(0.1 * k, 0.0, 0.7 + 1.3 * k), orientation=orientation
        )
    if wire:
        scene.add_body(WIRE, density=8000.0, kind=kind, position=(0.0, 3.0, 1.0))
    return scene


def settled_on(scene: ds.Scene, steps: int = 60, **settings: object) -> tuple[ds.Simulator, ds.State]:
    sim = ds.Simulator(scene, dt=0.01, num_threads=1, on_failure="raise", **settings)  # type: ignore[arg-type]
    with torch.no_grad():
        return sim, sim.rollout(sim.initial_state(), None, steps)[-1]


@pytest.mark.parametrize("kind", ["static", "dynamic"])
def test_a_wire_leaves_what_other_bodies_do_as_it_is(kind: str) -> None:
    alone, expected = settled_on(falling_boxes())
    beside, found = settled_on(falling_boxes(wire=True, kind=kind))
    assert alone.info is not None
    assert beside.info is not None
    assert alone.info.contacts > 0
    for name in STATE_FIELDS:
        assert torch.equal(getattr(found, name)[:2], getattr(expected, name)), name
    if kind == "static":
        assert (beside.info.contacts, beside.info.iterations) == (alone.info.contacts, alone.info.iterations)


@pytest.mark.parametrize("noise", [1e-8, -1e-8, 1e-7, 1e-5])
def test_a_box_slides_on_a_floor_that_is_almost_flat(noise: float) -> None:
    floor = np.array([[-2, -2, 0], [2, -2, 0], [2, 2, noise], [-2, 2, 0]]), np.array([[0, 1, 2], [0, 2, 3]])
    scene = ds.Scene()
    scene.add_body(floor, kind="static")
    box = scene.add_body(ds.shapes.box(0.4), density=500.0, position=(0.3, 0.13, 0.2005), velocity=(1.5, 0.1, 0.0))
    sim = ds.Simulator(scene, dt=0.01, on_failure="raise")
    assert sim.thickness == pytest.approx(4e-4)
    state = sim.initial_state()
    for _ in range(20):
        state = sim(state)
    assert state.velocity[box].tolist() == pytest.approx([1.5, 0.1, 0.0], abs=1e-3)
    assert float(state.position[box, 2]) == pytest.approx(0.2004, abs=2e-5)


def test_a_pair_keeps_the_sum_of_the_margins() -> None:
    """A small box on a large one and on the ground; a large one with a margin of its own."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(1.0), kind="static", position=(0.0, 0.0, -0.5))
    scene.add_body(ds.shapes.box(1.0), kind="static", position=(3.0, 0.0, -0.5), margin=0.01)
    small = [scene.add_body(ds.shapes.box(0.1), density=1000.0, position=(x, 0.0, 0.08)) for x in (0.0, 3.0, 6.0)]
    scene.add_body(ds.shapes.box(1.0), density=1000.0, position=(9.0, 0.0, 0.6))  # so that large ones may be thick
    sim, state = settled_on(scene)
    gap = state.position[small, 2] - 0.05
    assert gap.tolist() == pytest.approx([5e-4 + 5e-5, 0.01 + 5e-5, 1e-4], rel=2e-3)
    assert abs(float(sim.min_distance(state))) < 1e-6


def test_gradients_through_a_mixed_pair_are_right() -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box((1.0, 1.0, 0.5)), density=500.0, position=(0.0, 0.0, 0.253))
    scene.add_body(
        ds.shapes.box((0.1, 0.12, 0.02)),
        density=2000.0,
        position=(0.03, 0.02, 0.52),
        orientation=(1.0, 0.02, 0.03, 0.2),
    )
    sim = ds.Simulator(scene, dt=0.01, on_failure="raise")
    with torch.no_grad():
        state = sim.rollout(sim.initial_state(), None, 12)[-1]
    assert sim.info is not None
    assert sim.info.contacts > 4
    report = ds.diagnostics.gradcheck(sim, state, steps=2)
    assert report.median_error < 1e-5


def test_a_thickness_that_is_given_is_that_of_all_objects() -> None:
    sim, state = settled_on(falling_boxes(wire=True), thickness=1e-3)
    assert sim.thickness == 1e-3
    default, expected = settled_on(falling_boxes())  # a thousandth of a metre
    assert default.thickness == 1e-3
    for name in STATE_FIELDS:
        assert torch.equal(getattr(state, name)[:2], getattr(expected, name)), name
