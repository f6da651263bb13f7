"""Motions with a formula: flight, tumbling, landing, rest, and what a collision must keep."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffsim as ds
from diffsim import scenes

G = 9.81
# A few hundred float64 additions of terms of the size of the result.
ROUNDING = 1e-12
# Two solves that each reach 1e-10 of the largest contact force.
SOLVED = 1e-9
COMPLIANCE = 1e-4  # the simulator's default: contact gives way by this fraction of what hard contact would stop


def simulator(scene: ds.Scene, dt: float = 0.01, **options: Any) -> ds.Simulator:
    return ds.Simulator(scene, dt, on_failure="raise", **options)


def brick(scene: ds.Scene, **options: Any) -> ds.BodyHandle:
    return scene.add_body(ds.shapes.box((1.0, 0.6, 0.3)), density=500.0, **options)


# ---- flight ----------------------------------------------------------------------------------------------------------


def test_flight_is_implicit_euler() -> None:
    dt, steps = 0.01, 150
    v0, force = torch.tensor([3.0, -1.0, 4.0]).double(), torch.tensor([5.0, 7.0, -2.0]).double()
    scene = ds.Scene()
    scene.add_sphere(0.1, mass=0.5, position=(1.0, 2.0, 3.0), velocity=v0.tolist())
    sim = simulator(scene, dt)
    state = sim.initial_state()
    leaves = [state.position, state.velocity, sim.mass, sim.gravity, force]
    for leaf in leaves:
        leaf.requires_grad_()
    trajectory = sim.rollout(state, ds.Control(force=force.expand(1, 3)), steps)
    n = torch.arange(1.0, steps + 1).double()[:, None]
    acceleration = torch.tensor([0.0, 0.0, -G], dtype=torch.float64) + force.detach() / 0.5
    velocity = v0 + n * dt * acceleration
    position = state.position.detach() + n * dt * v0 + 0.5 * n * (n + 1) * dt**2 * acceleration
    assert (trajectory.velocity[:, 0] - velocity).abs().max() <= ROUNDING * velocity.abs().max()
    assert (trajectory.position[:, 0] - position).abs().max() <= ROUNDING * position.abs().max()

    by = torch.autograd.grad(trajectory.position[-1, 0, 2], leaves)
    fallen = 0.5 * steps * (steps + 1) * dt**2
    expected = [1.0, steps * dt, -fallen * force[2].item() / 0.5**2, fallen, fallen / 0.5]
    found = [by[0][0, 2], by[1][0, 2], by[2][0], by[3][2], by[4][2]]
    np.testing.assert_allclose([float(x) for x in found], expected, rtol=ROUNDING)


def tumbling(dt: float, time: float, **options: Any) -> Tensor:
    scene = ds.Scene(gravity=(0, 0, 0))
    brick(scene, orientation=(0.8, 0.1, -0.5, 0.3), angular_velocity=(1.0, 3.0, 0.5))
    sim = simulator(scene, dt, **options)
    return sim.rollout(sim.initial_state(), None, round(time / dt))[-1].orientation[0]


def tumbling_reference(time: float, steps: int = 400) -> np.ndarray[Any, Any]:
    """Euler's equations for the same brick by classical Runge–Kutta, to 1e-10: its quaternion after `time`."""
    scene = ds.Scene()
    brick(scene)
    inertia = scene.pack(1e-3).inertia[0]
    q = np.array([0.8, 0.1, -0.5, 0.3])
    q /= np.linalg.norm(q)
    spin = np.array([1.0, 3.0, 0.5])

    def rotation(q: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.asarray(ds.rotation.to_matrix(q / np.linalg.norm(q)))

    momentum = rotation(q) @ inertia @ rotation(q).T @ spin  # constant

    def rate(q: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        R = rotation(q)
        w = R @ np.linalg.solve(inertia, R.T @ momentum)
        return 0.5 * np.array([-w @ q[1:], *(w * q[0] + np.cross(w, q[1:]))])

    h = time / steps
    for _ in range(steps):
        a = rate(q)
        b = rate(q + 0.5 * h * a)
        c = rate(q + 0.5 * h * b)
        q = q + h / 6.0 * (a + 2 * b + 2 * c + rate(q + h * c))
    return np.asarray(q / np.linalg.norm(q))


def test_tumbling_is_first_order() -> None:
    exact = tumbling_reference(1.0)
    errors = []
    for dt in (0.004, 0.002, 0.001, 0.0005):
        found = tumbling(dt, 1.0).numpy()
        errors.append(min(np.linalg.norm(found - exact), np.linalg.norm(found + exact)))
    ratios = np.array(errors[:-1]) / np.array(errors[1:])
    assert errors[0] > 1e-3
    assert errors[-1] < 5e-3
    np.testing.assert_allclose(ratios, 2.0, atol=0.1)


@pytest.mark.parametrize("spin", [0.1, 10.0, 300.0, 1e4, 1e6])
def test_angular_momentum_is_kept_in_free_flight(spin: float) -> None:
    steps = 300
    scene = ds.Scene()
    axis = np.array([0.3, 1.0, 0.2])  # near the middle axis, the unstable one
    brick(scene, orientation=(0.8, 0.1, -0.5, 0.3), angular_velocity=spin * axis, position=(0.0, 0.0, 0.0))
    sim = simulator(scene)
    state = sim.initial_state()
    kept = sim.angular_momentum(state)
    trajectory = sim.rollout(state, None, steps)
    found = sim.angular_momentum(trajectory.replace(position=trajectory.position - trajectory.position))
    turned = (trajectory.orientation[-1] - state.orientation).norm()
    assert turned > 1e-2
    assert float((found - kept).norm(dim=-1).max()) <= 1e-13 * math.sqrt(steps) * float(kept.norm())


# ---- landing and rest ------------------------------------------------------------------------------------------------


def landing(kind: str) -> ds.Simulator:
    scene = ds.Scene()
    scene.add_ground()
    motion: dict[str, Any] = {"position": (0.1, 0.2, 0.8), "velocity": (1.5, -0.5, 0.0)}
    if kind == "sphere":
        scene.add_sphere(0.3, density=500.0, **motion)
    elif kind == "capsule":
        scene.add_capsule(0.2, 0.6, density=500.0, orientation=(0.5, 0.5, 0.5, 0.5), **motion)
    elif kind == "box":
        scene.add_body(ds.shapes.box((0.5, 0.5, 0.4)), density=500.0, **motion)
    else:
        scene.add_body(ds.shapes.torus(0.4, 0.15, 12, 8), density=500.0, **motion)
    return simulator(scene)


@pytest.mark.parametrize("kind", ["sphere", "capsule", "box", "torus"])
def test_landing(kind: str) -> None:
    """After landing, the height does not remember the drop; without friction the way sideways is all of the time."""
    sim = landing(kind)
    steps = 100
    state = sim.initial_state()
    state.position.requires_grad_()
    state.velocity.requires_grad_()
    end = sim.rollout(state, None, steps)[-1]
    assert sim.info is not None
    assert sim.info.contacts > 0
    by_drop, by_throw = torch.autograd.grad(end.position[0, 2], [state.position, state.velocity], retain_graph=True)
    # Each step forgets all but `compliance` of what it starts from: nothing is left but rounding, times contact's
    # stiffness 1 / compliance, times the 1 / dt between heights and velocities.
    forgotten = 1e-15 / COMPLIANCE / sim.dt
    assert abs(float(by_drop[0, 2])) <= forgotten
    assert abs(float(by_throw[0, 2])) <= forgotten
    (by_velocity,) = torch.autograd.grad(end.position[0, 0], state.velocity)
    assert float(by_velocity[0, 0]) == pytest.approx(steps * sim.dt, rel=SOLVED)
    before = sim.rollout(state.detach(), None, 5)[-1]
    assert float(before.position[0, 2]) < 0.8  # it was on its way


@pytest.mark.parametrize(("kind", "half_height"), [("sphere", 0.3), ("capsule", 0.2), ("box", 0.2), ("torus", 0.15)])
def test_height_at_rest(kind: str, half_height: float) -> None:
    sim = landing(kind)
    end = sim.rollout(sim.initial_state(), None, 300)[-1]
    margins = sim.thickness if kind in ("box", "torus") else 0.5 * sim.thickness
    # Contact gives way until it carries the weight, shared by the points that touch: at most g dt² compliance.
    sag = G * sim.dt**2 * COMPLIANCE
    height = float(end.position[0, 2])
    assert half_height + margins - 1.01 * sag <= height <= half_height + margins
    assert float(end.velocity[0, 2].abs()) <= 1e-9
    assert end.velocity[0, :2].tolist() == pytest.approx([1.5, -0.5], rel=SOLVED)  # frictionless


def test_a_cube_at_rest_stays() -> None:
    sim = simulator(scenes.resting_box())
    state = sim.rollout(sim.initial_state(), None, 10)[-1]
    trajectory = sim.rollout(state, None, 10_000)
    assert float((trajectory.position - state.position).abs().max()) < 1e-6
    assert float((trajectory.orientation - state.orientation).abs().max()) < 1e-6
    assert sim.info is not None
    assert sim.info.iterations <= 2


# ---- collisions ------------------------------------------------------------------------------------------------------


def colliding(seed: int) -> ds.Scene:
    """Two free bodies of any shape on a course that brings them together, without gravity."""
    rng = np.random.default_rng(seed)
    meshes = [
        ds.shapes.box((0.5, 0.4, 0.3)),
        ds.shapes.l_shape(0.6, 0.2, 0.3),
        ds.shapes.u_channel(0.6, 0.4, 0.5, 0.12),
        ds.shapes.torus(0.3, 0.1, 8, 5),
        ds.shapes.tetrahedron(0.6),
    ]
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    for side in (-1.0, 1.0):
        options: dict[str, Any] = {
            "density": float(10.0 ** rng.uniform(2.0, 4.0)),
            "position": [0.6 * side, *(0.1 * rng.normal(size=2))],
            "orientation": rng.normal(size=4),
            "velocity": [-side * rng.uniform(0.5, 5.0), *(0.2 * rng.normal(size=2))],
            "angular_velocity": 2.0 * rng.normal(size=3),
        }
        shape = rng.integers(len(meshes) + 2)
        if shape < len(meshes):
            scene.add_body(meshes[shape], **options)
        elif shape == len(meshes):
            scene.add_sphere(0.25, **options)
        else:
            scene.add_capsule(0.15, 0.3, **options)
    return scene


def test_collisions_keep_linear_momentum() -> None:
    collisions = 0
    for seed in range(80):
        sim = simulator(colliding(seed))
        state = sim.initial_state()
        trajectory = sim.rollout(state, None, 60)
        collisions += bool((trajectory.velocity[-1] - state.velocity).norm(dim=-1).max() > 0.1)
        size = float((sim.mass[:, None] * state.velocity).norm(dim=-1).sum())
        lost = sim.momentum(trajectory) - sim.momentum(state)
        assert float(lost.norm(dim=-1).max()) <= 1e-10 * size, seed
    assert collisions >= 50


def test_collisions_do_not_gain_energy() -> None:
    """Kinetic energy never exceeds what came in. Within a collision a step may return a little of what the one before
    took, as bodies turn along an arc while contact acts along the normal at its end: that vanishes with dt.
    """
    largest_return = {}
    for dt in (0.01, 0.0025):
        returned, collisions = [], 0
        for seed in range(60):
            sim = simulator(colliding(seed), dt)
            state = sim.initial_state()
            trajectory = sim.rollout(state, None, round(0.6 / dt))
            energy = torch.cat([sim.kinetic_energy(state)[None], sim.kinetic_energy(trajectory)]) / sim.kinetic_energy(
                state
            )
            collisions += bool(energy[-1] < 0.99)
            assert float(energy.max()) <= 1.0 + ROUNDING, seed
            returned.append(float(energy.diff().max()))
        assert collisions >= 40
        largest_return[dt] = max(returned)
    assert largest_return[0.01] <= 0.01
    assert largest_return[0.0025] <= 0.25 * largest_return[0.01]


def test_angular_momentum_error_in_a_collision_is_first_order() -> None:
    """Two spheres meet off their centres: the impulse acts where they are at the end of a step, not at its start."""

    def error(dt: float) -> float:
        scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
        scene.add_sphere(0.5, mass=1.0, position=(-0.8, 0.15, 0.1), velocity=(2.0, 0.0, 0.0))
        scene.add_sphere(0.5, mass=3.0, position=(0.8, -0.15, -0.1), velocity=(-2.0, 0.0, 0.0))
        sim = simulator(scene, dt, thickness=1e-4)
        state = sim.initial_state()
        kept = sim.angular_momentum(state)
        errors = []
        for shift in np.linspace(0.0, 1.0, 8, endpoint=False):  # where in a step the impact falls
            start = state.replace(position=state.position + dt * shift * state.velocity)
            end = sim.rollout(start, None, round(0.3 / dt))[-1]
            assert float((end.velocity - state.velocity).norm(dim=-1).max()) > 1.0
            errors.append(float((sim.angular_momentum(end) - kept).norm() / kept.norm()))
        return float(np.mean(errors))

    errors = [error(dt) for dt in (0.005, 0.0025, 0.00125, 0.000625)]
    assert 1e-4 < errors[-1] < errors[0] < 0.1
    np.testing.assert_allclose(np.array(errors[:-1]) / np.array(errors[1:]), 2.0, atol=0.1)


@pytest.mark.parametrize("mass_ratio", [1.0, 10.0, 1e2, 1e3, 1e4, 1e5, 1e6])
@pytest.mark.parametrize("pushed", ["light", "heavy"])
def test_two_spheres_pushed_together_move_as_one(mass_ratio: float, pushed: str) -> None:
    """Their velocity is v = (m_a v_a + m_b v_b + F t) / (m_a + m_b), hence dv/dm_a = (v_a - v) / (m_a + m_b)."""
    sim = simulator(scenes.two_spheres(mass_ratio=mass_ratio if pushed == "light" else 1.0 / mass_ratio))
    state = sim.initial_state()
    steps, push = 60, 3.0  # on the left one, which is of 1 kg
    force = torch.zeros(2, 3, dtype=torch.float64)
    force[0, 0] = push
    state.velocity.requires_grad_()
    sim.mass.requires_grad_()
    force.requires_grad_()
    end = sim.rollout(state, ds.Control(force=force), steps)[-1]
    m, v = sim.mass.detach(), state.velocity.detach()[:, 0]
    common = float((m * v).sum() + push * steps * sim.dt) / float(m.sum())
    assert abs(float(v[0] - v[1])) > 0.5
    assert end.velocity[:, 0].tolist() == pytest.approx([common, common], rel=SOLVED, abs=SOLVED * float(v.abs().max()))
    for body in range(2):
        by_mass, by_velocity, by_force = torch.autograd.grad(
            end.velocity[body, 0], [sim.mass, state.velocity, force], retain_graph=True
        )
        expected = (v - common) / m.sum()
        assert bool((expected != 0.0).all())
        # Relative to the larger: the heavy body's mass may matter a million times less than the light one's.
        np.testing.assert_allclose(
            by_mass.numpy(), expected.numpy(), rtol=1e-6, atol=1e-9 * float(expected.abs().max())
        )
        np.testing.assert_allclose(by_velocity[:, 0].numpy(), (m / m.sum()).numpy(), rtol=1e-6, atol=1e-9)
        assert float(by_force[0, 0]) == pytest.approx(steps * sim.dt / float(m.sum()), rel=1e-6)


@pytest.mark.parametrize("mass_ratio", [1.0, 1e3, 1e6])
def test_two_spheres_that_collide_stay_together(mass_ratio: float) -> None:
    sim = simulator(scenes.two_spheres(mass_ratio=mass_ratio))
    state = sim.initial_state()
    sim.mass.requires_grad_()
    end = sim.rollout(state, None, 60)[-1]
    m, v = sim.mass.detach(), state.velocity[:, 0]
    common = float((m * v).sum() / m.sum())
    # Nothing holds them: contact gives back the little it was compressed.
    assert end.velocity[:, 0].tolist() == pytest.approx([common, common], abs=COMPLIANCE * float((v[0] - v[1]).abs()))
    (by_mass,) = torch.autograd.grad(end.velocity[0, 0], sim.mass)
    expected = (v - common) / m.sum()
    # What it gives back depends on both masses, through the stiffness of the contact.
    assert bool(((by_mass - expected).abs() <= COMPLIANCE * (v[0] - v[1]).abs() / m).all())
    if mass_ratio == 1.0:
        assert bool((expected.abs() > 100 * COMPLIANCE * (v[0] - v[1]).abs() / m).all())


@pytest.mark.parametrize("dt", [0.005, 0.0025, 0.000625])
@pytest.mark.parametrize("compliance", [1e-4, 1e-6, 0.0])
def test_no_step_of_boxes_that_slide_into_each_other_gains_energy(dt: float, compliance: float) -> None:
    # Equally high and flat on the ground, so that their faces are coplanar; 0.5 mm thick, about to meet with a corner.
    scene = ds.Scene()
    scene.add_ground()
    for position, orientation, velocity, spin in (
        (
            (0.601232925, 0.0190747422, 0.0104999939),
            (-0.35876, -0.60934, -0.35876, 0.60934),
            (0.5412, -0.3599, 0),
            5.3767,
        ),
        (
            (0.62784876, 0.236855228, 0.0104999939),
            (-0.29870, -0.64092, -0.29870, 0.64092),
            (0.6567, -0.2348, 0),
            4.7393,
        ),
    ):
        scene.add_body(
            ds.shapes.box((0.02, 0.1, 0.2)),
            density=150.0,
            position=position,
            orientation=orientation,
            velocity=velocity,
            angular_velocity=(0.0, 0.0, spin),
        )
    sim = ds.Simulator(scene, dt, thickness=0.0005, compliance=compliance, on_failure="raise")
    state = sim.initial_state()
    start = energy = float(sim.kinetic_energy(state))
    for _ in range(round(0.02 / dt)):
        state = sim(state)
        now = float(sim.kinetic_energy(state))
        assert now <= energy * (1.0 + 1e-3)
        energy = now
    assert energy < 0.95 * start  # they met
