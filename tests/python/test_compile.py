"""torch.compile without graph breaks: the values and gradients of eager calls, bit by bit."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import pytest
import torch
from test_ops import Calls, calls, two_bodies  # noqa: F401
from torch import Tensor
from torch.func import functional_call, grad, jacrev, jvp, vmap

import diffsim as ds
from diffsim import _compiled

PUSHED = torch.tensor([[1.0], [0.0]], dtype=torch.float64)


def compiled(function: Callable[..., Any], backend: str = "aot_eager") -> Callable[..., Any]:
    """By the tracers alone, unless told otherwise: what inductor adds is not ours, and takes it seconds."""
    return torch.compile(function, fullgraph=True, backend=backend, dynamic=False)


@pytest.fixture(autouse=True)
def fresh() -> Iterator[None]:
    yield
    torch._dynamo.reset()


def box_on_sheet(**options: Any) -> ds.Simulator:
    """A box that lands on a hanging sheet, above the ground."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.2), density=100.0, position=(0.45, 0.5, 0.61), velocity=(0, 0, -1))
    scene.add_cloth(ds.shapes.sheet((1.0, 1.0), (3, 3)), ds.ClothMaterial(), pinned=[0, 2], position=(0.5, 0.5, 0.505))
    return ds.Simulator(scene, dt=0.01, **options)


def loss_of(sim: ds.Simulator, state: ds.State, **options: Any) -> Callable[..., Tensor]:
    """A scalar of a step and a rollout from it, of velocities, a force and parameters."""

    def loss(velocity: Tensor, force: Tensor, **parameters: Tensor) -> Tensor:
        first = sim(state.replace(velocity=velocity), ds.Control(force=force), parameters=parameters or None)
        trajectory = sim.rollout(first, ds.Control(force=force), 4, parameters=parameters or None, **options)
        return sum((t.square().sum() for t in trajectory.__dict__.values()), first.orientation.sum())

    return loss


def assert_same_as_eager(
    run: Callable[..., Tensor], *inputs: Tensor, backend: str = "aot_eager", **more: Tensor
) -> None:
    leaves = [t.detach().clone().requires_grad_() for t in (*inputs, *more.values())]
    given = leaves[: len(inputs)], dict(zip(more, leaves[len(inputs) :]))
    expected = run(*given[0], **given[1])
    gradients = torch.autograd.grad(expected.sum(), leaves)
    found = compiled(run, backend)(*given[0], **given[1])
    assert torch.equal(found, expected)
    for a, b in zip(torch.autograd.grad(found.sum(), leaves), gradients):
        assert b.any()
        assert torch.equal(a, b)


@pytest.mark.parametrize("every", [None, 3])
def test_a_step_and_a_rollout_are_those_of_eager_calls(every: int | None, calls: Calls) -> None:  # noqa: F811
    sim = box_on_sheet()
    state = sim.rollout(sim.initial_state(), steps=3)[-1]
    assert_same_as_eager(
        loss_of(sim, state, checkpoint_every=every),
        state.velocity,
        torch.ones_like(state.velocity),
        mass=sim.mass,
        cloth_stretch=sim.cloth_stretch,
    )
    assert sim.info is not None
    assert sim.info.contacts > 0
    segments = 1 if every is None else 2
    assert calls.forward == 1 + 2 * (1 + segments) + (0 if every is None else 2 * segments)
    assert calls.recorded == calls.backward == 2 * (1 + segments)  # the record of the forward was found
    assert not _compiled._records  # and let go


def test_inductor_gives_the_same_bits() -> None:
    sim = two_bodies()
    state = sim.initial_state()
    assert_same_as_eager(loss_of(sim, state), state.velocity, PUSHED * torch.ones(2, 3).double(), backend="inductor")


def test_batches_float32_and_parameters_per_scene() -> None:
    sim = box_on_sheet()
    state = sim.initial_state(batch=2)
    force = torch.ones(1, 3)  # float32 beside float64, and without the batch axis
    masses = torch.stack([sim.mass.detach(), 2.0 * sim.mass.detach()])
    assert_same_as_eager(loss_of(sim, state), state.velocity, force, mass=masses)


def test_transforms_inside_and_functional_call_keep_working() -> None:
    sim = two_bodies()
    state = sim.initial_state()
    velocities = state.velocity + 0.1 * torch.randn(3, 2, 3, dtype=torch.float64)

    def end(velocity: Tensor) -> Tensor:
        return sim(state.replace(velocity=velocity)).position

    def loss(velocity: Tensor) -> Tensor:
        return sim.rollout(state.replace(velocity=velocity), steps=3).position[-1].square().sum()

    def of_mass(mass: Tensor) -> Tensor:
        return functional_call(sim, {"mass": mass}, (state, ds.Control(force=PUSHED * torch.ones(2, 3)))).velocity

    for function, value in (
        (lambda v: vmap(grad(loss))(v), velocities),
        (lambda v: jacrev(end)(v), state.velocity),
        (lambda m: jacrev(of_mass)(m), sim.mass.detach()),
    ):
        expected = function(value)
        assert expected.any()
        assert torch.equal(compiled(function)(value), expected)
    tangent = torch.ones_like(state.velocity)
    for refused in (
        lambda v: grad(lambda w: grad(loss)(w).square().sum())(v),
        lambda v: jvp(end, (v,), (tangent,)),
        torch.no_grad()(lambda v: jvp(end, (v,), (tangent,))),
    ):
        with pytest.raises(Exception, match=r"first order only|no forward-mode AD"):
            compiled(refused)(state.velocity)


def test_what_is_wrong_is_still_said() -> None:
    sim = box_on_sheet(on_failure="raise", max_iterations=1)
    state = sim.initial_state()
    step = compiled(lambda s, **options: sim(s, **options))
    with pytest.raises(ds.SolverError, match="max_iterations"):
        step(state)
    assert sim.info is not None
    assert not sim.info.converged
    with pytest.raises(ValueError, match="velocity of body 'body_0'"):
        step(state.replace(velocity=state.velocity * float("nan")))
    with pytest.raises(NotImplementedError, match="restitution must be 0"):
        step(state, parameters={"restitution": torch.ones(3, dtype=torch.float64)})
    with pytest.raises(ValueError, match="friction of 'cloth_0'"):
        step(state, parameters={"friction": torch.tensor([0.5, -1.0, 0.5], dtype=torch.float64)})
    with pytest.raises(Exception, match=r"state.velocity must have shape \(1, 3\)"):
        step(state.replace(velocity=state.velocity[:0]))


def test_a_backward_without_its_record_runs_the_forward_again(calls: Calls) -> None:  # noqa: F811
    sim = two_bodies()
    state = sim.initial_state()
    velocity = state.velocity.clone().requires_grad_()
    found = compiled(lambda v: sim(state.replace(velocity=v)).position.square().sum())(velocity)
    assert len(_compiled._records) == 1
    _compiled._records.clear()
    (gradient,) = torch.autograd.grad(found, velocity)
    assert (calls.forward, calls.backward) == (2, 1)
    (expected,) = torch.autograd.grad(sim(state.replace(velocity=velocity)).position.square().sum(), velocity)
    assert torch.equal(gradient, expected)


def test_the_ops_keep_to_what_torch_asks_of_them() -> None:
    sim = two_bodies()
    state = sim.initial_state()
    inputs = [t.clone().requires_grad_() for t in (state.position, state.orientation, state.velocity)]
    inputs += [state.angular_velocity, *(None,) * 8, sim.mass, sim.inertia, sim.gravity, sim.friction, *(None,) * 5]
    settings = (sim._number, 3, False, True, True, False, 0)
    # Without the tests of dispatch: the number of a record is another one each time.
    asked = ("test_schema", "test_autograd_registration", "test_faketensor")
    arguments = (*settings, *inputs, sim.restitution)
    results = torch.library.opcheck(torch.ops.diffsim.rollout.default, arguments, test_utils=asked)
    assert set(results.values()) == {"SUCCESS"}
