"""Gradients of rollouts through contact against central differences, and the three adjoints against each other."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from small_scenes import only_read
from torch import Tensor

import diffsim as ds
from diffsim import scenes
from diffsim.diagnostics import DirectionCheck, gradcheck

STATE_FIELDS = ("position", "orientation", "velocity", "angular_velocity")
EVERY_INPUT = (*STATE_FIELDS, "force", "torque", "mass", "inertia", "gravity")
DRIVEN = ("body_velocity", "body_angular_velocity")

STEPS = 60
SEEDS = (1, 2)  # of forces and directions
# What the project promises for exact gradients, relative. At eps = 1e-6 central differences of a rollout with contact
# resolve about 1e-8 (the solver leaves 1e-10 of a contact force, times the stiffness of a contact).
MEDIAN_TOLERANCE = 1e-6
MAX_TOLERANCE = 1e-4
# Between two adjoints that solve the same system: sums in another order.
SAME_SYSTEM = 1e-11
# Between the exact adjoint and those without curvature, where there is none; the exact one takes the stiffness where
# the last Newton step left it, which is 1e-10 of the largest force away from the others'.
NO_CURVATURE = 1e-8


def dropped(mesh: ds.shapes.Mesh, height: float, **options: Any) -> ds.Scene:
    """A mesh that falls on the ground turned every way, so that one vertex after the other hits."""
    scene = ds.Scene()
    scene.add_ground()
    options = {"velocity": (0.3, -0.2, -1.5), "angular_velocity": (0.4, -0.3, 0.5), **options}
    scene.add_body(mesh, density=800.0, position=(0.0, 0.0, height), orientation=(0.9, 0.3, -0.2, 0.25), **options)
    return scene


def spheres_on_fixed_mesh() -> ds.Scene:
    """Balls that roll off a fixed torus and each other: vertex on face, edge and vertex; face and vertex by margin."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.torus(0.5, 0.2, 9, 5), kind="static", position=(0.0, 0.0, 0.3))
    scene.add_sphere(0.15, density=500.0, position=(0.52, 0.03, 0.75), velocity=(0.1, 0.2, -1.0), name="first")
    scene.add_sphere(0.2, density=900.0, position=(0.5, 0.09, 1.15), velocity=(0.0, 0.0, -2.0), name="second")
    return scene


def capsules() -> ds.Scene:
    """Two crossed capsules, one on the ground."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_capsule(0.2, 0.8, density=700.0, position=(0.0, 0.0, 0.25), orientation=(0.7, 0.1, 0.7, 0.05))
    scene.add_capsule(
        0.15,
        0.6,
        density=900.0,
        position=(0.05, 0.02, 0.75),
        orientation=(0.7, 0.65, 0.2, 0.1),
        velocity=(0.0, 0.1, -1.0),
    )
    return scene


def torus_on_sphere() -> ds.Scene:
    """A ring falls around a ball that is free, on the ground."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_sphere(0.3, density=900.0, position=(0.03, 0.05, 0.31), name="ball")
    scene.add_body(
        ds.shapes.torus(0.45, 0.15, 9, 6),
        density=700.0,
        position=(0.0, 0.0, 0.75),
        orientation=(0.97, 0.15, 0.1, 0.05),
        velocity=(0.1, 0.0, -1.0),
        name="ring",
    )
    return scene


def ball_between_balls() -> ds.Scene:
    """A ball falls between two that are free, on the ground: one zone of three bodies and two pairs."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_sphere(0.2, density=700.0, position=(-0.22, 0.01, 0.201), name="left")
    scene.add_sphere(0.25, density=900.0, position=(0.25, -0.02, 0.251), name="right")
    scene.add_sphere(0.2, density=1100.0, position=(0.01, 0.02, 0.7), velocity=(0.0, 0.1, -1.0), name="top")
    return scene


def angle_on_box() -> ds.Scene:
    """A non-convex angle falls with its inner corner over the edge of a free box."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box((1.0, 0.8, 0.5)), density=900.0, position=(0.02, 0.01, 0.252), name="base")
    scene.add_body(
        ds.shapes.l_shape(0.7, 0.25, 0.3),
        density=600.0,
        position=(0.45, 0.05, 1.05),
        orientation=(0.6, 0.65, -0.3, 0.2),
        velocity=(0.0, 0.0, -1.5),
        name="angle",
    )
    return scene


SCENES: dict[str, Callable[[], ds.Scene]] = {
    "tilted box": scenes.tilted_box,
    "box on fixed box": lambda: scenes.box_on_box(fixed=True),
    "box on free box": lambda: scenes.box_on_box(fixed=False),
    "tetrahedron on box": scenes.tetrahedron_on_box,
    "tetrahedron in groove": scenes.tetrahedron_in_groove,
    "angle in channel": scenes.nonconvex_pair,
    "angle": lambda: dropped(ds.shapes.l_shape(0.8, 0.3, 0.4), 0.75),
    "channel": lambda: dropped(ds.shapes.u_channel(0.8, 0.5, 0.6, 0.15), 0.75),
    "torus": lambda: dropped(ds.shapes.torus(0.4, 0.15, 10, 6), 0.65),
    "angle on box": angle_on_box,
    "ball between balls": ball_between_balls,
    "torus on sphere": torus_on_sphere,
    "spheres": lambda: scenes.two_spheres(speed=2.0),
    "spheres on torus": spheres_on_fixed_mesh,
    "capsules": capsules,
    "pusher": lambda: scenes.kinematic_pusher(speed=2.0),
}


def controls_for(sim: ds.Simulator, state: ds.State, seed: int = 1) -> ds.Control:
    """Forces and torques a fraction of the bodies' weight, and kinematic bodies that leave their course a little."""
    generator = torch.Generator().manual_seed(seed)

    def normal(like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=generator, dtype=torch.float64)

    weight = 10.0 * sim.mass.detach()[:, None]
    control = ds.Control(force=0.2 * weight * normal(state.velocity), torque=0.02 * weight * normal(state.velocity))
    if any(sim.mass == 0.0) and bool(state.velocity[..., sim.mass == 0.0, :].any()):
        control = control.replace(
            body_velocity=state.velocity + 0.05 * normal(state.velocity),
            body_angular_velocity=0.05 * normal(state.velocity),
        )
    return only_read(sim, control)


def impacts(sim: ds.Simulator, state: ds.State, controls: ds.Control) -> float:
    """The largest acceleration of a rollout [g]: well above 1 where something was hit."""
    with torch.no_grad():
        velocity = sim.rollout(state, controls, STEPS).velocity
    assert sim.info is not None
    assert sim.info.converged
    return float(velocity.diff(dim=0).norm(dim=-1).max()) / sim.dt / 9.81


def assert_within_tolerance(stable: Sequence[DirectionCheck]) -> None:
    table = "\n".join(str(d) for d in stable)
    assert np.median([d.error for d in stable]) <= MEDIAN_TOLERANCE, table
    assert max(d.error for d in stable) <= MAX_TOLERANCE, table


@pytest.mark.parametrize("name", SCENES)
def test_rollouts_against_central_differences(name: str) -> None:
    sim = ds.Simulator(SCENES[name](), dt=0.01)
    state = sim.initial_state()
    checked: list[DirectionCheck] = []
    zero: set[str] = set(EVERY_INPUT)
    count = 0
    for seed in SEEDS:
        controls = controls_for(sim, state, seed)
        assert impacts(sim, state, controls) >= 5.0  # or nothing is tested
        report = gradcheck(sim, state, controls, steps=STEPS, directions=2, seed=seed)
        assert {d.name for d in report.directions} >= set(EVERY_INPUT)
        count += len(report.directions)
        checked += report.stable
        zero &= set(report.zero_gradients)
    # Frictionless spheres turn as if nothing touched them, and free flight does not ask for a sphere's inertia.
    assert zero <= ({"inertia"} if "sphere" in name else set())
    assert len(checked) >= count // 2
    assert_within_tolerance(checked)


def test_kinematic_velocities_move_what_they_push() -> None:
    sim = ds.Simulator(scenes.kinematic_pusher(), dt=0.01)
    state = sim.initial_state()
    moved = controls_for(sim, state)

    def box_at(end: ds.State) -> Tensor:
        return end.position[1, 0] + 0.3 * end.position[1, 1] + end.orientation[1, 3]

    report = gradcheck(sim, state, moved, steps=STEPS, wrt=[*DRIVEN, "position"], directions=8, loss=box_at)
    assert not report.zero_gradients
    assert sim.info is not None
    assert len(report.stable) >= 12
    assert_within_tolerance(report.stable)


def test_controls_that_change_in_time() -> None:
    sim = ds.Simulator(scenes.box_on_box(fixed=False), dt=0.01)
    weight = 10.0 * sim.mass.detach()[:, None]
    forces = 0.2 * weight * torch.randn(STEPS, 2, 3, dtype=torch.float64)
    torques = 0.02 * weight * torch.randn(STEPS, 2, 3, dtype=torch.float64)
    controls = ds.Control(force=forces, torque=torques)
    report = gradcheck(sim, sim.initial_state(), controls, steps=STEPS, wrt=["force", "torque"], directions=8)
    assert not report.zero_gradients
    assert len(report.stable) >= 8
    assert_within_tolerance(report.stable)


@pytest.mark.parametrize("name", ["tilted box", "box on free box", "angle on box", "pusher"])
def test_batches_against_central_differences(name: str) -> None:
    sim = ds.Simulator(SCENES[name](), dt=0.01)
    state = sim.initial_state(batch=3)
    offset = torch.randn(3, 1, 3, dtype=torch.float64)  # the same for all bodies of a scene, so that none overlap
    state = state.replace(
        velocity=state.velocity + 0.1 * offset * (sim.mass > 0.0)[:, None],
        position=state.position + 0.1 * offset * torch.tensor([1.0, 1.0, 0.0]).double(),
    )
    report = gradcheck(sim, state, controls_for(sim, state), steps=STEPS, directions=3)
    assert not report.zero_gradients
    assert len(report.stable) >= len(report.directions) // 2
    assert_within_tolerance(report.stable)


@pytest.mark.parametrize("dt", [0.002, 0.02])
def test_other_time_steps(dt: float) -> None:
    sim = ds.Simulator(scenes.box_on_box(fixed=False), dt=dt)
    report = gradcheck(sim, sim.initial_state(), steps=round(0.6 / dt), directions=2)
    assert len(report.stable) >= len(report.directions) // 2
    assert_within_tolerance(report.stable)


def test_far_from_the_origin() -> None:
    # Positions near 1000 m carry 1e-13 m of rounding, 500 times that near the origin: differences are coarser here.
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((2, 2, 0.5)), kind="static", position=(900, -1100, 400))
    scene.add_body(
        ds.shapes.box(1.0), density=1000.0, position=(900.1, -1100.05, 401.1), orientation=(1, 0.2, 0.1, 0.3)
    )
    sim = ds.Simulator(scene, dt=0.01)
    report = gradcheck(sim, sim.initial_state(), steps=STEPS, eps=1e-5)
    assert not report.zero_gradients
    assert len(report.stable) >= 18
    assert_within_tolerance(report.stable)


# ---- dense, qr, exact ------------------------------------------------------------------------------------------------


def random_loss(end: ds.State, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    loss = torch.zeros((), dtype=torch.float64)
    for name in STATE_FIELDS:
        value = getattr(end, name)
        loss = loss + (value * torch.randn(value.shape, generator=generator, dtype=torch.float64)).sum()
    return loss


def gradients(scene: ds.Scene, adjoint: str, steps: int) -> dict[str, Tensor]:
    """Of a random function of the final state, with respect to everything."""
    sim = ds.Simulator(scene, dt=0.01, adjoint=adjoint)
    state = sim.initial_state()
    control = controls_for(sim, state)
    leaves = {name: getattr(state, name) for name in STATE_FIELDS}
    leaves |= {name: getattr(control, name) for name in ("force", "torque")}
    leaves |= {name: getattr(sim, name) for name in ("mass", "inertia", "gravity")}
    for leaf in leaves.values():
        leaf.requires_grad_()
    loss = random_loss(sim.rollout(state, control, steps)[-1], seed=1)
    return dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values()))))


def assert_agree(a: dict[str, Tensor], b: dict[str, Tensor], tolerance: float) -> None:
    compared = 0
    for name in a:
        size = float(a[name].abs().max())
        assert float((a[name] - b[name]).abs().max()) <= tolerance * size, name
        compared += size > 0.0
    assert compared >= 4


def step_gradients(sim: ds.Simulator, start: ds.State, control: ds.Control, seed: int) -> dict[str, Tensor]:
    """Of a random function of the state after one step."""
    leaves = {name: getattr(start, name).clone() for name in STATE_FIELDS}
    state = start.replace(**leaves)
    leaves |= {name: getattr(sim, name) for name in ("mass", "inertia")}
    for leaf in leaves.values():
        leaf.requires_grad_()
    return dict(zip(leaves, torch.autograd.grad(random_loss(sim(state, control), seed), list(leaves.values()))))


@pytest.mark.parametrize("name", [*SCENES, "box at rest", "stack"])
def test_dense_and_qr_are_the_same_everywhere(name: str) -> None:
    more: dict[str, Callable[[], ds.Scene]] = {
        "box at rest": scenes.resting_box,
        "stack": lambda: scenes.two_layer_stack(3),
    }
    make = {**SCENES, **more}[name]
    sims = {adjoint: ds.Simulator(make(), dt=0.01, adjoint=adjoint) for adjoint in ("dense", "qr")}
    state = sims["qr"].initial_state()
    control = controls_for(sims["qr"], state)
    with torch.no_grad():
        trajectory = sims["qr"].rollout(state, control, STEPS)
    steps_in_contact = 0
    for seed, start in enumerate(trajectory):
        found = {adjoint: step_gradients(sim, start, control, seed) for adjoint, sim in sims.items()}
        assert sims["qr"].info is not None
        steps_in_contact += sims["qr"].info.contacts > 0
        dense, qr = found["dense"], found["qr"]
        # A shift changes a step as the velocity shift / dt would: that is the size of what cancels in its gradient.
        like_velocity = {"position": "velocity", "orientation": "angular_velocity"}
        for field, gradient in dense.items():
            size = float(gradient.abs().max())
            if field in like_velocity:
                size = max(size, float(dense[like_velocity[field]].abs().max()) / sims["qr"].dt)
            assert bool(gradient.isfinite().all())
            assert float((gradient - qr[field]).abs().max()) <= SAME_SYSTEM * size, (seed, field)
    assert steps_in_contact >= 1


def spheres_on_the_ground() -> ds.Scene:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_sphere(0.3, density=800.0, position=(0.0, 0.0, 0.45), velocity=(1.0, 0.5, -2.0))
    scene.add_sphere(0.2, density=300.0, position=(3.0, 0.0, 0.35), velocity=(-1.0, 0.0, 1.0))
    return scene


def head_on() -> ds.Scene:
    """Pure translation: spheres that meet on the line between their centres, and stay there. The contact's curvature
    acts across it only; `gradients_along` looks along.
    """
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_sphere(0.5, mass=1.0, position=(-0.6, 0.0, 0.0), velocity=(0.7, 0.0, 0.0))
    scene.add_sphere(0.5, mass=3.0, position=(0.6, 0.0, 0.0), velocity=(-0.4, 0.0, 0.0))
    return scene


@pytest.mark.parametrize("adjoint", ["dense", "qr"])
def test_without_curvature_all_agree(adjoint: str) -> None:
    exact = gradients(spheres_on_the_ground(), "exact", STEPS)
    assert exact["velocity"].any()
    assert exact["gravity"].any()
    assert_agree(exact, gradients(spheres_on_the_ground(), adjoint, STEPS), NO_CURVATURE)


@pytest.mark.parametrize("adjoint", ["dense", "qr"])
def test_pure_translation_all_agree(adjoint: str) -> None:
    def along(mode: str) -> Tensor:
        sim = ds.Simulator(head_on(), dt=0.01, adjoint=mode)
        state = sim.initial_state()
        leaves = [state.position.requires_grad_(), state.velocity.requires_grad_(), sim.mass.requires_grad_()]
        end = sim.rollout(state, None, STEPS)[-1]
        loss = end.position[0, 0] + 0.3 * end.position[1, 0] + 0.5 * end.velocity[0, 0]
        by_position, by_velocity, by_mass = torch.autograd.grad(loss, leaves)
        return torch.cat([by_position[:, 0], by_velocity[:, 0], by_mass])

    exact = along("exact")
    assert bool((exact != 0.0).all())
    assert float((exact - along(adjoint)).abs().max()) <= NO_CURVATURE * float(exact.abs().max())


@pytest.mark.parametrize("adjoint", ["dense", "qr"])
def test_with_curvature_exact_is_the_one_that_is_right(adjoint: str) -> None:
    def error(mode: str) -> float:
        sim = ds.Simulator(scenes.tilted_box(), dt=0.01, adjoint=mode)
        report = gradcheck(sim, sim.initial_state(), steps=STEPS)
        assert len(report.stable) >= 14
        return report.median_error

    assert error("exact") <= MEDIAN_TOLERANCE
    assert error(adjoint) >= 0.01  # a few percent per step; were it less, the exact adjoint would be idle


# ---- which inputs do what --------------------------------------------------------------------------------------------


def test_gradient_of_a_quaternion_is_tangent() -> None:
    sim = ds.Simulator(scenes.tilted_box(), dt=0.01)
    state = sim.initial_state()
    state.orientation.requires_grad_()
    sim.rollout(state, None, STEPS).angular_velocity[-1].sum().backward()
    gradient = state.orientation.grad
    assert gradient is not None
    assert gradient.norm() > 0.1
    assert float((gradient * state.orientation.detach()).sum().abs()) <= 1e-12 * float(gradient.norm())


def test_static_bodies_have_no_gradient_in_their_mass_but_in_their_place() -> None:
    sim = ds.Simulator(scenes.box_on_box(fixed=True), dt=0.01)
    state = sim.initial_state()
    inputs = [state.position.requires_grad_(), sim.mass.requires_grad_(), sim.inertia.requires_grad_()]
    trajectory = sim.rollout(state, None, STEPS)
    by_position, by_mass, by_inertia = torch.autograd.grad(trajectory.position[-1, 1].sum(), inputs)
    assert by_position[0].any()
    assert by_inertia[1].any()
    assert not by_mass[0].any()
    assert not by_inertia[0].any()


def test_gradient_of_only_one_input_is_that_of_all() -> None:
    def run(names: tuple[str, ...]) -> dict[str, Tensor]:
        sim = ds.Simulator(scenes.box_on_box(fixed=False), dt=0.01)
        state = sim.initial_state()
        leaves = {n: getattr(state if n in STATE_FIELDS else sim, n) for n in names}
        for leaf in leaves.values():
            leaf.requires_grad_()
        loss = sim.rollout(state, None, 40).position[-1].sum()
        return dict(zip(names, torch.autograd.grad(loss, list(leaves.values()))))

    every = run((*STATE_FIELDS, "mass", "inertia", "gravity"))
    for name, gradient in every.items():
        assert gradient.any(), name
        assert torch.equal(run((name,))[name], gradient), name


def test_loss_in_the_middle_of_a_rollout() -> None:
    """Gradients that enter at every step of a trajectory add up to those of each step alone."""
    sim = ds.Simulator(scenes.tilted_box(), dt=0.01)

    def gradient(rows: Any) -> Tensor:
        state = sim.initial_state()
        state.velocity.requires_grad_()
        loss = sim.rollout(state, None, STEPS).position[rows].square().sum()
        return torch.autograd.grad(loss, state.velocity)[0]

    total = gradient(slice(None))
    assert total.any()
    parts = sum((gradient([row]) for row in range(STEPS)), torch.zeros_like(total))
    assert float((total - parts).abs().max()) <= 1e-12 * float(total.abs().max()) * math.sqrt(STEPS)
