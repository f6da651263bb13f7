"""Parameters exchanged for one call of a step or a rollout."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from small_scenes import assert_same, falling_box
from torch import Tensor
from torch.func import functional_call, grad, vmap

import diffsim as ds

CASES = ("mass", "inertia", "gravity", "cloth_density", "cloth_stretch", "cloth_shear", "cloth_bend", "cloth_damping")
STEPS = 6


@pytest.fixture(scope="module")
def sim() -> ds.Simulator:
    """A box on a sheet that hangs by two of its corners."""
    scene = ds.Scene()
    scene.add_body(ds.shapes.box(0.2), density=100.0, position=(0.45, 0.5, 0.61), angular_velocity=(1.0, 0.3, -0.2))
    scene.add_cloth(ds.shapes.sheet((1.0, 1.0), (4, 4)), ds.ClothMaterial(), pinned=[0, 4], position=(0.5, 0.5, 0.505))
    return ds.Simulator(scene, dt=0.01)


@pytest.fixture(scope="module")
def moving(sim: ds.Simulator) -> ds.State:
    return sim.rollout(sim.initial_state(), steps=5)[-1]


def loss_of(sim: ds.Simulator, state: ds.State, name: str, **options: Any) -> Callable[[Tensor], Tensor]:
    weight = torch.linspace(0.5, 1.5, 3, dtype=torch.float64)

    def loss(value: Tensor) -> Tensor:
        end = sim.rollout(state, steps=STEPS, parameters={name: value}, **options)[-1]
        return (end.position @ weight).sum(-1) + (end.node_position @ weight).square().sum(-1)

    return loss


@pytest.mark.parametrize("name", CASES)
def test_gradients_of_exchanged_parameters_are_central_differences(
    sim: ds.Simulator, moving: ds.State, name: str
) -> None:
    loss, value = loss_of(sim, moving, name), getattr(sim, name).detach()
    gradient = grad(loss)(value)
    direction = value if value.ndim < 3 else value * torch.eye(3, dtype=torch.float64)
    found = (gradient * direction).sum()
    assert found.abs() > 1e-12
    eps = 1e-4  # the weak influence of bending needs so much
    difference = (loss(value + eps * direction) - loss(value - eps * direction)) / (2 * eps)
    torch.testing.assert_close(found, difference, rtol=1e-5, atol=1e-12)


@pytest.mark.parametrize("name", CASES)
def test_a_batch_of_parameters_is_one_value_per_scene(sim: ds.Simulator, moving: ds.State, name: str) -> None:
    own = getattr(sim, name).detach()
    values = torch.stack([0.8 * own, own, 1.3 * own]).requires_grad_()
    loss = loss_of(sim, moving, name)
    together = loss(values)
    assert together.shape == (3,)
    (gradients,) = torch.autograd.grad(together.sum(), values)
    for i in range(3):
        one = values[i].detach().requires_grad_()
        alone = loss(one)
        assert torch.equal(together[i], alone)
        (expected,) = torch.autograd.grad(alone, one)
        assert expected.any()
        assert torch.equal(gradients[i], expected)
    assert torch.equal(vmap(loss)(values.detach()), together)


def test_a_step_takes_them_as_functional_call_does_and_keeps_its_own() -> None:
    sim = falling_box()
    state = sim.rollout(sim.initial_state(), steps=10)[-1]
    heavier = {"mass": 2.0 * sim.mass, "gravity": torch.tensor([0.5, 0.0, -3.0])}  # float32 is taken, too
    for values in (heavier, {**dict(sim.named_parameters()), **heavier}):
        assert_same(sim(state, parameters=values), functional_call(sim, heavier, (state,)))
        assert_same(sim.rollout(state, steps=1, parameters=values)[0], functional_call(sim, heavier, (state,)))
    assert not torch.equal(sim(state, parameters=heavier).velocity, sim(state).velocity)
    masses = torch.stack([sim.mass, 3.0 * sim.mass])
    assert sim(state, parameters={"mass": masses}).position.shape == (2, 1, 3)
    checkpointed = sim.rollout(state, steps=7, checkpoint_every=2, parameters={"mass": masses})
    assert_same(checkpointed, sim.rollout(state, steps=7, parameters={"mass": masses}))


@pytest.mark.parametrize("check", [True, False])
def test_wrong_parameters_of_a_call_are_named(check: bool) -> None:
    sim = falling_box(check=check)
    state = sim.initial_state(batch=3)
    one = torch.ones(1, dtype=torch.float64)
    cases: list[tuple[Any, type[Exception], str]] = [
        ([one], TypeError, "parameters must be a mapping of names to tensors or None, got list"),
        ({"masss": one}, ValueError, "parameters must have names among mass, inertia, gravity, friction, restitution"),
        ({"mass": 2.0}, TypeError, "parameters['mass'] must be a torch.Tensor, got float"),
        ({"mass": one.long()}, TypeError, "parameters['mass'] must have dtype torch.float32 or torch.float64"),
        ({"mass": one.expand(2)}, ValueError, "parameters['mass'] must have shape (1,) or (B, 1), got (2,)"),
        ({"mass": one.expand(2, 1)}, ValueError, "mass must have shape (1,) or (3, 1), got (2, 1)"),
        ({"friction": one}, ValueError, "parameters['friction'] must have shape (2,) or (B, 2), got (1,)"),
        ({"cloth_bend": one}, ValueError, "parameters['cloth_bend'] must have shape (0,) or (B, 0), got (1,)"),
        ({"mass": -one}, ValueError, "mass"),
        ({"friction": -one.expand(3, 2)}, ValueError, "friction of 'body_0' (index 0) must be zero or positive"),
    ]
    for parameters, error, text in cases:
        with pytest.raises(error) as stepped:
            sim(state, parameters=parameters)
        with pytest.raises(error) as rolled:
            sim.rollout(state, steps=2, parameters=parameters)
        assert text in str(stepped.value)
        assert text in str(rolled.value)
    if check:
        with pytest.raises(NotImplementedError, match="restitution must be 0"):
            sim(state, parameters={"restitution": 0.5 * torch.ones(3, 2).double()})
