"""What goes wrong must not hurt: squeezes, steps that give up, bad input, long use, random scenes."""

from __future__ import annotations

import math
import resource
import runpy
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from penetration import PenetrationCheck

import diffsim as ds
from diffsim import scenes
from diffsim.ops import RolloutCall, rollout

STATE_FIELDS = ("position", "orientation", "velocity", "angular_velocity")
FUZZ = Path(__file__).parent.parent / "fuzz.py"
STATM = Path("/proc/self/statm")


@pytest.fixture
def fuzz(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[[str], tuple[int, str]]:
    """Exit code and output of the fuzz script, run here, where torch is loaded already."""

    def run(options: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", [str(FUZZ), *options.split()])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(FUZZ), run_name="__main__")
        return int(ended.value.code or 0), capsys.readouterr().out

    return run


def test_random_scenes(fuzz: Callable[[str], tuple[int, str]]) -> None:
    """A few of the scenes of the fuzz script, which can run longer."""
    code, output = fuzz("--scenes 3 --steps 200 --first 4")
    assert code == 0, output
    assert "3 scenes of 10 bodies and 200 steps" in output
    assert ": 0 scenes with problems" in output


@pytest.mark.parametrize(("scene", "steps"), [(1, 34), (26, 6)])
def test_heaps_whose_hessian_is_indefinite_converge(
    fuzz: Callable[[str], tuple[int, str]], scene: int, steps: int
) -> None:
    """Scenes with a step that does not converge if contacts' curvature is always left out."""
    _, output = fuzz(f"--scenes 1 --first {scene} --steps {steps}")
    assert f"0 of {steps} steps in 0 scenes did not converge" in output, output


@pytest.mark.parametrize("seed", [0, 1])
def test_light_bodies_among_heavy_ones_converge(seed: int) -> None:
    """Boxes and balls of 1 to 1000 kg fall on each other in four columns: light ones are squeezed and spun."""
    random = np.random.default_rng(seed)
    scene = ds.Scene()
    scene.add_ground()
    for i in range(32):
        orientation = random.normal(size=4)
        corner = 0.28 * np.array([i % 2, i // 2 % 2]) - 0.14 + random.uniform(-0.01, 0.01, 2)
        scene.add_body(
            ds.shapes.box((0.2, 0.16, 0.12)) if i % 2 else ds.shapes.icosphere(0.09, subdivisions=1),
            position=(*corner, 0.2 + 0.3 * (i // 4)),
            orientation=tuple(orientation / np.linalg.norm(orientation)),
            mass=10.0 ** random.uniform(0.0, 3.0),
        )
    sim = ds.Simulator(scene, dt=0.01, num_threads=1, on_failure="raise")
    with torch.no_grad():
        trajectory = sim.rollout(sim.initial_state(), ds.Control(), steps=80)
    assert sim.info is not None
    assert sim.info.contacts > 20
    assert_no_penetration(scene, sim, trajectory)


def test_derivatives_in_random_scenes_with_cloth(fuzz: Callable[[str], tuple[int, str]]) -> None:
    """No derivative of a step disagrees with central differences of every step size."""
    code, output = fuzz("--scenes 3 --steps 60 --bodies 4 --cloths 1 --gradients 20")
    assert code == 0, output
    assert ": 0 scenes with problems" in output
    derivatives = int(output.rsplit("; ", 1)[1].split()[0])
    assert derivatives > 50


# ---- squeezes --------------------------------------------------------------------------------------------------------


def squeeze() -> ds.Scene:
    """A plate above a cube on the ground; PRESS drives it down, further than there is room."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.5), density=1000.0, position=(0, 0, 0.251), name="cube")
    scene.add_body(ds.shapes.box((2, 2, 0.2)), kind="kinematic", position=(0.1, 0.05, 0.65), name="press")
    return scene


def driven(speed: float) -> ds.Control:
    return ds.Control(body_velocity=torch.tensor([[0.0, 0, 0], [0, 0, speed]], dtype=torch.float64))


PRESS = driven(-0.5)


def assert_finite(state: ds.State) -> None:
    for name in STATE_FIELDS:
        assert bool(getattr(state, name).isfinite().all()), name


def assert_no_penetration(scene: ds.Scene, sim: ds.Simulator, trajectory: ds.State) -> None:
    check = PenetrationCheck(scene, sim.thickness)
    for step, frame in enumerate(trajectory):
        assert check.problems(sim, frame) == [], step


def test_a_long_squeeze_is_survived_and_told() -> None:
    scene = squeeze()
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    with pytest.warns(ds.ConvergenceWarning, match="did not converge") as caught:
        trajectory = sim.rollout(state, PRESS, 60)
    assert len(caught) == 1
    assert sim.info is not None
    assert not sim.info.converged
    assert sim.info.failed_steps >= 40
    assert_finite(trajectory)
    assert_no_penetration(scene, sim, trajectory)
    # The press has gone as far as there was room, but for a step that it could not finish; the cube has stayed.
    height = trajectory.position[-1, 1, 2] - 0.1
    assert 0.5 < float(height) < 0.5 + 3 * sim.thickness + 0.5 * sim.dt
    assert float((trajectory.position[-1, 0, :2]).norm()) < 0.01
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # told once
        sim.rollout(trajectory[-1], PRESS, 3)
    assert not sim.info.converged


def test_a_squeeze_ends_when_the_press_goes_back() -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    with pytest.warns(ds.ConvergenceWarning):
        squeezed = sim.rollout(sim.initial_state(), PRESS, 25)[-1]
    released = sim.rollout(squeezed, driven(0.5), 40)
    assert sim.info is not None
    assert sim.info.converged
    assert float(released.position[-1, 1, 2] - squeezed.position[1, 2]) == pytest.approx(0.2, rel=1e-9)
    assert float(released.position[-1, 0, 2]) == pytest.approx(0.25, abs=2 * sim.thickness)
    assert float(released.velocity[-1, 0].norm()) < 1e-3


def test_gradients_through_a_squeeze_are_finite() -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    state = sim.initial_state()
    leaves = [getattr(state, name).requires_grad_() for name in STATE_FIELDS]
    parameters = [p.requires_grad_() for p in (sim.mass, sim.inertia, sim.gravity)]
    with pytest.warns(ds.ConvergenceWarning):
        trajectory = sim.rollout(state, PRESS, 25)
    found = torch.autograd.grad(trajectory.position.sum() + trajectory.velocity.sum(), leaves + parameters)
    assert all(bool(g.isfinite().all()) for g in found)
    assert found[0].any()


def test_a_squeeze_raises_if_asked_to() -> None:
    scene = squeeze()
    sim = ds.Simulator(scene, dt=0.01, on_failure="raise")
    with pytest.raises(ds.SolverError, match="did not converge") as caught:
        sim.rollout(sim.initial_state(), PRESS, 25)
    error = caught.value
    assert not error.info.converged
    assert math.isfinite(error.residual)
    assert_finite(error.state)
    assert_no_penetration(scene, sim, error.state)


def test_a_slow_enough_press_does_what_it_can() -> None:
    """The press stops within its reach: no squeeze, no failure."""
    sim = ds.Simulator(squeeze(), dt=0.01, on_failure="raise")
    end = sim.rollout(sim.initial_state(), driven(-0.04), 100)[-1]
    assert float(end.position[1, 2]) == pytest.approx(0.61, abs=1e-9)


# ---- giving up early -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [scenes.tilted_box, scenes.nonconvex_pair, scenes.kinematic_pusher])
def test_one_iteration_is_safe(make: Any) -> None:
    scene = make()
    sim = ds.Simulator(scene, dt=0.01, max_iterations=1)
    state = sim.initial_state()
    state.velocity.requires_grad_()
    with pytest.warns(ds.ConvergenceWarning, match="did not converge") as caught:
        trajectory = sim.rollout(state, None, 80)
    assert len(caught) == 1
    assert sim.info is not None
    assert not sim.info.converged
    assert_finite(trajectory)
    assert_no_penetration(scene, sim, trajectory.detach())
    (gradient,) = torch.autograd.grad(trajectory.position[-1].sum(), state.velocity)
    assert gradient.any()
    assert bool(gradient.isfinite().all())


def test_a_batch_fails_scene_by_scene() -> None:
    """One scene that cannot converge neither spoils the others nor hides among them."""
    sim = ds.Simulator(squeeze(), dt=0.01)
    state = sim.initial_state(batch=3)
    assert PRESS.body_velocity is not None
    velocity = PRESS.body_velocity * torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)[:, None, None]
    with pytest.warns(ds.ConvergenceWarning):
        trajectory = sim.rollout(state, ds.Control(body_velocity=velocity), 25)
    assert bool((trajectory.position[-1, 1] != trajectory.position[-1, 0]).any())
    alone = sim.rollout(state[0], driven(0.0), 25)
    assert sim.info is not None
    assert sim.info.converged
    for name in STATE_FIELDS:
        assert torch.equal(getattr(trajectory, name)[:, 0], getattr(alone, name))
        assert torch.equal(getattr(trajectory, name)[:, 2], getattr(alone, name))


# ---- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [0.0, 1e-3, 0.05, 0.25])
def test_states_in_the_ground_are_refused_by_name(depth: float) -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    state = sim.initial_state()
    position = state.position.clone()
    position[0, 2] = 0.25 - depth
    with pytest.raises(ValueError, match=r"'cube'.*ground|ground.*'cube'"):
        sim(state.replace(position=position))


def test_a_state_of_ours_in_the_ground_is_held_and_told() -> None:
    """Between the segments of a rollout, that is: the same state that is refused as the caller's."""
    sim = ds.Simulator(squeeze(), dt=0.01)
    state = sim.initial_state()
    position = state.position.clone()
    position[0, 2] = 0.25 - 1e-3
    inputs = sim._checked_inputs("test", state.replace(position=position), None, None).inputs
    with pytest.raises(ValueError, match="penetrate"):
        rollout(RolloutCall(sim._model, sim._options, 2, 1), *inputs)
    call = RolloutCall(sim._model, sim._options, 2, 1, first_step=4)
    end = rollout(call, *inputs)
    assert torch.equal(end[0], position)
    assert call.info is not None
    assert call.info.failed_steps == 2
    assert call.info.failure == "objects penetrate at the start"


@pytest.mark.parametrize("depth", [1e-4, 1e-3, 0.05])
def test_states_in_each_other_are_refused_by_name(depth: float) -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    state = sim.initial_state()
    position = state.position.clone()
    position[1, 2] = position[0, 2] + 0.35 - depth
    with pytest.raises(ValueError, match=r"'cube'.*'press'|'press'.*'cube'"):
        sim(state.replace(position=position))


@pytest.mark.parametrize(
    ("parameter", "value", "text"),
    [
        ("mass", 0.0, r"mass.*'cube'|'cube'.*mass"),
        ("mass", -1.0, r"mass.*'cube'|'cube'.*mass"),
        ("mass", math.nan, r"mass.*'cube'|'cube'.*mass"),
        ("inertia", -1.0, r"inertia.*'cube'|'cube'.*inertia"),
        ("inertia", math.inf, r"inertia.*'cube'|'cube'.*inertia"),
        ("gravity", math.nan, "gravity"),
    ],
)
def test_bad_parameters_are_refused_by_name(parameter: str, value: float, text: str) -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    state = sim.initial_state()
    with torch.no_grad():
        getattr(sim, parameter)[0] *= value if value else 0.0
    with pytest.raises(ValueError, match=text):
        sim(state)


def test_refusals_tell_the_value_the_scene_and_the_step() -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    batch = sim.initial_state(batch=3)
    batch.velocity[2, 0, 1] = math.nan
    with pytest.raises(ValueError, match=r"state.velocity of body 'cube'.*got \(0 nan 0\), in scene 2$"):
        sim(batch)
    state = sim.initial_state()
    force = torch.zeros(5, *state.position.shape, dtype=torch.float64)
    force[4, 0, 0] = math.inf
    for checkpoint_every in (None, 2):
        with pytest.raises(ValueError, match=r"control.force of body 'cube'.*got \(inf 0 0\), in step 4$"):
            sim.rollout(state, ds.Control(force=force), 5, checkpoint_every=checkpoint_every)
    with torch.no_grad():
        sim.inertia[0] *= -1.0
    with pytest.raises(ValueError, match=r"inertia of body 'cube' .*must be positive definite, got \(-.*; .*\) kg·m²$"):
        sim(state)
    sim = ds.Simulator(squeeze(), dt=0.01)
    with torch.no_grad():
        sim.gravity[0] = math.nan
    with pytest.raises(ValueError, match=r"gravity must be finite, got \(nan 0 -9.81\) m/s²"):
        sim(state)


def test_a_quaternion_that_is_none_is_refused_by_name() -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    state = sim.initial_state()
    with pytest.raises(ValueError, match=r"orientation.*'cube'|'cube'.*orientation"):
        sim(state.replace(orientation=1.1 * state.orientation))
    with pytest.raises(ValueError, match=r"orientation.*'cube'|'cube'.*orientation"):
        sim(state.replace(orientation=0.0 * state.orientation))


@pytest.mark.parametrize("name", ["velocity", "angular_velocity"])
def test_absurd_speeds_are_answered(name: str) -> None:
    """Either a step or an error that says what is wrong; never NaN, never a hang."""
    scene = scenes.tilted_box()
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    for size in (1e5, 1e8, 1e12):
        fast = state.replace(**{name: size * torch.tensor([[0.3, 0.2, -1.0]], dtype=torch.float64)})
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ds.ConvergenceWarning)
            try:
                end = sim(fast)
            except ValueError as error:
                assert name in str(error)  # noqa: PT017  # either is fine
                continue
        assert_finite(end)
        assert PenetrationCheck(scene, sim.thickness).problems(sim, end) == []


# ---- long use --------------------------------------------------------------------------------------------------------


def test_a_long_row_lands_in_few_newton_steps() -> None:
    """A symmetric stack lands on a saddle of the energy: its cubes leave it together, not one after the other. Then a
    dozen contacts of each pair come and go: the model of all of them finds those that push, where Newton steps took 18.
    """
    sim = ds.Simulator(scenes.two_layer_stack(150), dt=0.01, on_failure="raise")
    state, iterations = sim.initial_state(), []
    for _ in range(4):
        state = sim(state)
        assert sim.info is not None
        iterations.append(sim.info.iterations)
    assert 6 <= max(iterations) <= 12, iterations


@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
def test_memory_is_flat_over_two_thousand_rollouts() -> None:
    sim = ds.Simulator(scenes.tilted_box(height=0.75), dt=0.01)
    state = sim.initial_state(batch=2)
    control = ds.Control(force=torch.ones(1, 3, dtype=torch.float64))

    def resident_bytes() -> int:
        return int(STATM.read_text().split()[1]) * resource.getpagesize()

    def roll(count: int) -> None:
        for index in range(count):
            velocity = state.velocity.clone().requires_grad_()
            every = (None, 4)[index % 2]
            end = sim.rollout(state.replace(velocity=velocity), control, 10, every)[-1]
            if index % 3:  # sometimes no backward follows
                end.position.sum().backward()

    roll(300)
    before = resident_bytes()
    roll(2000)
    assert resident_bytes() - before < 2000 * 500  # a leaked tape, state or array is more than 500 bytes
