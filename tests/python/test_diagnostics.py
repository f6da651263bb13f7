import math
from typing import Any

import pytest
import torch
from small_scenes import landing_box, only_read

import diffsim as ds
from diffsim import _core
from diffsim.diagnostics import gradcheck


@pytest.fixture
def sim() -> ds.Simulator:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((1.0, 0.7, 0.4)), density=2.0, position=(0, 0, 5), angular_velocity=(1.0, -2.0, 0.5))
    scene.add_body(ds.shapes.box(1.0), kind="kinematic", position=(9, 0, 5), velocity=(0, 1, 0))
    return ds.Simulator(scene, dt=0.01)


def test_passes_in_free_flight(sim: ds.Simulator) -> None:
    control = ds.Control(force=torch.ones(2, 3).double(), body_angular_velocity=torch.ones(2, 3).double())
    control = only_read(sim, control)
    report = gradcheck(sim, sim.initial_state(), control, steps=10)
    names = ["position", "orientation", "velocity", "angular_velocity", "force", "body_angular_velocity"]
    assert list(dict.fromkeys(d.name for d in report.directions)) == [*names, "mass", "inertia", "gravity"]
    assert len(report.directions) == 9 * 4
    assert report.passed
    assert report.median_error < 1e-7
    assert report.median_error <= report.max_error < 1e-5
    assert report.stable == report.directions
    assert not report.zero_gradients


def test_passes_in_contact() -> None:
    sim = landing_box()
    report = gradcheck(sim, sim.initial_state(), steps=20)
    assert sim.info is not None
    assert sim.info.contacts > 0
    assert report.passed, str(report)


def test_is_reproducible_and_seeded(sim: ds.Simulator) -> None:
    state = sim.initial_state()
    first, again, other = (gradcheck(sim, state, wrt=["velocity"], seed=seed) for seed in (1, 1, 2))
    assert first == again
    assert first != other


@pytest.mark.parametrize("form", ["sequence", "time", "batch", "float32"])
def test_takes_what_rollout_takes(sim: ds.Simulator, form: str) -> None:
    torques = torch.randn(3, 2, 3, dtype=torch.float64) * torch.tensor([[1.0], [0.0]])
    state, controls = sim.initial_state(), ds.Control(torque=torques)
    if form == "batch":
        state, controls = sim.initial_state(batch=2), ds.Control(torque=torques[0])
    if form == "float32":
        state, controls = state.to(torch.float32), controls.to(torch.float32)
    sequence = [ds.Control(torque=torque) for torque in torques]
    report = gradcheck(sim, state, sequence if form == "sequence" else controls, steps=3, directions=2)
    assert "torque" in {d.name for d in report.directions}
    assert report.passed, str(report)


def test_own_loss(sim: ds.Simulator) -> None:
    state = sim.initial_state()
    report = gradcheck(sim, state, steps=3, wrt=["velocity"], directions=2, loss=lambda end: end.position[0, 0] ** 2)
    assert report.zero_gradients == ("velocity",)  # x is 0 throughout
    assert not report.passed
    moving = state.replace(velocity=state.velocity + 1)
    assert gradcheck(sim, moving, steps=3, wrt=["velocity"], loss=lambda end: end.position[0, 0] ** 2).passed


def test_a_wrong_gradient_fails(sim: ds.Simulator, monkeypatch: pytest.MonkeyPatch) -> None:
    backward = _core.rollout_backward

    def wrong(*args: Any, **options: Any) -> Any:
        grads = backward(*args, **options)
        return (*grads[:2], None if grads[2] is None else 1.001 * grads[2], *grads[3:])

    monkeypatch.setattr(_core, "rollout_backward", wrong)
    report = gradcheck(sim, sim.initial_state())
    assert not report.passed
    assert report.max_error == pytest.approx(1e-3, rel=1e-2)
    assert {d.name for d in report.directions if d.error > 1e-4} == {"velocity"}


def test_a_missing_gradient_fails(sim: ds.Simulator) -> None:
    report = gradcheck(sim, sim.initial_state(), loss=lambda end: end.position.detach().sum().requires_grad_())
    assert not report.passed
    assert set(report.zero_gradients) == {d.name for d in report.directions}
    assert "nothing tested: position, orientation" in str(report)


def test_directions_across_a_change_of_contacts_are_told_and_not_judged(
    sim: ds.Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = sim.initial_state()
    monkeypatch.setattr(sim, "_rollout", changing(sim._rollout))
    report = gradcheck(sim, state, wrt=["velocity", "gravity"], directions=3)
    assert {d.name for d in report.directions if d.active_set_changed} == {"gravity"}
    assert len(report.stable) == 3
    assert "changed" in str(report)
    alone = gradcheck(sim, state, wrt=["gravity"])
    assert not alone.passed
    assert math.isnan(alone.max_error)


def changing(rollout: Any) -> Any:
    """A rollout whose active set depends on gravity."""

    def changed(state: ds.State, controls: Any, steps: int, **options: Any) -> Any:
        trajectory, signature = rollout(state, controls, steps, **options)
        gained = (trajectory.velocity[-1, 0] - state.velocity[0]).sum().item()
        return trajectory, signature + abs(round(1e9 * (gained + steps * 0.01 * 9.81)))

    return changed


def test_report_is_a_table(sim: ds.Simulator) -> None:
    lines = str(gradcheck(sim, sim.initial_state(), steps=2, wrt=["velocity", "mass"], directions=2)).splitlines()
    assert lines[0].split() == ["input", "derivative", "difference", "error", "active", "set"]
    assert [line.split()[0] for line in lines[1:5]] == ["velocity", "velocity", "mass", "mass"]
    assert lines[-1].startswith(("passed: 2 step(s)", "FAILED: 2 step(s)"))


def test_wrong_arguments_are_named(sim: ds.Simulator) -> None:
    state = sim.initial_state()
    with pytest.raises(ValueError, match=r"gradcheck: wrt must hold names out of position, .*, got 'force'"):
        gradcheck(sim, state, wrt=["force"])
    with pytest.raises(ValueError, match="gradcheck: eps must be finite and larger than 0"):
        gradcheck(sim, state, eps=0.0)
    with pytest.raises(TypeError, match=r"gradcheck: sim must be a diffsim.Simulator, got str"):
        gradcheck("sim", state)  # type: ignore[arg-type]


def test_an_eps_that_makes_bodies_penetrate_is_refused() -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.2), density=1000.0, position=(0, 0, 0.1003), name="crate")
    sim = ds.Simulator(scene, dt=0.01)
    message = "gradcheck: with position moved by eps = 0.01: .* 'crate' and 'ground' penetrate.*; take a smaller eps"
    with pytest.raises(ValueError, match=message):
        gradcheck(sim, sim.initial_state(), wrt=["position"], eps=0.01)
