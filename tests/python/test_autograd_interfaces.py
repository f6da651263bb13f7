"""PyTorch's other ways to ask for derivatives, other devices as default, and tensors that are not dense."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest
import torch
from small_scenes import landing_box
from test_ops import two_bodies
from torch import Tensor

import diffsim as ds
from diffsim.diagnostics import gradcheck


def end_of(sim: ds.Simulator, steps: int, every: int | None = None) -> Callable[[Tensor], Tensor]:
    state = sim.initial_state()
    return lambda v: sim.rollout(state.replace(velocity=v), None, steps, checkpoint_every=every).position[-1]


@pytest.mark.parametrize("make", [two_bodies, landing_box])
@pytest.mark.parametrize("every", [None, 2])
def test_batched_upstream_gradients_give_the_jacobian(make: Callable[[], ds.Simulator], every: int | None) -> None:
    sim = make()
    end = end_of(sim, 5, every)
    velocity = sim.initial_state().velocity
    expected = torch.func.jacrev(end)(velocity)
    assert expected.any()
    assert torch.equal(torch.autograd.functional.jacobian(end, velocity, vectorize=True), expected)
    assert torch.equal(torch.autograd.functional.jacobian(end, velocity), expected)
    leaf = velocity.clone().requires_grad_()
    result = end(leaf)
    eye = torch.eye(result.numel(), dtype=torch.float64).unflatten(1, result.shape)
    (rows,) = torch.autograd.grad(result, leaf, eye, is_grads_batched=True, retain_graph=True)
    assert torch.equal(rows.unflatten(0, result.shape), expected)
    (rows,) = torch.autograd.grad(result, leaf, eye, is_grads_batched=True, create_graph=True)
    assert torch.equal(rows.unflatten(0, result.shape), expected)


def test_batched_upstream_of_a_batch_and_of_parameters() -> None:
    sim = two_bodies()
    sim.mass.requires_grad_()
    states = sim.initial_state(batch=3)
    force = torch.randn(3, 2, 3, dtype=torch.float64)
    force[:, 1] = 0.0  # of the body that is driven
    force.requires_grad_()
    end = sim(states, ds.Control(force=force)).velocity
    upstream = torch.randn(4, *end.shape, dtype=torch.float64)
    found = torch.autograd.grad(end, (sim.mass, force), upstream, is_grads_batched=True, retain_graph=True)
    for i in range(4):
        expected = torch.autograd.grad(end, (sim.mass, force), upstream[i], retain_graph=True)
        for a, b in zip(found, expected):
            assert b.any()
            assert torch.equal(a[i], b)


def test_second_derivatives_say_first_order_only() -> None:
    sim = two_bodies()
    velocity = sim.initial_state().velocity
    end = end_of(sim, 2)

    def loss(v: Tensor) -> Tensor:
        return end(v).square().sum()

    for ask in (
        lambda: torch.func.hessian(loss)(velocity),
        lambda: torch.func.jacrev(torch.func.jacrev(loss))(velocity),
        lambda: torch.func.jvp(torch.func.grad(loss), (velocity,), (velocity,)),
        lambda: torch.autograd.functional.hessian(loss, velocity),
        lambda: torch.autograd.functional.hessian(loss, velocity, vectorize=True),
        lambda: torch.autograd.functional.hvp(loss, velocity, velocity),
    ):
        with pytest.raises(NotImplementedError, match="first order only"):
            ask()


# ---- devices ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def meta_by_default() -> Iterator[None]:
    before = torch.get_default_device()
    torch.set_default_device("meta")
    yield
    torch.set_default_device(before)


@pytest.mark.usefixtures("meta_by_default")
def test_another_default_device_is_left_alone() -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_sphere(0.1, density=1000.0, position=(0, 0, 0.5))
    scene.add_cloth(ds.shapes.sheet((1.0, 1.0), (2, 2)), ds.ClothMaterial(), pinned=[0], position=(2, 0, 1))
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    assert gradcheck(sim, state, steps=2, directions=2).passed
    force = torch.ones(1, 3, dtype=torch.float64, device="cpu")
    end = sim.rollout(state, [ds.Control(), ds.Control(force=force)], 2)[-1]
    assert sim.min_distance(end) > 0.0
    for value in (*end.__dict__.values(), sim.kinetic_energy(end), sim.potential_energy(end)):
        assert value.device.type == "cpu"
    assert sim.mesh_transform(end).device.type == "cpu"
    assert sim.vertices(end).device.type == "cpu"
    assert sim.info is not None
    assert sim.info.scenes_converged.device.type == "cpu"


# ---- layouts ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("with_cloth", [False, True])
@pytest.mark.parametrize("convert", [Tensor.to_sparse, Tensor.to_sparse_csr])
@pytest.mark.filterwarnings("ignore:Sparse .* is in beta")
def test_sparse_tensors_are_refused_by_name(with_cloth: bool, convert: Callable[[Tensor], Tensor]) -> None:
    scene = ds.Scene()
    scene.add_sphere(0.1, density=1000.0, position=(0, 0, 0.5))
    if with_cloth:
        scene.add_cloth(ds.shapes.sheet((1.0, 1.0), (2, 2)), ds.ClothMaterial(), position=(2, 0, 1))
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    sparse = convert(torch.ones(1, 3, dtype=torch.float64))
    leaf = sparse.clone().requires_grad_()
    for velocity in (sparse, leaf):
        with pytest.raises(TypeError, match=r"state\.velocity must be a dense tensor.*got torch\.sparse"):
            sim(state.replace(velocity=velocity))
    with pytest.raises(TypeError, match=r"control\.force must be a dense tensor.*got torch\.sparse"):
        sim(state, ds.Control(force=sparse))
    with pytest.raises(TypeError, match=r"controls\.force must be a dense tensor.*got torch\.sparse"):
        sim.rollout(state, ds.Control(force=sparse), 2)


def test_sparse_upstream_gradients_are_taken() -> None:
    sim = two_bodies()
    state = sim.initial_state()
    gradients = []
    for sparse in (False, True):
        velocity = state.velocity.clone().requires_grad_()
        end = sim(state.replace(velocity=velocity)).position
        torch.gather(end, 0, torch.tensor([[1, 1, 1]]), sparse_grad=sparse).sum().backward()
        gradients.append(velocity.grad)
    assert gradients[0].any()  # type: ignore[union-attr]
    assert torch.equal(*gradients)  # type: ignore[arg-type]
