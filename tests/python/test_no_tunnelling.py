"""A box thrown at a thin plate never gets to the other side: judged by ipctk and by which side its corners are on."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from penetration import PenetrationCheck, point_triangle_distance, segment_distance, winding_number

import diffsim as ds
from diffsim import rotation

SPEEDS = (10.0, 100.0, 1000.0, 10000.0)
PLATE = 0.002  # [m]
BOX = 0.1
ORIENTATIONS = {
    "flat": (0.0, 0.0, 0.0),
    "edge first": (math.pi / 4, 0.0, 0.0),
    "corner first": (math.pi / 4, math.atan(math.sqrt(0.5)), 0.0),
    "askew": (0.3, 0.5, 0.7),
}


def thrown(speed: float, rpy: tuple[float, float, float], spin: float, oblique: float, kind: str = "box") -> ds.Scene:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((2.0, 2.0, PLATE)), kind="static", name="plate")
    mesh = {
        "box": ds.shapes.box(BOX),
        "angle": ds.shapes.l_shape(BOX, 0.3 * BOX, 0.3 * BOX),
        "torus": ds.shapes.torus(0.35 * BOX, 0.12 * BOX, 8, 5),
    }[kind]
    scene.add_body(
        mesh,
        density=1000.0,
        position=(0.02, 0.03, 0.15),
        orientation=rotation.from_rpy(np.array(rpy)),
        velocity=(oblique * speed, 0.0, -speed),
        angular_velocity=(spin, -0.7 * spin, 0.4 * spin),
        name="box",
    )
    return scene


def rolled_out(scene: ds.Scene) -> tuple[ds.Simulator, ds.State, ds.State]:
    """The simulator, the state at the start, and 20 steps."""
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    with warnings.catch_warnings():
        # A step that gives up must be safe, too: what is judged here is where things are.
        warnings.simplefilter("ignore", ds.ConvergenceWarning)
        warnings.simplefilter("ignore", ds.FastImpactWarning)
        return sim, state, sim.rollout(state, None, 20)


def assert_stays_above(scene: ds.Scene, speed: float) -> ds.State:
    sim, state, trajectory = rolled_out(scene)
    check = PenetrationCheck(scene, sim.thickness)
    for step, frame in enumerate(trajectory):
        assert check.problems(sim, frame) == [], step
        corners = sim.vertices(frame)[8:]
        over_plate = bool((corners[:, :2].abs() < 1.0).all())
        if over_plate:
            assert float(corners[:, 2].min()) > 0.5 * PLATE, step
        if not over_plate or float(corners[:, 2].min()) > 1.0:
            break  # it has left, over the rim or upwards
    assert float((trajectory.velocity[:, 1] - state.velocity[1]).norm(dim=-1).max()) > 0.5 * speed  # it hit
    return trajectory


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("orientation", ORIENTATIONS)
@pytest.mark.parametrize("spin", [0.0, 20.0])
def test_a_box_does_not_pass_a_plate(speed: float, orientation: str, spin: float) -> None:
    assert_stays_above(thrown(speed, ORIENTATIONS[orientation], spin, 0.0), speed)


@pytest.mark.parametrize("speed", SPEEDS)
def test_a_box_that_spins_fast_does_not_pass_a_plate(speed: float) -> None:
    assert_stays_above(thrown(speed, ORIENTATIONS["askew"], 500.0, 0.0), speed)


@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("kind", ["angle", "torus"])
def test_a_mesh_that_is_not_convex_does_not_pass_a_plate(speed: float, kind: str) -> None:
    assert_stays_above(thrown(speed, ORIENTATIONS["askew"], 20.0, 0.0, kind), speed)


@pytest.mark.parametrize("speed", [10.0, 100.0])
def test_a_box_thrown_sideways_does_not_pass_a_plate(speed: float) -> None:
    assert_stays_above(thrown(speed, ORIENTATIONS["askew"], 20.0, 0.2), speed)


@pytest.mark.parametrize("speed", SPEEDS)
def test_two_free_boxes_do_not_pass_through_each_other(speed: float) -> None:
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    for side, rpy in ((-1.0, (0.3, 0.5, 0.7)), (1.0, (0.0, 0.1, 0.2))):
        scene.add_body(
            ds.shapes.box(BOX),
            density=1000.0,
            position=(side * 0.3, 0.01 * side, 0.0),
            orientation=rotation.from_rpy(np.array(rpy)),
            velocity=(-side * 0.5 * speed, 0.0, 0.0),
        )
    sim, state, trajectory = rolled_out(scene)
    check = PenetrationCheck(scene, sim.thickness)
    for frame in trajectory:
        assert check.problems(sim, frame) == []
    # They meet head-on, so each must feel the other, and not come out behind it as if nothing had been there.
    assert float(trajectory.position[0, 1, 0] - trajectory.position[0, 0, 0]) > 0.0
    assert float((trajectory.velocity - state.velocity).abs().max()) > 0.1 * speed


# ---- the judge itself ------------------------------------------------------------------------------------------------


def placed(*positions: tuple[float, float, float], shapes: str = "boxes") -> tuple[ds.Scene, ds.Simulator]:
    scene = ds.Scene()
    scene.add_ground()
    for index, position in enumerate(positions):
        if shapes == "boxes":
            scene.add_body(ds.shapes.box(1.0 / (1 + 3 * index)), density=1.0, position=position)
        else:
            scene.add_sphere(0.5, density=1.0, position=position)
    return scene, ds.Simulator(scene, dt=0.01, check=False)


@pytest.mark.parametrize(
    ("positions", "shapes", "text"),
    [
        (((0, 0, 2), (0.5, 0, 2)), "boxes", "intersect"),
        (((0, 0, 2), (0.1, 0, 2)), "boxes", "body_1 is inside body_0"),
        (((0, 0, 0.49),), "boxes", "body_0 is -0.01 m above the ground"),
        (((0, 0, 2), (0.99, 0, 2)), "spheres", "0.99 m between their axes"),
        (((0, 0, 0.49),), "spheres", "body_0 is 0.49 m above the ground"),
    ],
)
def test_penetration_is_found(positions: tuple[tuple[float, float, float], ...], shapes: str, text: str) -> None:
    scene, sim = placed(*positions, shapes=shapes)
    p = scene.pack(sim.thickness)
    state = ds.State(torch.from_numpy(p.position), torch.from_numpy(p.orientation))
    problems = PenetrationCheck(scene, sim.thickness).problems(sim, state)
    assert problems
    assert any(text in problem for problem in problems)
    apart = state.replace(position=state.position + 2.0 * (1.0 + torch.arange(len(positions)))[:, None])
    assert PenetrationCheck(scene, sim.thickness).problems(sim, apart) == []


def test_distances_of_the_judge() -> None:
    ipctk = pytest.importorskip("ipctk")
    rng = np.random.default_rng(0)
    for _ in range(200):
        points = rng.normal(size=(4, 3))
        exact = math.sqrt(ipctk.edge_edge_distance(*points))
        assert float(segment_distance(points[:2], points[2:])) == pytest.approx(exact, rel=1e-9)
        exact = math.sqrt(ipctk.point_triangle_distance(*points))
        assert float(point_triangle_distance(points[0], points[None, 1:])[0]) == pytest.approx(exact, rel=1e-9)
    vertices, faces = ds.shapes.torus()
    assert winding_number(np.array([0.4, 0.01, 0.0]), vertices[faces]) == pytest.approx(1.0)
    assert winding_number(np.array([0.0, 0.0, 0.0]), vertices[faces]) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("speed", [15.0, 20.0, 30.0, 50.0, 100.0])
def test_a_box_that_slides_on_the_ground_does_not_pass_one_at_rest(speed: float) -> None:
    scene = ds.Scene()
    scene.add_ground()
    for x in (-0.25, 0.0):
        scene.add_body(ds.shapes.box(0.1), density=1000.0, position=(x, 0.0, 0.05))
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.rollout(sim.initial_state(), None, 5)[-1]  # at rest, in contact with the ground
    velocity = state.velocity.clone()
    velocity[0, 0] = speed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ds.ConvergenceWarning)
        warnings.simplefilter("ignore", ds.FastImpactWarning)
        end = sim(state.replace(velocity=velocity))
    assert end.position[0, 0] < end.position[1, 0]
    assert end.velocity[1, 0] > 1e-3  # it was pushed
    assert sim.kinetic_energy(end) <= 0.5 * sim.mass[0] * speed**2


@pytest.mark.parametrize("speed", [5.0, 10.0, 20.0])
def test_balls_that_glance_off_each_other_gain_no_energy(speed: float) -> None:
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_sphere(0.1, density=1000.0, position=(-0.15, 0.0, 0.0), velocity=(speed, 0.0, 0.0))
    scene.add_sphere(0.1, density=1000.0, position=(0.15, 0.05, 0.0), velocity=(-speed, 0.0, 0.0))
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    energy = sim.kinetic_energy(state)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ds.ConvergenceWarning)
        warnings.simplefilter("ignore", ds.FastImpactWarning)
        state = sim.rollout(state, None, 5)[-1]
    assert sim.kinetic_energy(state) < 0.6 * energy  # they met: the approach along the line of centres is gone


@pytest.mark.parametrize(("speed", "impacts"), [(5.0, 0), (14.0, 0), (16.0, 1), (50.0, 1)])
def test_impacts_too_fast_for_the_step_are_counted(speed: float, impacts: int) -> None:
    """Two balls 0.2 m across that meet in the second step: 0.05 to 0.5 m of way in it."""
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_sphere(0.1, density=1000.0, position=(-0.2 - 0.015 * speed, 0.0, 0.0), velocity=(speed, 0.0, 0.0))
    scene.add_sphere(0.1, density=1000.0, position=(0.0, 0.0, 0.0))
    sim = ds.Simulator(scene, dt=0.01)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(2):
            sim.rollout(sim.initial_state(), None, 2)
    assert sim.info is not None
    assert sim.info.fast_impacts == impacts
    assert [w.category for w in caught if w.category is ds.FastImpactWarning] == [ds.FastImpactWarning] * impacts
    if impacts:
        assert sim(sim.initial_state()).position.isfinite().all()  # a step of free motion
        assert sim.info.fast_impacts == 0


def test_the_ground_is_never_too_fast() -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_sphere(0.1, density=1000.0, position=(0.0, 0.0, 0.3), velocity=(0.0, 0.0, -1000.0))
    sim = ds.Simulator(scene, dt=0.01)
    sim(sim.initial_state())
    assert sim.info is not None
    assert sim.info.contacts == 1
    assert sim.info.fast_impacts == 0
