import copy
import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_scenes import BOX, ROUNDING, STATE_FIELDS, assert_same, falling_box, make_scene
from torch import Tensor
from torch.func import functional_call

import diffsim as ds
from diffsim import _outcome

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
        ({"zones": "none"}, ValueError, "zones must be one of 'local', 'global', got 'none'"),
        ({"newton_iterations": 0}, ValueError, "newton_iterations must be at least 1, got 0"),
        ({"newton_iterations": 1.5}, TypeError, "newton_iterations must be a whole number, got float"),
        (
            {"newton_iterations": 1},
            ValueError,
            "Simulator: newton_iterations must be None with coupling='monolithic', got 1",
        ),
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


def test_float32_controls_beside_a_float64_state_are_cast(sim: ds.Simulator, state: ds.State) -> None:
    force = torch.randn(2, 3, requires_grad=True)
    cast = force.detach().double().requires_grad_()
    for run in (
        lambda f: sim(state, ds.Control(force=f, torque=f.detach().double())),
        lambda f: sim.rollout(state, ds.Control(force=f), 3)[-1],
        lambda f: sim.rollout(state, [ds.Control(force=f), ds.Control(), ds.Control(force=f.double())])[-1],
        lambda f: sim.rollout(state, ds.Control(force=f.expand(3, 4, 2, 3)), 3)[-1, 0],
    ):
        end, expected = run(force), run(cast)
        assert end.dtype == torch.float64
        assert_same(end, expected)
        (found,) = torch.autograd.grad(end.velocity.square().sum(), force)
        (gradient,) = torch.autograd.grad(expected.velocity.square().sum(), cast)
        assert found.dtype == torch.float32
        assert found.any()
        torch.testing.assert_close(found, gradient.float(), rtol=1e-5, atol=1e-6)  # sums over steps are float32
    single = sim(state.to(torch.float32), ds.Control(force=cast.detach()))
    assert single.dtype == torch.float32


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
        (
            state,
            ds.Control(force=zeros.half()),
            TypeError,
            "control.force must have dtype torch.float32 or torch.float",
        ),
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
    sim.friction[0] = -0.5
    with pytest.raises(ValueError, match=r"friction of 'box' \(index 0\) must be zero or positive and finite"):
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
    assert set(re.findall(r'return "(.+)";', function[0])) == set(_outcome.MENDS)


# ---- description -----------------------------------------------------------------------------------------------------


def test_repr_names_what_runs_and_what_does_not() -> None:
    text = repr(falling_box())
    runs, left_out = (line.strip() for line in text.splitlines()[1:])
    assert text.startswith("Simulator(1 body, thickness=0.0004, dt=0.01, ")
    assert runs == "runs: free motion, ground contact"
    assert left_out.startswith("leaves out: kinematic motion (no kinematic body), body-body contact (one body), ")
    assert "cloth" in left_out
    assert "body-body contact" in repr(ds.Simulator(make_scene(), dt=0.01)).splitlines()[1]


# ---- nothing is ignored silently -------------------------------------------------------------------------------------


@pytest.mark.parametrize("transform", ["none", "vmap", "grad", "vmap of grad", "jacrev"])
def test_restitution_is_looked_at_under_transforms(transform: str) -> None:
    sim = ds.Simulator(make_scene(), dt=0.01)
    state = sim.initial_state()

    def height(value: Tensor) -> Tensor:
        return torch.func.functional_call(sim, {"restitution": value}, (state,)).position[:, 2].sum()

    function, batched = {
        "none": (height, False),
        "vmap": (torch.func.vmap(height), True),
        "grad": (torch.func.grad(height), False),
        "vmap of grad": (torch.func.vmap(torch.func.grad(height)), True),
        "jacrev": (torch.func.jacrev(height), False),
    }[transform]
    size = len(sim.restitution)

    def values(value: float, count: int) -> Tensor:
        return torch.full((2, count) if batched else (count,), value, dtype=torch.float64)

    assert bool(function(values(0.0, size)).isfinite().all())
    with pytest.raises(NotImplementedError, match="restitution must be 0"):
        function(values(0.5, size))
    with pytest.raises(ValueError, match=rf"restitution must have shape \({size},\)"):
        function(values(0.0, size + 4))


@pytest.mark.parametrize("on_ground", [False, True])
@pytest.mark.parametrize("spin", [1e9, 1e200])
def test_a_spin_that_cannot_be_solved_for_is_told(spin: float, on_ground: bool) -> None:
    scene = ds.Scene()
    if on_ground:
        scene.add_ground()
    spins = (0.3 * spin, spin, 0.2 * spin)
    scene.add_body(ds.shapes.box((1.0, 0.6, 0.3)), density=500.0, position=(0, 0, 0.151), angular_velocity=spins)
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    leaves = [getattr(state, n).requires_grad_() for n in ("position", "orientation", "velocity", "angular_velocity")]
    with pytest.warns(ds.ConvergenceWarning, match="a body spins too fast.*angular velocities"):
        after = sim(state)
    assert sim.info is not None
    assert not sim.info.converged
    for tensor in (after.position, after.orientation, after.velocity, after.angular_velocity):
        assert bool(tensor.isfinite().all())
    total = after.position.sum() + after.orientation.sum() + after.angular_velocity.sum()
    gradients = torch.autograd.grad(total, leaves)
    assert all(bool(g.isfinite().all()) for g in gradients)
    if not on_ground:
        assert gradients[3].tolist() == [[1.0, 1.0, 1.0]]  # it goes on as it spins
