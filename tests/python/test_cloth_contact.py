"""Cloth goes through nothing, not even itself, and does the same thing every time."""

from __future__ import annotations

import copy
import io
import pickle
import warnings
from typing import Any

import pytest
import torch
from penetration import CrossingCheck
from test_cloth_gradients import folded_sheet, rim
from torch import Tensor

import diffsim as ds

MATERIAL = ds.ClothMaterial(density=0.2, stretch=500.0, shear=60.0, bend=1e-5, damping=0.02)
FIELDS = ("position", "orientation", "velocity", "angular_velocity", "node_position", "node_velocity")


def fall(onto: str) -> ds.Scene:
    scene = ds.Scene()
    height = 0.6
    if onto == "sphere":
        scene.add_sphere(0.2, kind="static", position=(0, 0, 0.35))
    elif onto == "box":
        scene.add_body(ds.shapes.box(0.3), kind="static", position=(0, 0, 0.33), orientation=(1, 0.1, 0.05, 0.2))
    elif onto == "free box":
        scene.add_body(ds.shapes.box(0.2), mass=0.1, position=(0, 0, 0.35), orientation=(1, 0.1, 0.05, 0.2))
    else:
        height = 0.15
    scene.add_ground()
    if onto == "itself":
        vertices, faces, rest = folded_sheet((11, 5))
        scene.add_cloth((vertices, faces), MATERIAL, rest=rest, position=(-0.1, 0, 0.02), velocity=(0, 0, -1))
    else:
        scene.add_cloth(
            ds.shapes.sheet(0.7, 9), MATERIAL, position=(0.02, 0.03, height), orientation=(1, 0.1, 0.05, 0.1)
        )
    return scene


FALLS = [
    (onto, coupling, dt)
    for onto in ("sphere", "box", "free box", "ground", "itself")
    for coupling in ("monolithic", "split")
    for dt in (0.01, 0.02)
]


@pytest.mark.parametrize(("onto", "coupling", "dt"), FALLS)
def test_falling_cloth_goes_through_nothing(onto: str, coupling: str, dt: float) -> None:
    scene = fall(onto)
    sim = ds.Simulator(scene, dt, coupling=coupling, on_failure="raise" if coupling == "monolithic" else "warn")
    check = CrossingCheck(scene, sim.thickness)
    state, contacts = sim.initial_state(), 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ds.ConvergenceWarning)  # split may fail; what is judged is where things are
        for step in range(round(0.5 / dt)):
            state = sim(state)
            assert sim.info is not None
            contacts = max(contacts, sim.info.contacts)
            assert check.problems(sim, state) == [], step
    assert contacts >= 5


@pytest.mark.parametrize("coupling", ["monolithic", "split"])
def test_what_falls_with_a_sheet_does_not_reach_through_it_when_it_lands(coupling: str) -> None:
    """A slab one millimetre above a sheet, both falling alike: only where the sheet is stopped they come near."""
    scene = ds.Scene()
    slab = ds.shapes.box((0.6, 0.6, 0.1))
    scene.add_body(slab, kind="static", position=(0, 0, 0.05))
    scene.add_cloth(ds.shapes.sheet(0.5, 6), MATERIAL, position=(0.003, 0.004, 0.1012))
    scene.add_body(slab, mass=1.0, position=(0.01, 0.02, 0.1524))
    sim = ds.Simulator(scene, 0.01, thickness=1e-4, coupling=coupling)
    check = CrossingCheck(scene, sim.thickness)
    state = sim.initial_state()
    for step in range(5):
        state = sim(state)
        assert check.problems(sim, state) == [], step
        assert float(sim.min_distance(state)) > -0.9 * sim.thickness, step
    assert sim.info is not None
    assert sim.info.contacts >= 60  # the nodes', on either side


@pytest.mark.parametrize("dt", [0.01, 0.02])
@pytest.mark.parametrize("speed", [10.0, 100.0])
@pytest.mark.parametrize("shape", ["ball", "box"])
def test_nothing_fast_passes_a_pinned_sheet(shape: str, speed: float, dt: float) -> None:
    """At 100 m/s and dt = 0.01 it moves by ten times its radius in a step, and the sheet is a line in its way."""
    scene = ds.Scene()
    n = 7
    material = ds.ClothMaterial(density=0.2, stretch=1e4, shear=1e3, bend=1e-4, damping=0.01)
    scene.add_cloth(ds.shapes.sheet(1.0, n), material, pinned=rim(n), name="sheet")
    options: dict[str, Any] = {"mass": 0.2, "position": (0.03, 0.02, 0.3), "velocity": (0, 0, -speed)}
    if shape == "ball":
        scene.add_sphere(0.1, **options)
    else:
        scene.add_body(ds.shapes.box(0.15), orientation=(1, 0.2, 0.3, 0.1), **options)
    sim = ds.Simulator(scene, dt)
    check = CrossingCheck(scene, sim.thickness)
    state, hit = sim.initial_state(), False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ds.ConvergenceWarning)
        for step in range(6):
            state = sim(state)
            assert check.problems(sim, state) == [], step
            x, z = state.position[0, :2], float(state.position[0, 2])
            # Above the sheet: the nearest node in the plane is below it.
            near = (state.node_position[:, :2] - x).norm(dim=-1).argmin()
            if float(x.abs().max()) < 0.4:
                assert z > float(state.node_position[near, 2]), step
            hit = hit or float(state.velocity[0, 2]) > -0.9 * speed
    assert hit


# ---- the same bits ---------------------------------------------------------------------------------------------------


def mixed() -> ds.Scene:
    """Cloth on a ball, a free box on cloth, a cloth folded onto itself: zones of every kind."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_sphere(0.2, kind="static", position=(0, 0, 0.3))
    scene.add_cloth(ds.shapes.sheet(0.5, 6), MATERIAL, position=(0.02, 0.03, 0.52), orientation=(1, 0.05, 0.03, 0.2))
    scene.add_cloth(ds.shapes.sheet(0.6, 5), MATERIAL, pinned=rim(5), position=(2, 0, 0.48))
    scene.add_body(ds.shapes.box(0.15), mass=0.2, position=(2.02, 0.03, 0.62), orientation=(1, 0.3, 0.2, 0.1))
    vertices, faces, rest = folded_sheet()
    scene.add_cloth((vertices, faces), MATERIAL, rest=rest, position=(-2, 0, 0.01), velocity=(0, 0, -0.5))
    return scene


STEPS, BATCH = 14, 2


def perturbed(state: ds.State) -> ds.State:
    generator = torch.Generator().manual_seed(4)
    noise = torch.randn(state.node_velocity.shape, generator=generator, dtype=torch.float64)
    return state.replace(node_velocity=state.node_velocity + 0.05 * noise)


def assert_same(a: ds.State, b: ds.State) -> None:
    for name in FIELDS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def run(sim: ds.Simulator, state: ds.State) -> tuple[ds.State, list[Tensor]]:
    """A trajectory and gradients of it, with respect to the start and the material."""
    x = state.node_position.detach().clone().requires_grad_()
    parameters = [p.requires_grad_() for p in (sim.cloth_stretch, sim.cloth_bend, sim.mass)]
    trajectory = sim.rollout(state.replace(node_position=x), None, STEPS)
    loss = trajectory.node_position.sin().sum() + trajectory.position.sum() + trajectory.node_velocity[-1].sum()
    found = torch.autograd.grad(loss, [x, *parameters])
    for parameter in parameters:
        parameter.requires_grad_(False)
    assert all(bool(g.any()) for g in found)
    return trajectory.detach(), list(found)


@pytest.mark.parametrize("coupling", ["monolithic", "split"])
@pytest.mark.filterwarnings("ignore::diffsim.ConvergenceWarning")
def test_threads_copies_gradients_and_resuming_change_no_bit(coupling: str) -> None:
    sim = ds.Simulator(mixed(), 0.01, coupling=coupling, num_threads=1)
    start = perturbed(sim.initial_state(BATCH))
    trajectory, found = run(sim, start)
    assert sim.info is not None
    assert sim.info.zones >= 3
    assert_same(sim.rollout(start, None, STEPS), trajectory)
    assert_same(copy.deepcopy(sim).rollout(start, None, STEPS), trajectory)
    threaded = ds.Simulator(mixed(), 0.01, coupling=coupling, num_threads=3)
    for other in (pickle.loads(pickle.dumps(sim)), threaded):
        again, gradients = run(other, start)
        assert_same(again, trajectory)
        for a, b in zip(gradients, found):
            assert torch.equal(a, b)
    for k in range(BATCH):
        alone, gradients = run(sim, start[k])
        assert_same(alone, trajectory[:, k])
        assert torch.equal(gradients[0], found[0][k])
    buffer = io.BytesIO()
    torch.save(trajectory[STEPS // 2 - 1].clone(), buffer)
    buffer.seek(0)
    resumed = torch.load(buffer, weights_only=False)
    assert_same(threaded.rollout(resumed, None, STEPS - STEPS // 2), trajectory[STEPS // 2 :])


def test_the_judge_sees_what_it_must() -> None:
    scene = fall("sphere")
    sim = ds.Simulator(scene, 0.01)
    check = CrossingCheck(scene, sim.thickness)
    state = sim.initial_state()
    assert check.problems(sim, state) == []
    down = torch.tensor([0.0, 0.0, -0.2], dtype=torch.float64)
    assert "radius" in check.problems(sim, state.replace(node_position=state.node_position + down))[0]
    assert "ground" in check.problems(sim, state.replace(node_position=state.node_position + 4.0 * down))[0]
    twisted = state.node_position.clone()
    twisted[40:50, 2] = twisted[40:50, 2].flip(0) + 0.1
    twisted[:, 2] += 0.2 * (-1.0) ** torch.arange(len(twisted))
    twisted[:, 1] *= -0.1
    assert "ipctk" in " ".join(check.problems(sim, state.replace(node_position=twisted.roll(7, 0))))
