"""The same bits: with and without gradients, for any number of threads, for copies, batches, segments and dtypes."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

import diffsim as ds
from diffsim import scenes

STATE_FIELDS = ("position", "orientation", "velocity", "angular_velocity")
STEPS = 50
BATCH = 4
# Between segments gradients pass through torch, as those of quaternions, and sums over steps are taken in another
# order: rounding, which contact multiplies by 1 / compliance a step.
BETWEEN_SEGMENTS = 1e-10


def mixed() -> ds.Scene:
    """Contacts of every kind, in several zones: the scene all tests here run on."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box((0.2, 1.0, 0.6)), kind="kinematic", position=(-0.9, 0, 0.4), velocity=(1.0, 0, 0))
    scene.add_body(ds.shapes.box((3.0, 3.0, 0.2)), kind="static", position=(4, 0, 0.1), orientation=(1, 0.1, 0.1, 0))
    scene.add_body(ds.shapes.box(0.5), density=800.0, position=(0, 0, 0.3), orientation=(1, 0, 0, 0.1))
    scene.add_body(
        ds.shapes.l_shape(0.6, 0.2, 0.3), density=500.0, position=(0.05, 0, 0.95), orientation=(1, 0.4, 0, 0.2)
    )
    scene.add_sphere(0.2, density=700.0, position=(4, 0, 0.7), velocity=(0, 0, -2))
    scene.add_capsule(0.15, 0.5, density=700.0, position=(4.1, 0.1, 1.15), orientation=(1, 0.5, 0.2, 0))
    return scene


def controls(sim: ds.Simulator, *leading: int) -> ds.Control:
    generator = torch.Generator().manual_seed(3)
    shape = (*leading, len(sim.body_names), 3)
    return ds.Control(force=3.0 * sim.mass.detach()[:, None] * torch.randn(shape, generator=generator).double())


def perturbed(state: ds.State) -> ds.State:
    """Every scene of a batch another one; only velocities differ, so that nothing overlaps."""
    generator = torch.Generator().manual_seed(4)
    return state.replace(
        velocity=state.velocity + 0.1 * torch.randn(state.velocity.shape, generator=generator).double()
    )


def assert_same(a: ds.State, b: ds.State) -> None:
    for name in STATE_FIELDS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def gradients(sim: ds.Simulator, state: ds.State, control: ds.Control, **options: Any) -> tuple[ds.State, list[Tensor]]:
    """Of a function of the whole trajectory, with respect to all inputs; unbatched parameters get the sum."""
    leaves = {name: getattr(state, name).detach().clone().requires_grad_() for name in STATE_FIELDS}
    assert control.force is not None
    force = control.force.detach().clone().requires_grad_()
    parameters = [p.requires_grad_() for p in (sim.mass, sim.inertia, sim.gravity)]
    trajectory = sim.rollout(state.replace(**leaves), ds.Control(force=force), STEPS, **options)
    loss = trajectory.position.sin().sum() + trajectory.velocity[-1].square().sum() + trajectory.orientation.sum()
    found = torch.autograd.grad(loss, [*leaves.values(), force, *parameters])
    for parameter in parameters:
        parameter.requires_grad_(False)
    return trajectory.detach(), list(found)


def assert_same_gradients(a: list[Tensor], b: list[Tensor]) -> None:
    for x, y in zip(a, b):
        assert x.any()
        assert torch.equal(x, y)


def test_there_is_contact() -> None:
    sim = ds.Simulator(mixed(), dt=0.01, on_failure="raise")
    state, zones, largest_zone = sim.initial_state(), 0, 0
    for _ in range(STEPS):
        state = sim(state, controls(sim))
        assert sim.info is not None
        zones, largest_zone = max(zones, sim.info.zones), max(largest_zone, sim.info.largest_zone)
    assert zones >= 3
    assert largest_zone >= 2


def test_with_and_without_gradients() -> None:
    sim = ds.Simulator(mixed(), dt=0.01)
    plain = sim.rollout(sim.initial_state(), controls(sim), STEPS)
    recorded, _ = gradients(sim, sim.initial_state(), controls(sim))
    assert_same(plain, recorded)


def test_run_to_run() -> None:
    runs = [gradients(sim, sim.initial_state(), controls(sim)) for sim in (ds.Simulator(mixed(), dt=0.01),) * 2]
    runs.append(gradients(fresh := ds.Simulator(mixed(), dt=0.01), fresh.initial_state(), controls(fresh)))
    for trajectory, found in runs[1:]:
        assert_same(trajectory, runs[0][0])
        assert_same_gradients(found, runs[0][1])


@pytest.mark.parametrize("threads", [2, 4])
def test_one_thread_or_more(threads: int) -> None:
    runs = []
    for count in (1, threads):
        sim = ds.Simulator(mixed(), dt=0.01, num_threads=count)
        runs.append(gradients(sim, perturbed(sim.initial_state(BATCH)), controls(sim, BATCH)))
    assert_same(runs[0][0], runs[1][0])
    assert_same_gradients(runs[0][1], runs[1][1])


def many_zones() -> ds.Scene:
    """Stacks, pushers and obstacles that several stacks lean on, more than enough to be shared among threads."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box((14.0, 0.3, 0.2)), kind="static", position=(6, -0.42, 0.15))
    for row in range(3):
        scene.add_body(
            ds.shapes.box((14.0, 0.2, 0.4)), kind="kinematic", position=(6, 0.5 + row, 0.3), velocity=(0, -0.55, 0)
        )
    for k in range(36):
        x, y = k % 12, k // 12
        turn = (1.0, 0.002 * x, 0.0, 0.1 * y)
        scene.add_body(ds.shapes.box(0.5), density=800.0, position=(x, y, 0.28), orientation=turn)
        scene.add_sphere(0.2, density=300.0, position=(x + 0.03, y - 0.02, 0.8 + 0.01 * k), velocity=(0, 0, -1))
    return scene


def blocked_drives() -> ds.Scene:
    """Presses that squeeze boxes on the ground, where the step has to be solved again with shorter drives."""
    scene = ds.Scene()
    scene.add_ground()
    for k in range(2):
        scene.add_body(
            ds.shapes.box((18.0, 0.8, 0.2)), kind="kinematic", position=(8.5, k, 0.6 + 0.02 * k), velocity=(0, 0, -3.0)
        )
    for k in range(72):
        scene.add_body(
            ds.shapes.box((0.3, 0.3, 0.4 + 0.002 * (k % 5))),
            density=500.0,
            position=(0.5 * (k // 2), k % 2, 0.23),
            orientation=(1, 0.01, 0.01 * (k % 3), 0.1),
        )
    return scene


def cloths_and_bodies(**options: Any) -> ds.Scene:
    scene = ds.Scene(**options)
    scene.add_ground()
    for k in range(3):
        scene.add_sphere(0.15, density=400.0, position=(k, 0.02 * k, 0.2))
        scene.add_cloth(ds.shapes.sheet(0.6, 7), position=(k, 0, 0.37 + 0.01 * k), pinned=[0, 6] if k == 1 else [])
        scene.add_body(ds.shapes.box(0.2), density=500.0, position=(k + 0.45, 0, 0.13), orientation=(1, 0, 0, 0.1 * k))
    return scene


def shared_run(make: Callable[[], ds.Scene], threads: int, steps: int, **options: Any) -> tuple[ds.State, list[Tensor]]:
    """One scene, not a batch, and gradients with respect to all that there is."""
    sim = ds.Simulator(make(), dt=0.01, num_threads=threads, **options)
    start = sim.initial_state()
    names = [*STATE_FIELDS, *(("node_position", "node_velocity") if start.node_position.shape[-2] else ())]
    leaves = {name: getattr(start, name).detach().clone().requires_grad_() for name in names}
    force = torch.zeros_like(start.position).requires_grad_()
    parameters = [sim.mass, sim.inertia, sim.gravity]
    if len(names) > len(STATE_FIELDS):
        parameters += [sim.cloth_density, sim.cloth_stretch, sim.cloth_shear, sim.cloth_bend]
    for parameter in parameters:
        parameter.requires_grad_()
    trajectory = sim.rollout(start.replace(**leaves), ds.Control(force=force), steps)
    loss = sum((getattr(trajectory, name).sin().sum() for name in names), start=torch.zeros(()))
    return trajectory.detach(), list(torch.autograd.grad(loss, [*leaves.values(), force, *parameters]))


@pytest.mark.filterwarnings("ignore::diffsim.ConvergenceWarning")
@pytest.mark.parametrize(
    ("make", "steps", "options"),
    [
        (many_zones, 30, {}),
        (many_zones, 8, {"compliance": 0.0}),
        (many_zones, 8, {"adjoint": "qr"}),
        (blocked_drives, 6, {}),
        (cloths_and_bodies, 12, {}),
        (cloths_and_bodies, 12, {"coupling": "split"}),
    ],
)
def test_threads_inside_one_scene(make: Callable[[], ds.Scene], steps: int, options: dict[str, Any]) -> None:
    alone, single = shared_run(make, 1, steps, **options)
    for threads in (2, 3):
        together, found = shared_run(make, threads, steps, **options)
        for name in ("node_position", "node_velocity", *STATE_FIELDS):
            assert torch.equal(getattr(alone, name), getattr(together, name)), name
        assert_same_gradients(found, single)


@pytest.mark.filterwarnings("default::diffsim.ConvergenceWarning")
def test_scenes_for_threads_are_what_they_are_for() -> None:
    """Several zones at a time, bodies that zones share, and drives that are blocked."""
    sim = ds.Simulator(many_zones(), dt=0.01)
    sim.rollout(sim.initial_state(), None, 30)
    assert sim.info is not None
    assert sim.info.zones >= 10
    assert sim.info.contacts >= 100
    sim = ds.Simulator(blocked_drives(), dt=0.01)
    with pytest.warns(ds.ConvergenceWarning):
        sim.rollout(sim.initial_state(), None, 6)
    assert sim.info is not None
    assert "blocked" in sim.info.failure
    sim = ds.Simulator(cloths_and_bodies(), dt=0.01)
    sim.rollout(sim.initial_state(), None, 12)
    assert sim.info is not None
    assert sim.info.zones >= 3


def test_threads_refuse_a_state_with_the_same_words() -> None:
    """Two of many groups penetrate: the first one is named, whichever thread came to it when."""
    words = set()
    for threads in (1, 2, 3, 3, 3):
        sim = ds.Simulator(scenes.falling_cubes(100), dt=0.01, num_threads=threads)
        state = sim.initial_state()
        position = state.position.clone()
        position[[31, 77], 2] = 0.5 - 1e-3
        with pytest.raises(ValueError, match="penetrate") as caught:
            sim(state.replace(position=position))
        words.add(str(caught.value))
    assert len(words) == 1
    assert "31" in words.pop()


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_copies(copied: Callable[[Any], Any]) -> None:
    sim = ds.Simulator(mixed(), dt=0.01)
    state = sim.rollout(sim.initial_state(), None, 20)[-1]
    a = gradients(sim, state, controls(sim))
    b = gradients(copied(sim), copied(state), copied(controls(sim)))
    assert_same(a[0], b[0])
    assert_same_gradients(a[1], b[1])


def test_rollout_steps_and_checkpoints() -> None:
    sim = ds.Simulator(mixed(), dt=0.01)
    state = sim.initial_state()
    control = controls(sim, STEPS)
    trajectory, found = gradients(sim, state, control)
    assert control.force is not None
    stepped = state
    for step in range(STEPS):
        stepped = sim(stepped, ds.Control(force=control.force[step]))
        assert_same(stepped, trajectory[step])
    for every in (1, 7, STEPS):
        again, by_checkpoints = gradients(sim, state, control, checkpoint_every=every)
        assert_same(again, trajectory)
        for x, y in zip(found, by_checkpoints):
            assert x.any()
            assert float((x - y).abs().max()) <= BETWEEN_SEGMENTS * float(x.abs().max())


def test_resumed_from_a_saved_state() -> None:
    sim = ds.Simulator(mixed(), dt=0.01)
    whole = sim.rollout(sim.initial_state(), controls(sim), 2 * STEPS)
    middle = pickle.loads(pickle.dumps(whole[STEPS - 1].clone()))
    other = ds.Simulator(mixed(), dt=0.01)
    other.rollout(other.initial_state(), None, 3)  # a step leaves nothing behind that the next could see
    assert_same(other.rollout(middle, controls(other), STEPS), whole[STEPS:])


def test_a_batch_is_single_runs() -> None:
    sim = ds.Simulator(mixed(), dt=0.01)
    state, control = perturbed(sim.initial_state(BATCH)), controls(sim, BATCH)
    trajectory, found = gradients(sim, state, control)
    assert control.force is not None
    total = [torch.zeros_like(x) for x in found[5:]]
    for scene in range(BATCH):
        alone, single = gradients(sim, state[scene], ds.Control(force=control.force[scene]))
        assert_same(trajectory[:, scene], alone)
        assert_same_gradients([x[scene] for x in found[:5]], single[:5])
        total = [t + x for t, x in zip(total, single[5:])]
    for x, y in zip(found[5:], total):
        assert x.any()
        assert float((x - y).abs().max()) <= 1e-13 * float(x.abs().max())  # a sum of BATCH terms


def test_float32_is_float64_rounded_once() -> None:
    sim = ds.Simulator(mixed(), dt=0.01)
    state, control = sim.initial_state().to(torch.float32), controls(sim).to(torch.float32)
    single, found = gradients(sim, state, control)
    double, expected = gradients(sim, state.to(torch.float64), control.to(torch.float64))
    assert single.dtype == torch.float32
    assert_same(single, double.to(torch.float32))
    for x, y in zip(found[:5], expected[:5]):
        assert x.dtype == torch.float32
        # The loss itself is float32 here: its gradients enter with that rounding, and contact multiplies it.
        assert float((x - y).abs().max()) <= 1e-3 * float(y.abs().max())


def test_the_buffer_does_not_matter() -> None:
    """Tensors at any alignment, and strided ones."""
    sim = ds.Simulator(scenes.box_on_box(fixed=False), dt=0.01)
    state = sim.initial_state()
    expected = sim.rollout(state, None, STEPS)
    for offset in (1, 3):
        shifted = {}
        for name in STATE_FIELDS:
            value = getattr(state, name)
            room = torch.zeros(value.numel() + offset, dtype=torch.float64)
            room[offset:] = value.flatten()
            shifted[name] = room[offset:].view(value.shape)
            assert shifted[name].data_ptr() % 16 == (room.data_ptr() + 8 * offset) % 16
        assert_same(sim.rollout(state.replace(**shifted), None, STEPS), expected)
    reversed_twice = {name: getattr(state, name).flip(-1).flip(-1) for name in STATE_FIELDS}
    assert_same(sim.rollout(state.replace(**reversed_twice), None, STEPS), expected)
