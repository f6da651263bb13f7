"""The second-order scheme: conserving for free bodies, L-stable for cloth, inelastic and at rest in contact."""

from __future__ import annotations

import itertools
import pickle
from typing import Any

import numpy as np
import pytest
import torch
from small_scenes import STATE_FIELDS, assert_same, falling_box, make_scene
from test_closed_forms import colliding, tumbling, tumbling_reference

import diffsim as ds
from diffsim import scenes
from diffsim.diagnostics import gradcheck

G = 9.81
ROUNDING = 1e-12
CHOICES = ("implicit_euler", "second_order")


def simulator(scene: ds.Scene, dt: float = 0.01, **options: Any) -> ds.Simulator:
    return ds.Simulator(scene, dt, integrator="second_order", on_failure="raise", **options)


# ---- free motion -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dt", [0.1, 0.01])
def test_a_projectile_is_exact(dt: float) -> None:
    scene = ds.Scene()
    scene.add_sphere(0.1, mass=0.5, position=(1.0, 2.0, 3.0), velocity=(3.0, -1.0, 4.0))
    sim = simulator(scene, dt)
    state, force = sim.initial_state(), torch.tensor([[5.0, 7.0, -2.0]]).double().requires_grad_()
    leaves = [state.velocity.requires_grad_(), sim.mass.requires_grad_(), sim.gravity.requires_grad_(), force]
    time = 1.0
    end = sim.rollout(state, ds.Control(force=force), round(time / dt))[-1]
    acceleration = torch.tensor([0.0, 0.0, -G], dtype=torch.float64) + force / 0.5
    exact = state.position + time * state.velocity + 0.5 * time**2 * acceleration
    torch.testing.assert_close(end.position, exact, rtol=ROUNDING, atol=ROUNDING)
    torch.testing.assert_close(end.velocity, state.velocity + time * acceleration, rtol=ROUNDING, atol=ROUNDING)
    by_velocity, by_mass, by_gravity, by_force = torch.autograd.grad(end.position[0, 0], leaves)
    assert float(by_velocity[0, 0]) == pytest.approx(time, rel=ROUNDING)
    assert float(by_mass[0]) == pytest.approx(-0.5 * time**2 * 5.0 / 0.5**2, rel=ROUNDING)
    assert float(by_gravity[0]) == pytest.approx(0.5 * time**2, rel=ROUNDING)
    assert float(by_force[0, 0]) == pytest.approx(0.5 * time**2 / 0.5, rel=ROUNDING)


def rod() -> ds.Scene:
    """It spins at 100 rad/s, almost about its long axis, from which implicit Euler turns it away."""
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    spin = 100.0 * np.array([1.0, 0.1, 0.05]) / np.linalg.norm([1.0, 0.1, 0.05])
    scene.add_body(ds.shapes.box((1.0, 0.1, 0.05)), density=1000.0, angular_velocity=spin)
    return scene


def test_a_fast_rod_keeps_energy_and_angular_momentum() -> None:
    sim, euler = simulator(rod()), ds.Simulator(rod(), 0.01)
    state = sim.initial_state()
    states = sim.rollout(state, None, 500)
    energy = sim.kinetic_energy(states) / sim.kinetic_energy(state)
    assert float((energy - 1.0).abs().max()) <= 1e-10
    assert float(euler.kinetic_energy(euler.rollout(state, None, 500)[-1]) / euler.kinetic_energy(state)) < 0.6
    kept = sim.angular_momentum(state)
    lost = (sim.angular_momentum(states) - kept).norm(dim=-1) / kept.norm()
    assert float(lost.max()) <= 1e-12
    assert float((states.angular_velocity[-1] - state.angular_velocity).norm()) > 1.0


def test_tumbling_is_of_second_order() -> None:
    exact = tumbling_reference(1.0, steps=1000)
    errors = []
    for dt in (0.02, 0.01, 0.005, 0.0025):
        found = tumbling(dt, 1.0, integrator="second_order").numpy()
        errors.append(min(np.linalg.norm(found - exact), np.linalg.norm(found + exact)))
    assert 1e-6 < errors[-1] < errors[0] < 1e-2
    np.testing.assert_allclose(np.array(errors[:-1]) / np.array(errors[1:]), 4.0, atol=0.2)


def test_a_constant_torque_is_of_second_order_too() -> None:
    def end(dt: float) -> torch.Tensor:
        scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
        scene.add_body(ds.shapes.box((1.0, 0.6, 0.3)), density=500.0, angular_velocity=(1.0, 0.3, 0.5))
        sim = simulator(scene, dt)
        torque = torch.tensor([[3.0, 10.0, -5.0]]).double()
        return sim.rollout(sim.initial_state(), ds.Control(torque=torque), round(0.5 / dt))[-1].orientation[0]

    fine = end(0.0005)
    errors = [float((end(dt) - fine).norm()) for dt in (0.02, 0.01)]
    assert errors[1] > 1e-7
    assert errors[0] / errors[1] == pytest.approx(4.0, abs=0.1)


# ---- contact ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compliance", [1e-4, 0.0])
@pytest.mark.parametrize("scene", [scenes.resting_box, lambda: scenes.two_layer_stack(5)], ids=["box", "stack"])
def test_what_rests_neither_rings_nor_creeps(scene: Any, compliance: float) -> None:
    """Without friction a stack slides sideways by what its start was off, with implicit Euler as well."""
    sims = [ds.Simulator(scene(), 0.01, integrator=name, compliance=compliance) for name in CHOICES]
    state = sims[1].rollout(sims[1].initial_state(), None, 40)[-1]
    euler, states = (sim.rollout(state, None, 100) for sim in sims)
    assert float(states.velocity[..., 2].abs().max()) <= 1e-10
    assert float((states.position - state.position)[..., 2].abs().max()) <= 1e-10
    for name in ("velocity", "angular_velocity"):
        slides = float(getattr(euler, name).abs().max())
        assert float(getattr(states, name).abs().max()) <= 1.5 * slides + 1e-9


def test_a_fall_ends_at_rest_and_gains_no_energy() -> None:
    sim = falling_box(integrator="second_order")
    state = sim.initial_state()
    states = sim.rollout(state, None, 300)
    energy = torch.cat([(sim.kinetic_energy(s) + sim.potential_energy(s)).reshape(-1) for s in (state, states)])
    assert float(energy[0] - energy[-1]) > 0.5 * float(sim.kinetic_energy(state))
    assert float(energy.diff().max()) <= 1e-6 * float(energy[0] - energy[-1])
    assert float(states.velocity[-1].abs().max()) <= 1e-9
    assert float(states.angular_velocity[-1, 0, :2].abs().max()) <= 1e-9  # nothing stops it from turning on its face


def test_sliding_down_a_plane_is_exact() -> None:
    """A box on a fixed slab that is tilted by 0.3 rad."""
    tilt = np.array([np.cos(0.15), 0.0, np.sin(0.15), 0.0])
    along, normal = np.array([np.cos(0.3), 0.0, -np.sin(0.3)]), np.array([np.sin(0.3), 0.0, np.cos(0.3)])
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((10.0, 2.0, 0.2)), kind="static", orientation=tilt)
    scene.add_body(ds.shapes.box(0.4), density=500.0, position=0.3 * normal - 2.0 * along, orientation=tilt)
    sim = simulator(scene, 0.02)
    state = sim.initial_state()
    end = sim.rollout(state, None, 50)[-1]
    slid = (end.position - state.position)[1].numpy() @ along
    assert slid == pytest.approx(0.5 * G * np.sin(0.3), rel=1e-6)
    assert end.velocity[1].numpy() @ along == pytest.approx(G * np.sin(0.3), rel=1e-6)
    assert abs(end.velocity[1].numpy() @ normal) <= 1e-6


def test_bodies_that_are_pressed_together_fall_and_accelerate_as_one() -> None:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box(0.4), mass=1.0, position=(0.0, 0.0, 0.4), name="upper")
    scene.add_body(ds.shapes.box(0.4), mass=3.0, name="lower")
    sim = simulator(scene)
    state = sim.initial_state()
    down = torch.tensor([[0.0, 0.0, -60.0], [0.0, 0.0, 20.0]]).double()
    end = sim.rollout(state, ds.Control(force=down), 50)[-1]
    acceleration = -G - 40.0 / 4.0
    assert float(sim.momentum(end)[2]) == pytest.approx(4.0 * 0.5 * acceleration, rel=1e-9)
    fallen = (end.position - state.position)[:, 2]
    np.testing.assert_allclose(fallen.numpy(), 0.5 * 0.5**2 * acceleration, rtol=1e-5)


def test_collisions_keep_momentum_and_gain_no_energy() -> None:
    collisions = 0
    for seed in range(20):
        scene = colliding(seed)
        sim = simulator(scene)
        state = sim.initial_state()
        states = sim.rollout(state, None, 60)
        collisions += bool((states.velocity[-1] - state.velocity).norm(dim=-1).max() > 0.1)
        size = float((sim.mass[:, None] * state.velocity).norm(dim=-1).sum())
        assert float((sim.momentum(states) - sim.momentum(state)).norm(dim=-1).max()) <= 1e-10 * size, seed
        assert float(sim.kinetic_energy(states).max() / sim.kinetic_energy(state)) <= 1.0 + 1e-9, seed
    assert collisions >= 12


def test_contact_forces_are_what_changes_momentum() -> None:
    sim = falling_box(integrator="second_order")
    state = sim.rollout(sim.initial_state(), None, 3)[-1]
    for _ in range(20):
        force = sim.contacts(state).net_force()
        after = sim(state)
        change = (sim.mass[:, None] * (after.velocity - state.velocity - sim.dt * sim.gravity)) / sim.dt
        if float(force.norm()) > 10.0:
            break
        state = after
    assert float(force.norm()) > 10.0
    torch.testing.assert_close(force, change, rtol=1e-6, atol=1e-6)


# ---- cloth -----------------------------------------------------------------------------------------------------------


def ball_on_sheet() -> ds.Scene:
    scene = ds.Scene()
    scene.add_cloth(ds.shapes.sheet(1.0, 5), pinned=[0, 4, 20, 24], name="sheet")
    scene.add_sphere(0.15, density=300.0, position=(0.03, 0.01, 0.16), name="ball")
    return scene


def swinging_sheet(damping: float) -> ds.Scene:
    """Soft, so that steps of 5 ms resolve its waves."""
    scene = ds.Scene()
    material = ds.ClothMaterial(density=0.2, stretch=20.0, shear=10.0, bend=1e-4, damping=damping)
    scene.add_cloth(ds.shapes.sheet(0.5, 7), material, pinned=[0, 6])
    return scene


@pytest.mark.parametrize("damping", [0.0, 0.02])
def test_a_swinging_sheet_is_of_second_order(damping: float) -> None:
    def ends(dt: float, integrator: str) -> torch.Tensor:
        sim = ds.Simulator(swinging_sheet(damping), dt, integrator=integrator, tolerance=1e-13, on_failure="raise")
        end = sim.rollout(sim.initial_state(), None, round(0.16 / dt))[-1]
        return torch.stack([end.node_position, 0.1 * end.node_velocity])

    limit = ends(0.000625, "second_order")
    errors = {name: [float((ends(dt, name) - limit).norm()) for dt in (0.01, 0.005, 0.0025)] for name in CHOICES}
    assert errors["second_order"][0] < 0.3 * errors["implicit_euler"][0]
    for before, after in itertools.pairwise(errors["second_order"]):
        assert 3.0 < before / after < 5.0
    assert errors["second_order"][-1] < 0.1 * errors["implicit_euler"][-1]


def test_a_stiff_sheet_at_a_large_step_makes_no_energy() -> None:
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    material = ds.ClothMaterial(density=0.2, stretch=1e7, shear=1e7, bend=1e-4)
    vertices, faces = ds.shapes.sheet(0.5, 5)
    start = 1.01 * vertices + 1e-3 * np.sin(40.0 * vertices[:, [1, 2, 0]])
    scene.add_cloth((start, faces), material, rest=vertices)
    sim = simulator(scene, dt=0.02)
    state = sim.initial_state()
    path = [state, *sim.rollout(state, None, 20)]
    energies = [float(sim.kinetic_energy(s) + sim.potential_energy(s)) for s in path]
    assert energies[0] > 1.0
    assert max(b - a for a, b in itertools.pairwise(energies)) < 1e-6 * energies[0]
    assert energies[-1] < 1e-3 * energies[0]  # L-stable: what a step is too long for dies out


def test_a_sheet_lands_without_a_bounce_and_rests_without_velocity() -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_cloth(ds.shapes.sheet(0.5, 5), position=(0.0, 0.0, 0.05), velocity=(0.0, 0.0, -1.0))
    sim = simulator(scene)
    path = sim.rollout(sim.initial_state(), None, 60)
    assert float(path.node_velocity[0, :, 2].min()) < -1.0
    assert float(path.node_velocity[..., 2].max()) < 1e-3
    assert float(path.node_velocity[-20:].abs().max()) < 1e-12
    euler = ds.Simulator(scene, 0.01)
    there = euler.rollout(euler.initial_state(), None, 60)[-1]
    torch.testing.assert_close(path[-1].node_position, there.node_position, rtol=0.0, atol=1e-12)


def test_a_sheet_that_slides_to_rest_goes_as_far_as_it_should() -> None:
    speed, friction, dt = 1.0, 0.5, 0.01
    scene = ds.Scene()
    scene.add_ground(friction=friction)
    sheet = ds.shapes.sheet(0.5, 5)
    scene.add_cloth(sheet, position=(0.0, 0.0, 0.0005), velocity=(speed, 0.0, 0.0), friction=friction)
    sim = simulator(scene, dt)
    state = sim.initial_state()
    path = sim.rollout(state, None, 30)
    k = 11  # steps; the first settle by what contacts give way
    time = dt * (k + 1)
    torch.testing.assert_close(
        (path.node_position[k] - state.node_position)[:, 0],
        torch.full((25,), speed * time - 0.5 * friction * G * time**2, dtype=torch.float64),
        rtol=0.0,
        atol=1e-6,
    )
    assert float(path.node_velocity[-1].abs().max()) < 1e-12


def test_a_ball_comes_to_rest_on_a_sheet_where_implicit_euler_has_it() -> None:
    ends = []
    for integrator in CHOICES:
        sim = ds.Simulator(ball_on_sheet(), 0.04, integrator=integrator, on_failure="raise")
        state = sim.initial_state()
        sim.cloth_damping.data.fill_(0.3)
        ends.append(sim.rollout(state, None, 300)[-1])
    assert float(ends[0].position[0, 2]) < -0.02 + 0.16
    assert float(ends[1].velocity.abs().max()) < 1e-4
    torch.testing.assert_close(ends[1].position, ends[0].position, rtol=0.0, atol=1e-4)


# ---- gradients -------------------------------------------------------------------------------------------------------

SCENES = {
    "in flight": make_scene,
    "a landing": scenes.tilted_box,
    "a box on a free box": lambda: scenes.box_on_box(fixed=False),
    "a driven push": lambda: scenes.kinematic_pusher(speed=2.0),
    "a ball on a sheet": ball_on_sheet,
}


@pytest.mark.parametrize("name", SCENES)
def test_gradients_of_40_steps_against_central_differences(name: str) -> None:
    sim = ds.Simulator(SCENES[name](), 0.01, integrator="second_order")
    state = sim.initial_state()
    moving = (sim.mass > 0.0).double()[:, None]
    controls = ds.Control(
        force=moving * torch.tensor([0.3, 0.1, -0.2]), torque=moving * torch.tensor([0.02, 0.05, 0.01])
    )
    report = gradcheck(sim, state, controls, steps=40, directions=1 if sim.cloth_names else 2)
    assert sim.info is not None
    assert {d.name for d in report.directions} >= {*STATE_FIELDS, "force", "torque", "mass", "inertia", "gravity"}
    assert set(report.zero_gradients) <= ({"inertia"} if "ball" in name else set())
    assert len(report.stable) >= len(report.directions) // 2
    assert np.median([d.error for d in report.stable]) <= 1e-6, report
    assert max(d.error for d in report.stable) <= 1e-4, report


def test_the_gradient_of_a_material_alone_is_that_beside_the_states() -> None:
    found = []
    for with_state in (False, True):
        sim = simulator(swinging_sheet(0.02))
        start = sim.initial_state()
        start.node_position.requires_grad_(with_state)
        materials = [sim.cloth_stretch.requires_grad_(), sim.cloth_damping.requires_grad_()]
        end = sim.rollout(start, None, 3)[-1]
        loss = (end.node_position * torch.arange(147.0).reshape(49, 3).cos()).sum()
        found.append(torch.autograd.grad(loss, materials))
    for alone, beside in zip(*found):
        assert float(alone.norm()) > 1e-12
        assert torch.equal(alone, beside)


@pytest.mark.parametrize("adjoint", ["qr", "dense"])
def test_the_papers_adjoints_are_the_exact_one_where_contact_has_no_curvature(adjoint: str) -> None:
    found = []
    for mode in ("exact", adjoint):
        scene = ds.Scene()
        scene.add_ground()
        scene.add_sphere(0.2, density=500.0, position=(0.0, 0.0, 0.25), velocity=(1.0, 0.0, -2.0))
        sim = simulator(scene, adjoint=mode)
        state = sim.initial_state()
        state.velocity.requires_grad_()
        end = sim.rollout(state, None, 20)[-1]
        found.append(torch.autograd.grad(end.position.sum() + end.velocity[0, 2], state.velocity)[0])
    assert float(found[0].norm()) > 1e-2
    torch.testing.assert_close(found[1], found[0], rtol=1e-6, atol=1e-9)


# ---- the option ------------------------------------------------------------------------------------------------------


def test_batches_pickles_and_checkpoints_change_no_bit() -> None:
    sim = falling_box(integrator="second_order")
    state = sim.initial_state()
    whole = sim.rollout(state, None, 30)
    for other in (pickle.loads(pickle.dumps(sim)), falling_box(integrator="second_order", num_threads=2)):
        assert_same(other.rollout(state, None, 30), whole)
    both = sim.rollout(sim.initial_state(batch=2), None, 30)
    for k in range(2):
        assert_same(both[:, k], whole)
    stepped = state
    for _ in range(30):
        stepped = sim(stepped)
    assert_same(stepped, whole[-1])

    gradients = []
    for every in (None, 7):
        start = sim.initial_state()
        start.velocity.requires_grad_()
        end = sim.rollout(start, None, 30, checkpoint_every=every)[-1]
        gradients.append(torch.autograd.grad(end.position.sum(), start.velocity)[0])
    assert float(gradients[0].norm()) > 1e-2
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=1e-12)  # segments begin with quaternions of length 1


def test_repr_names_the_integrator_and_a_wrong_name_is_refused_with_the_choices() -> None:
    assert "integrator='second_order'" in repr(falling_box(integrator="second_order"))
    assert "integrator='implicit_euler'" in repr(falling_box())
    with pytest.raises(ValueError, match="must be used with coupling='monolithic', got 'split'"):
        ds.Simulator(ds.Scene(), dt=0.01, integrator="second_order", coupling="split")
    with pytest.raises(ValueError, match="integrator must be one of 'implicit_euler', 'second_order', got 'rk4'"):
        falling_box(integrator="rk4")
