import copy
import pickle
import re
import resource
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import functional_call

import diffsim as ds
from diffsim import _core, simulator

STATE_FIELDS = ("position", "orientation", "velocity", "angular_velocity")
STATM = Path("/proc/self/statm")
BOX = (1.0, 0.7, 0.4)
# Sums of a few terms of order one, in another order.
ROUNDING = 1e-12
# The same where contact, stiff as it is, multiplies what rounding leaves.
CONTACT_ROUNDING = 1e-9


def make_scene() -> ds.Scene:
    scene = ds.Scene()
    scene.add_body(
        ds.shapes.box(BOX),
        density=2.0,
        position=(0, 0, 5),
        orientation=(0.8, 0.6, 0, 0),
        velocity=(1, 0, 2),
        angular_velocity=(1.0, -2.0, 0.5),
        name="box",
    )
    scene.add_sphere(0.25, density=3.0, position=(4, 0, 5), velocity=(0, 1, 0), name="ball")
    return scene


@pytest.fixture
def sim() -> ds.Simulator:
    return ds.Simulator(make_scene(), dt=0.01)


@pytest.fixture
def state(sim: ds.Simulator) -> ds.State:
    return sim.initial_state()


def falling_box(**options: Any) -> ds.Simulator:
    """A tilted box about to hit the ground."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(
        ds.shapes.box(BOX), density=2.0, position=(0, 0, 0.6), orientation=(1, 0.3, 0.1, 0), velocity=(0, 0, -5)
    )
    return ds.Simulator(scene, dt=0.01, **options)


def assert_same(a: ds.State, b: ds.State) -> None:
    for name in STATE_FIELDS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


# ---- construction ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "error", "text"),
    [
        ({"dt": 0.0}, ValueError, "Simulator: dt must be finite and larger than 0, got 0.0"),
        ({"dt": float("nan")}, ValueError, "dt must be finite"),
        ({"dt": "0.01"}, TypeError, "Simulator: dt must be a number, got str"),
        ({"thickness": -1e-3}, ValueError, "thickness must be finite and larger than 0, got -0.001"),
        ({"compliance": -1.0}, ValueError, "compliance must be finite and at least 0, got -1.0"),
        ({"adjoint": "fast"}, ValueError, "adjoint must be one of 'exact', 'qr', 'dense', got 'fast'"),
        ({"coupling": "none"}, ValueError, "coupling must be one of 'monolithic', 'split', got 'none'"),
        ({"tolerance": 0.0}, ValueError, "tolerance must be finite and larger than 0"),
        ({"max_iterations": 0}, ValueError, "max_iterations must be at least 1, got 0"),
        ({"max_iterations": 2.5}, TypeError, "max_iterations must be a whole number, got float"),
        ({"num_threads": 0}, ValueError, "num_threads must be at least 1, got 0"),
        ({"on_failure": "ignore"}, ValueError, "on_failure must be one of 'warn', 'raise', got 'ignore'"),
    ],
)
def test_wrong_options_are_named(options: dict[str, Any], error: type[Exception], text: str) -> None:
    with pytest.raises(error, match=text.replace("(", r"\(")):
        ds.Simulator(make_scene(), **{"dt": 0.01, **options})


def test_scene_must_be_a_scene() -> None:
    with pytest.raises(TypeError, match=r"Simulator: scene must be a diffsim.Scene, got str"):
        ds.Simulator("scene", dt=0.01)  # type: ignore[arg-type]


def test_overlap_is_refused_unless_unchecked() -> None:
    scene = make_scene()
    scene.add_sphere(0.25, density=3.0, position=(4, 0, 5.4), name="intruder")
    with pytest.raises(ValueError, match="'ball' and body 'intruder' interpenetrate"):
        ds.Simulator(scene, dt=0.01)
    ds.Simulator(scene, dt=0.01, check=False)


def test_parameters_are_those_of_the_contract(sim: ds.Simulator) -> None:
    shapes = {name: tuple(p.shape) for name, p in sim.named_parameters()}
    assert shapes == {
        "mass": (2,),
        "inertia": (2, 3, 3),
        "gravity": (3,),
        "friction": (2,),
        "restitution": (2,),
        **{f"cloth_{name}": (0,) for name in ("density", "stretch", "shear", "bend", "damping")},
    }
    assert not any(p.requires_grad for p in sim.parameters())
    assert {p.dtype for p in sim.parameters()} == {torch.float64}
    assert sim.mass[0].item() == pytest.approx(2.0 * np.prod(BOX))


def test_empty_scene() -> None:
    sim = ds.Simulator(ds.Scene(), dt=0.01)
    state = sim.rollout(sim.initial_state(), None, 3)
    assert state.position.shape == (3, 0, 3)
    assert sim.vertices(state).shape == (3, 0, 3)


# ---- states ----------------------------------------------------------------------------------------------------------


def test_initial_state(sim: ds.Simulator, state: ds.State) -> None:
    assert torch.allclose(state.position, torch.tensor([[0.0, 0, 5], [4, 0, 5]]).double(), atol=1e-15)
    assert torch.allclose(state.orientation, torch.tensor([[0.8, 0.6, 0, 0], [1.0, 0, 0, 0]]).double(), atol=1e-15)
    assert torch.equal(state.velocity[0], torch.tensor([1.0, 0, 2]).double())
    batch = sim.initial_state(batch=3)
    assert batch.leading_shape == (3,)
    assert batch.node_position.shape == (3, 0, 3)
    for i in range(3):
        assert_same(batch[i], state)
    batch.position[0] += 1.0
    assert torch.equal(batch.position[1], state.position)
    state.position.zero_()
    assert sim.initial_state().position.any()
    with pytest.raises(ValueError, match="initial_state: batch must be at least 1"):
        sim.initial_state(batch=0)


def test_initial_state_follows_the_dtype_of_the_module() -> None:
    sim = ds.Simulator(make_scene(), dt=0.01).float()
    assert sim.initial_state().dtype == torch.float32
    assert sim(sim.initial_state()).dtype == torch.float32


# ---- dtype, device, shape, value -------------------------------------------------------------------------------------


def test_float32_in_float32_out_float64_inside(sim: ds.Simulator, state: ds.State) -> None:
    force = torch.randn(2, 3)
    single = state.to(torch.float32)
    result = sim.rollout(single, ds.Control(force=force), 10)
    expected = sim.rollout(single.to(torch.float64), ds.Control(force=force.double()), 10)
    assert result.dtype == torch.float32
    assert_same(result, expected.to(torch.float32))
    assert_same(sim(single), sim(single.to(torch.float64)).to(torch.float32))


def test_float32_gradients(sim: ds.Simulator, state: ds.State) -> None:
    force = torch.randn(2, 3, requires_grad=True)
    sim.mass.requires_grad_()
    sim(state.to(torch.float32), ds.Control(force=force)).velocity.square().sum().backward()
    assert force.grad is not None
    assert force.grad.dtype == torch.float32
    assert force.grad.any()
    assert sim.mass.grad is not None
    assert sim.mass.grad.dtype == torch.float64
    assert sim.mass.grad.any()


def test_wrong_tensors_are_named(sim: ds.Simulator, state: ds.State) -> None:
    zeros = torch.zeros(2, 3, dtype=torch.float64)
    cases: list[tuple[Any, Any, type[Exception], str]] = [
        (zeros, None, TypeError, "Simulator: state must be a diffsim.State, got Tensor"),
        (state, zeros, TypeError, "Simulator: control must be a diffsim.Control or None, got Tensor"),
        (state.replace(velocity=[0.0]), None, TypeError, "state.velocity must be a torch.Tensor, got list"),  # type: ignore[arg-type]
        (
            state.replace(velocity=zeros[:1]),
            None,
            ValueError,
            "state.velocity must have shape (2, 3) or (B, 2, 3), got (1, 3)",
        ),
        (state.replace(orientation=zeros), None, ValueError, "state.orientation must have shape (2, 4) or (B, 2, 4)"),
        (
            state.replace(velocity=zeros.float()),
            None,
            TypeError,
            "state.velocity must have the dtype of the state, torch.float64",
        ),
        (state.to(torch.float16), None, TypeError, "state.position must have dtype torch.float32 or torch.float64"),
        (
            state.replace(node_velocity=torch.zeros(4, 3).double()),
            None,
            ValueError,
            "state.node_velocity must have shape (0, 3)",
        ),
        (
            state.replace(position=zeros.to("meta")),
            None,
            ValueError,
            "must be on the cpu, the only device diffsim runs on, got meta",
        ),
        (state, ds.Control(force=zeros.to("meta")), ValueError, "control.force must be on the cpu"),
        (state, ds.Control(force=zeros.float()), TypeError, "control.force must have the dtype of the state"),
        (
            state,
            ds.Control(torque=zeros[0]),
            ValueError,
            "control.torque must have shape (2, 3) or (B, 2, 3), got (3,)",
        ),
        (
            state,
            ds.Control(node_force=torch.zeros(4, 3).double()),
            ValueError,
            "control.node_force must have shape (0, 3)",
        ),
        (
            sim.initial_state(3),
            ds.Control(force=zeros.expand(4, 2, 3)),
            ValueError,
            "must have shape (2, 3) or (3, 2, 3), got (4, 2, 3)",
        ),
        (
            sim.initial_state(3).replace(velocity=zeros.expand(4, 2, 3)),
            None,
            ValueError,
            "state.velocity must have shape (2, 3) or (3, 2, 3)",
        ),
    ]
    for check in (True, False):
        checked = ds.Simulator(make_scene(), dt=0.01, check=check)
        for wrong, control, error, text in cases:
            with pytest.raises(error) as caught:
                checked(wrong, control)
            assert text in str(caught.value)


def test_wrong_parameters_are_named(sim: ds.Simulator, state: ds.State) -> None:
    with pytest.raises(ValueError, match=r"mass must have shape \(2,\) or \(B, 2\), got \(3,\)"):
        functional_call(sim, {"mass": torch.ones(3).double()}, (state,))
    with pytest.raises(TypeError, match="gravity must have dtype"):
        functional_call(sim, {"gravity": torch.ones(3, dtype=torch.int64)}, (state,))
    sim.friction[0] = 0.5
    with pytest.raises(NotImplementedError, match="friction must be 0"):
        sim(state)


@pytest.mark.parametrize("field", STATE_FIELDS)
def test_nan_in_the_state_is_named(sim: ds.Simulator, state: ds.State, field: str) -> None:
    getattr(state, field)[1, 2] = float("nan")
    for start in (state, state.to(torch.float32)):
        with pytest.raises(ValueError, match=rf"{field}.*'ball'|'ball'.*{field}"):
            sim(start)
        with pytest.raises(ValueError, match="nan"):
            sim.rollout(start, None, 3)


@pytest.mark.parametrize("field", ["force", "torque", "body_velocity", "body_angular_velocity"])
def test_nan_in_the_control_is_named(sim: ds.Simulator, state: ds.State, field: str) -> None:
    value = torch.zeros(2, 3, dtype=torch.float64)
    value[0, 1] = float("inf")
    with pytest.raises(ValueError, match=rf"{field}.*'box'|'box'.*{field}"):
        sim(state, ds.Control(**{field: value}))


def test_strided_and_expanded_tensors_are_fine(sim: ds.Simulator, state: ds.State) -> None:
    expected = sim(state)
    padded = torch.zeros(2, 6, dtype=torch.float64)
    padded[:, ::2] = state.velocity
    assert_same(sim(state.replace(velocity=padded[:, ::2])), expected)
    batched = sim(state.replace(position=state.position.expand(3, 2, 3)))
    assert batched.leading_shape == (3,)
    assert batched.node_position.shape == (3, 0, 3)
    for i in range(3):
        assert_same(batched[i], expected)


def test_any_input_brings_the_batch_axis(sim: ds.Simulator, state: ds.State) -> None:
    forces = torch.randn(3, 2, 3, dtype=torch.float64)
    masses = sim.mass * torch.rand(3, 2, dtype=torch.float64)
    by_force = sim(state, ds.Control(force=forces))
    by_mass = functional_call(sim, {"mass": masses}, (state, ds.Control(force=forces[0])))
    for i in range(3):
        assert_same(by_force[i], sim(state, ds.Control(force=forces[i])))
        assert_same(by_mass[i], functional_call(sim, {"mass": masses[i]}, (state, ds.Control(force=forces[0]))))


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
        (ds.Control(force=zeros.float()), 4, {}, TypeError, "controls.force must have the dtype of the state"),
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


@pytest.mark.skipif(not STATM.exists(), reason="memory is read from /proc")
def test_memory_stays_flat_over_rollouts_with_contact() -> None:
    sim = falling_box()
    velocity = sim.initial_state().velocity.requires_grad_()
    state = sim.initial_state().replace(velocity=velocity)

    def resident_bytes() -> int:
        return int(STATM.read_text().split()[1]) * resource.getpagesize()

    def roll(count: int) -> None:
        for _ in range(count):
            sim.rollout(state, None, 5).position.sum().backward()

    roll(200)
    before = resident_bytes()
    roll(2000)
    assert resident_bytes() - before < 2000 * 500  # a leaked tape or state is more than 500 bytes


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


# ---- a module like any other -----------------------------------------------------------------------------------------


def test_functional_call_gives_gradients(sim: ds.Simulator, state: ds.State) -> None:
    force = torch.ones(2, 3, dtype=torch.float64)
    mass = (2 * sim.mass).requires_grad_()
    velocity = functional_call(sim, {"mass": mass}, (state, ds.Control(force=force))).velocity
    expected = state.velocity + sim.dt * (sim.gravity + force / mass.detach()[:, None])
    assert torch.allclose(velocity, expected, rtol=ROUNDING, atol=ROUNDING)
    (gradient,) = torch.autograd.grad(velocity[..., 0].sum(), mass)
    assert torch.allclose(gradient, -sim.dt / mass.detach() ** 2, rtol=ROUNDING)


def test_parametrized_mass_is_used(sim: ds.Simulator, state: ds.State) -> None:
    class Doubled(torch.nn.Module):
        def forward(self, value: Tensor) -> Tensor:
            return 2 * value

    expected = functional_call(sim, {"mass": 2 * sim.mass}, (state, ds.Control(force=torch.ones(2, 3).double())))
    torch.nn.utils.parametrize.register_parametrization(sim, "mass", Doubled())
    assert_same(sim(state, ds.Control(force=torch.ones(2, 3).double())), expected)


def test_optimizer_moves_a_parameter(sim: ds.Simulator, state: ds.State) -> None:
    sim.gravity.requires_grad_()
    optimizer = torch.optim.SGD([sim.gravity], lr=0.1)
    before = sim.gravity.detach().clone()
    sim.rollout(state, None, 10).position[-1].sum().backward()
    optimizer.step()
    assert bool((sim.gravity < before).all())


def test_state_dict_carries_the_parameters(sim: ds.Simulator, state: ds.State) -> None:
    other = ds.Simulator(make_scene(), dt=0.01)
    with torch.no_grad():
        sim.gravity.copy_(torch.tensor([1.0, 2.0, 3.0]))
    other.load_state_dict(sim.state_dict())
    assert_same(other(state), sim(state))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda sim: pickle.loads(pickle.dumps(sim))])
@pytest.mark.parametrize("contact", [False, True])
def test_copies_run_bitwise_the_same(copied: Any, contact: bool) -> None:
    sim = falling_box() if contact else ds.Simulator(make_scene(), dt=0.01)
    with torch.no_grad():
        sim.mass.mul_(2.0)
    sim.mass.requires_grad_()
    middle = sim.rollout(sim.initial_state(), None, 10)[-1]
    twin = copied(sim)
    assert twin.info == sim.info
    assert twin.mass.requires_grad
    assert repr(twin) == repr(sim)
    assert_same(twin.initial_state(), sim.initial_state())
    resumed = pickle.loads(pickle.dumps(middle.detach()))
    assert_same(twin.rollout(resumed, None, 20), sim.rollout(middle, None, 20))


# ---- statistics and failure ------------------------------------------------------------------------------------------


def test_info_of_the_last_call(sim: ds.Simulator, state: ds.State) -> None:
    assert sim.info is None
    sim(state)
    info = sim.info
    assert isinstance(info, ds.Info)
    assert info.converged
    assert info.failure == ""
    assert (info.failed_steps, info.contacts, info.zones, info.largest_zone) == (0, 0, 0, 0)
    assert all(isinstance(value, float) for value in info.milliseconds.values())


def test_info_in_contact() -> None:
    sim = falling_box()
    sim.rollout(sim.initial_state(), None, 100)
    assert sim.info is not None
    assert sim.info.converged
    assert (sim.info.zones, sim.info.largest_zone) == (1, 1)
    assert sim.info.contacts >= 1
    assert 0.0 < sim.info.max_compression < sim.thickness


def test_failure_in_contact_warns_once_and_returns_a_good_state() -> None:
    sim = falling_box(max_iterations=1)
    expected = r"did not converge, the first because: max_iterations reached\..*penetration-free.*larger max_iterations"
    with pytest.warns(ds.ConvergenceWarning, match=expected) as caught:
        trajectory = sim.rollout(sim.initial_state(), None, 40, checkpoint_every=10)
    assert caught[0].filename == __file__
    assert sim.info is not None
    assert not sim.info.converged
    assert sim.info.failed_steps >= 1
    assert sim.info.failure == "max_iterations reached"
    assert torch.isfinite(trajectory.position).all()
    distance = sim.min_distance(trajectory)
    assert isinstance(distance, Tensor)
    assert distance.shape == (40,)
    assert bool((distance > -sim.thickness).all())  # distance of the meshes: margins add up to the thickness
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sim.rollout(sim.initial_state(), None, 40)


def test_warning_of_a_step_in_contact_points_at_the_caller() -> None:
    sim = falling_box(max_iterations=1)

    def forty_steps() -> None:
        state = sim.initial_state()
        for _ in range(40):
            state = sim(state)

    with pytest.warns(ds.ConvergenceWarning) as caught:
        forty_steps()
    assert [warning.filename for warning in caught] == [__file__]


def test_failure_in_contact_raises_if_asked_to() -> None:
    sim = falling_box(max_iterations=1, on_failure="raise")
    with pytest.raises(ds.SolverError, match=r"did not converge, the first because: max_iterations reached") as caught:
        sim.rollout(sim.initial_state(), None, 40)
    error = pickle.loads(pickle.dumps(caught.value))
    assert error.iterations == caught.value.iterations >= 0
    assert error.residual == caught.value.residual
    assert error.state.leading_shape == (40,)
    assert error.info == sim.info


def test_a_mend_is_known_for_every_failure_of_the_core() -> None:
    source = Path(__file__).parents[2] / "csrc" / "bindings" / "bind_rollout.cpp"
    function = re.search(r"failure_text\(.*?^}", source.read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)
    assert function is not None
    assert set(re.findall(r'return "(.+)";', function[0])) == set(simulator._MENDS)


# ---- measurements ----------------------------------------------------------------------------------------------------


def inertia_world(sim: ds.Simulator, state: ds.State, body: int) -> np.ndarray[Any, Any]:
    R = ds.rotation.to_matrix(state.orientation[body]).numpy()
    product: np.ndarray[Any, Any] = R @ sim.inertia[body].numpy() @ R.T
    return product


def test_energies_and_momenta_are_their_formulas(sim: ds.Simulator, state: ds.State) -> None:
    kinetic, potential, momentum, angular = 0.0, 0.0, np.zeros(3), np.zeros(3)
    for body in range(2):
        m, x, v, w = (t[body].numpy() for t in (sim.mass, state.position, state.velocity, state.angular_velocity))
        spin = inertia_world(sim, state, body) @ w
        kinetic += 0.5 * m * v @ v + 0.5 * w @ spin
        potential -= m * sim.gravity.numpy() @ x
        momentum += m * v
        angular += np.cross(x, m * v) + spin
    batch = sim.initial_state(batch=2)
    for function, expected in (
        (sim.kinetic_energy, kinetic),
        (sim.potential_energy, potential),
        (sim.momentum, momentum),
        (sim.angular_momentum, angular),
    ):
        value = function(state)
        assert value.shape == np.shape(expected)
        np.testing.assert_allclose(value.numpy(), expected, rtol=1e-13)
        np.testing.assert_array_equal(function(batch)[1].numpy(), value.numpy())
        assert function(state.to(torch.float32)).dtype == torch.float32


def test_energies_are_differentiable(sim: ds.Simulator, state: ds.State) -> None:
    velocity = state.velocity.clone().requires_grad_()
    sim.mass.requires_grad_()
    (by_velocity, by_mass) = torch.autograd.grad(
        sim.kinetic_energy(state.replace(velocity=velocity)), (velocity, sim.mass)
    )
    assert torch.allclose(by_velocity, sim.mass.detach()[:, None] * state.velocity)
    assert torch.allclose(by_mass, 0.5 * state.velocity.square().sum(-1))


def test_static_and_kinematic_bodies_do_not_count() -> None:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box(1.0), kind="static", position=(0, 0, 5))
    scene.add_body(ds.shapes.box(1.0), kind="kinematic", position=(3, 0, 5), velocity=(1, 0, 0))
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    assert state.velocity.any()
    assert sim.kinetic_energy(state) == sim.potential_energy(state) == 0.0
    assert not sim.momentum(state).any()


def test_momentum_in_free_flight(sim: ds.Simulator, state: ds.State) -> None:
    with torch.no_grad():
        sim.gravity.zero_()
    trajectory = sim.rollout(state, None, 50)
    momentum = sim.momentum(trajectory)
    assert momentum.shape == (50, 3)
    assert torch.allclose(momentum, sim.momentum(state).expand(50, 3), rtol=ROUNDING, atol=ROUNDING)


def offset_tetrahedron() -> tuple[ds.Simulator, np.ndarray[Any, Any]]:
    vertices, faces = ds.shapes.tetrahedron(1.0)
    vertices = np.asarray(vertices) + np.array([3.0, 0.0, 0.0])
    scene = ds.Scene()
    scene.add_body((vertices, faces), density=1.0, position=(0, 2, 5), orientation=(0.8, 0, 0.6, 0))
    scene.add_sphere(0.5, density=1.0, position=(0, -5, 5))
    scene.add_capsule(0.25, 1.0, density=1.0, position=(0, -9, 5), orientation=(0.8, 0, 0.6, 0))
    return ds.Simulator(scene, dt=0.01), vertices


def test_mesh_transform_places_the_mesh_as_it_was_given() -> None:
    sim, vertices = offset_tetrahedron()
    state = sim.initial_state()
    transform = sim.mesh_transform(state)
    assert transform.shape == (3, 4, 4)
    R = ds.rotation.to_matrix(np.array([0.8, 0, 0.6, 0]))
    np.testing.assert_allclose(transform[0, :3, :3].numpy(), R, atol=1e-15)
    np.testing.assert_allclose(transform[0, :3, 3].numpy(), [0, 2, 5], atol=1e-14)
    np.testing.assert_array_equal(transform[:, 3].numpy(), np.tile([0, 0, 0, 1], (3, 1)))
    world = sim.vertices(state)
    assert world.shape == (4 + 1 + 2, 3)
    np.testing.assert_allclose(world[:4].numpy(), vertices @ R.T + [0, 2, 5], atol=1e-14)
    np.testing.assert_allclose(world[4].numpy(), [0, -5, 5], atol=1e-15)
    trajectory = sim.rollout(sim.initial_state(batch=2), None, 3)
    assert sim.vertices(trajectory).shape == (3, 2, 7, 3)
    assert sim.mesh_transform(trajectory).shape == (3, 2, 3, 4, 4)
    assert torch.equal(sim.vertices(trajectory)[2, 1], sim.vertices(trajectory[2, 1]))


def test_vertices_are_differentiable() -> None:
    sim, _ = offset_tetrahedron()
    state = sim.initial_state()

    def world(position: Tensor, orientation: Tensor) -> Tensor:
        return sim.vertices(state.replace(position=position, orientation=orientation))

    inputs = (state.position.requires_grad_(), state.orientation.requires_grad_())
    assert torch.autograd.gradcheck(world, inputs)


def test_mesh_is_the_surface_in_the_world() -> None:
    sim, _ = offset_tetrahedron()
    state = sim.initial_state()
    body = sim.mesh(state, 0)
    np.testing.assert_allclose(body.vertices, sim.vertices(state)[:4].numpy(), atol=1e-14)
    assert body.is_watertight
    sphere = sim.mesh(state, 1)
    np.testing.assert_allclose(np.linalg.norm(sphere.vertices - [0, -5, 5], axis=1), 0.5, rtol=1e-6)
    capsule = sim.mesh(state, -1)
    ends = sim.vertices(state)[5:].numpy()
    axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    along = np.clip((capsule.vertices - ends[0]) @ axis, 0.0, 1.0)
    np.testing.assert_allclose(
        np.linalg.norm(capsule.vertices - ends[0] - along[:, None] * axis, axis=1), 0.25, rtol=1e-6
    )
    with pytest.raises(ValueError, match="mesh: state must be one state"):
        sim.mesh(sim.initial_state(batch=2), 0)
    with pytest.raises(IndexError):
        sim.mesh(state, 3)


def test_min_distance_above_the_ground_and_in_contact() -> None:
    scene = ds.Scene()
    scene.add_ground(margin=0.01)
    scene.add_sphere(0.5, density=1.0, position=(0, 0, 2))
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    distance = sim.min_distance(state)
    assert isinstance(distance, float)
    assert distance == pytest.approx(1.49, abs=1e-12)
    lifted = state.replace(
        position=state.position + torch.arange(3.0).double()[:, None, None] * torch.eye(3).double()[2]
    )
    distances = sim.min_distance(lifted)
    assert isinstance(distances, Tensor)
    np.testing.assert_allclose(distances.numpy(), [1.49, 2.49, 3.49], atol=1e-12)


def test_nothing_can_meet() -> None:
    scene = ds.Scene()
    scene.add_sphere(0.5, density=1.0)
    sim = ds.Simulator(scene, dt=0.01)
    assert sim.min_distance(sim.initial_state()) == float("inf")


def test_separate_moves_touching_bodies_apart_in_contact() -> None:
    scene = ds.Scene()
    scene.add_ground(margin=1e-3)
    ball = scene.add_sphere(0.5, density=1.0, position=(0, 0, 0.501), name="ball")
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    shift = state.position[ball, 2] - 0.501
    assert 0.0 <= shift <= sim.thickness
    low = state.position - torch.tensor([0.0, 0.0, 1e-4]).double()
    low.requires_grad_()
    apart = sim.separate(state.replace(position=low.expand(2, 1, 3)))
    assert apart.leading_shape == (2,)
    assert bool((apart.position[..., 2] > low[..., 2]).all())
    (gradient,) = torch.autograd.grad(apart.position.sum(), low)
    assert torch.equal(gradient, torch.full_like(low, 2.0))
    assert_same(sim.separate(apart), apart)
    sim.rollout(apart, None, 3)


def test_measurements_name_wrong_states(sim: ds.Simulator) -> None:
    wrong = ds.State(torch.zeros(3, 3))
    for name in ("kinetic_energy", "potential_energy", "momentum", "angular_momentum", "min_distance", "vertices"):
        with pytest.raises(ValueError, match=rf"{name}: state.position must have shape \(2, 3\)"):
            getattr(sim, name)(wrong)


# ---- description -----------------------------------------------------------------------------------------------------


def test_repr_names_what_runs_and_what_does_not() -> None:
    text = repr(falling_box())
    runs, left_out = (line.strip() for line in text.splitlines()[1:])
    assert text.startswith("Simulator(1 body, thickness=0.0004, dt=0.01, ")
    assert runs == "runs: free motion, ground contact"
    assert left_out.startswith("leaves out: kinematic motion (no kinematic body), body-body contact (one body), ")
    assert "cloth" in left_out
    assert "body-body contact" in repr(ds.Simulator(make_scene(), dt=0.01)).splitlines()[1]
