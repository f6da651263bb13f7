import sys
from typing import Any

import pytest
import torch
from small_scenes import CONTACT_ROUNDING, ROUNDING, STATE_FIELDS, assert_same, falling_box, make_scene
from torch import Tensor

import diffsim as ds
from diffsim import _core

# ---- rollout ---------------------------------------------------------------------------------------------------------


def stepped(sim: ds.Simulator, state: ds.State, controls: list[Any]) -> ds.State:
    states = []
    for control in controls:
        state = sim(state, control)
        states.append(state)
    return ds.State(*(torch.stack([getattr(s, name) for s in states]) for name in STATE_FIELDS))


def test_rollout_is_repeated_stepping(sim: ds.Simulator, state: ds.State) -> None:
    assert_same(sim.rollout(state, None, 7), stepped(sim, state, [None] * 7))
    control = ds.Control(torque=torch.randn(2, 3, dtype=torch.float64))
    assert_same(sim.rollout(state, control, 7), stepped(sim, state, [control] * 7))


def test_rollout_with_contact_is_repeated_stepping() -> None:
    sim = falling_box()
    state = sim.initial_state()
    assert_same(sim.rollout(state, None, 30), stepped(sim, state, [None] * 30))


def test_controls_may_be_left_out_and_a_sequence_tells_the_number_of_steps(sim: ds.Simulator, state: ds.State) -> None:
    expected = sim.rollout(state, None, 4)
    assert_same(sim.rollout(state, steps=4), expected)
    assert_same(sim.rollout(state, [ds.Control()] * 4), expected)
    for controls in (None, ds.Control(), 4):
        with pytest.raises(TypeError, match=r"rollout: steps must be given, as in sim.rollout\(state, steps=100\)"):
            sim.rollout(state, controls)  # type: ignore[arg-type]


def test_forms_of_controls_unbatched(sim: ds.Simulator, state: ds.State) -> None:
    forces = torch.randn(5, 2, 3, dtype=torch.float64)
    torque = torch.randn(2, 3, dtype=torch.float64)
    each = [ds.Control(force=f, torque=torque) for f in forces]
    expected = stepped(sim, state, each)
    assert_same(sim.rollout(state, each, 5), expected)
    assert_same(sim.rollout(state, tuple(each), 5), expected)
    assert_same(sim.rollout(state, ds.Control(force=forces, torque=torque), 5), expected)
    # In a sequence no force is no force, for this step.
    gaps = [ds.Control(force=forces[0]), ds.Control(torque=torque), ds.Control()]
    assert_same(sim.rollout(state, gaps, 3), stepped(sim, state, gaps))


def test_forms_of_controls_batched(sim: ds.Simulator) -> None:
    state = sim.initial_state(batch=3)
    force = torch.randn(5, 3, 2, 3, dtype=torch.float64)

    def roll(value: Tensor) -> ds.State:
        return sim.rollout(state, ds.Control(force=value), 5)

    def expected(value: Tensor) -> ds.State:
        return stepped(sim, state, [ds.Control(force=f) for f in value.expand(5, 3, 2, 3)])

    assert_same(roll(force), expected(force))
    assert_same(roll(force[0, 0]), expected(force[0, 0]))  # constant, one for all
    assert_same(roll(force[0]), expected(force[:1]))  # constant, one for each
    assert_same(roll(force[:, 0]), expected(force[:, :1]))  # in time, one for all
    assert_same(roll(force[:, :1]), expected(force[:, :1]))
    assert_same(roll(force[:1]), expected(force[:1]))
    mixed = ds.Control(force=force, torque=force[0])
    assert_same(
        sim.rollout(state, mixed, 5), stepped(sim, state, [ds.Control(force=f, torque=force[0]) for f in force])
    )


def test_time_or_batch_is_never_guessed(sim: ds.Simulator) -> None:
    state = sim.initial_state(batch=3)
    force = torch.randn(3, 2, 3, dtype=torch.float64)
    with pytest.raises(
        ValueError, match=r"controls.force of shape \(3, 2, 3\) is ambiguous.*controls.force\[:, None\]"
    ):
        sim.rollout(state, ds.Control(force=force), 3)
    in_time = sim.rollout(state, ds.Control(force=force[:, None]), 3)
    assert_same(in_time, stepped(sim, state, [ds.Control(force=f) for f in force]))
    in_batch = sim.rollout(state, ds.Control(force=force[None]), 3)
    assert_same(in_batch, stepped(sim, state, [ds.Control(force=force)] * 3))
    both = torch.randn(3, 3, 2, 3, dtype=torch.float64)
    for start in (state, sim.initial_state()):  # the batch may come with the controls
        with pytest.raises(ValueError, match=r"controls.force of shape \(3, 3, 2, 3\) is ambiguous.*list\(controls\)"):
            sim.rollout(start, ds.Control(force=both), 3)
        rolled = sim.rollout(start, list(ds.Control(force=both)), 3)
        assert_same(rolled, stepped(sim, state, [ds.Control(force=f) for f in both]))
    sequence = [ds.Control(force=f) for f in both]
    assert ds.diagnostics.gradcheck(sim, state, sequence, steps=3, wrt=["force"], directions=1).passed


def test_wrong_rollouts_are_named(sim: ds.Simulator, state: ds.State) -> None:
    zeros = torch.zeros(4, 2, 3, dtype=torch.float64)
    pushed = ds.Control(body_velocity=zeros[0])
    cases: list[tuple[Any, Any, dict[str, Any], type[Exception], str]] = [
        (None, 0, {}, ValueError, "rollout: steps must be at least 1, got 0"),
        (None, 2.0, {}, TypeError, "rollout: steps must be a whole number, got float"),
        (None, 2, {"checkpoint_every": 0}, ValueError, "rollout: checkpoint_every must be at least 1, got 0"),
        (
            zeros,
            4,
            {},
            TypeError,
            "rollout: controls must be None, a diffsim.Control or a sequence of them, got Tensor",
        ),
        ([pushed] * 3, 4, {}, ValueError, "rollout: controls must have one entry per step, 4, got 3"),
        ([pushed, ds.Control()], 2, {}, ValueError, "controls[1].body_velocity is None, others are not"),
        ([None], 1, {}, TypeError, "controls[0]: control must be a diffsim.Control"),
        (
            ds.Control(force=zeros),
            5,
            {},
            ValueError,
            "controls.force must have shape (2, 3), (5, 2, 3) or (5, B, 2, 3), got (4, 2, 3)",
        ),
        (ds.Control(force=zeros.half()), 4, {}, TypeError, "controls.force must have dtype torch.float32 or torch.fl"),
    ]
    for controls, steps, options, error, text in cases:
        with pytest.raises(error) as caught:
            sim.rollout(state, controls, steps, **options)
        assert text in str(caught.value)
    with pytest.raises(ValueError, match=r"\(2, 3\), \(3, 2, 3\), \(5, 2, 3\) or \(5, 3, 2, 3\), got \(4, 2, 3\)"):
        sim.rollout(sim.initial_state(3), ds.Control(force=zeros), 5)


@pytest.mark.parametrize("every", [1, 3, 4, 100])
@pytest.mark.parametrize("contact", [False, True])
def test_checkpointing_changes_no_forward_bit_and_no_gradient(
    every: int, contact: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    sim = falling_box() if contact else ds.Simulator(make_scene(), dt=0.01)
    state, n = sim.initial_state(), len(sim.body_names)
    force = torch.randn(12, n, 3, dtype=torch.float64)
    recorded: list[int] = []
    forward = _core.rollout

    def spied(*args: Any, **options: Any) -> Any:
        if options["record"]:
            recorded.append(options["steps"])
        return forward(*args, **options)

    monkeypatch.setattr(_core, "rollout", spied)

    def run(checkpoint_every: int | None) -> tuple[ds.State, Tensor, Tensor]:
        velocity, driven = state.velocity.clone().requires_grad_(), force.clone().requires_grad_()
        trajectory = sim.rollout(state.replace(velocity=velocity), ds.Control(force=driven), 12, checkpoint_every)
        loss = trajectory.position.square().sum() + trajectory.orientation[-1].sum()
        return trajectory, *torch.autograd.grad(loss, (velocity, driven))

    plain, checkpointed = run(None), run(every)
    assert recorded == [12] + ([12] if every >= 12 else [every] * (12 // every))
    assert_same(plain[0], checkpointed[0])
    for a, b in zip(plain[1:], checkpointed[1:]):
        assert a.any()
        assert (a - b).abs().max() <= (CONTACT_ROUNDING if contact else ROUNDING) * a.abs().max()


def test_progress_bar(sim: ds.Simulator, state: ds.State, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("tqdm")
    assert_same(sim.rollout(state, None, 7, progress=True), sim.rollout(state, None, 7))
    assert "7/7" in capsys.readouterr().err


def test_progress_without_tqdm(
    sim: ds.Simulator, state: ds.State, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "tqdm.auto", None)
    monkeypatch.setitem(sys.modules, "tqdm", None)
    sim.rollout(state, None, 7, checkpoint_every=3, progress=True)
    assert capsys.readouterr().err == "\rrollout: step 3 of 7\rrollout: step 6 of 7\rrollout: step 7 of 7\n"


def test_threads_change_no_bit_in_contact() -> None:
    runs = []
    for threads in (1, 2, 4):
        sim = falling_box(num_threads=threads)
        velocity = sim.initial_state(batch=3).velocity + torch.arange(3.0).double()[:, None, None]
        velocity.requires_grad_()
        sim.mass.requires_grad_()
        end = sim.rollout(sim.initial_state(batch=3).replace(velocity=velocity), None, 20)
        runs.append((end, *torch.autograd.grad(end.position.square().sum(), (velocity, sim.mass))))
    for end, by_velocity, by_mass in runs[1:]:
        assert_same(end, runs[0][0])
        assert torch.equal(by_velocity, runs[0][1])
        assert torch.equal(by_mass, runs[0][2])
