"""The rollout operator under autograd and torch.func; what the numbers mean physically is tested elsewhere."""

from collections.abc import Callable
from typing import Any

import pytest
import torch
import torch.autograd.forward_ad as forward_ad
import torch.utils._pytree as pytree
from small_scenes import landing_box, only_read
from torch import Tensor
from torch.func import functional_call, grad, jacrev, vjp, vmap

import diffsim as ds
from diffsim import _core

STATE_FIELDS = ("position", "orientation", "velocity", "angular_velocity")
PUSHED = torch.tensor([[1.0], [0.0]], dtype=torch.float64)  # of two bodies the dynamic one
# Two ways to the same derivative sum in different orders.
ROUNDING = 1e-12


def two_bodies() -> ds.Simulator:
    """A box and a kinematic box, tumbling, far from each other and from anything else."""
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((1.0, 0.7, 0.4)), density=2.0, position=(0, 0, 5), angular_velocity=(1.0, -2.0, 0.5))
    scene.add_body(ds.shapes.box(1.0), kind="kinematic", position=(9, 0, 5), velocity=(0, 1, 0))
    return ds.Simulator(scene, dt=0.01)


@pytest.fixture
def sim() -> ds.Simulator:
    return two_bodies()


@pytest.fixture
def state(sim: ds.Simulator) -> ds.State:
    return sim.initial_state()


@pytest.fixture
def force() -> Tensor:
    return PUSHED * torch.randn(2, 3, dtype=torch.float64)


class Calls:
    """Counts what reaches the core, and keeps the arguments of the last backward."""

    forward = recorded = backward = 0
    needs: tuple[bool, ...] = ()
    upstream: tuple[Any, ...] = ()


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Calls:
    count = Calls()
    forward, backward = _core.rollout, _core.rollout_backward

    def counted_forward(*args: Any, **options: Any) -> Any:
        count.forward += 1
        count.recorded += options["record"]
        return forward(*args, **options)

    def counted_backward(*args: Any, **options: Any) -> Any:
        count.backward += 1
        count.needs, count.upstream = options["needs"], args[2]
        return backward(*args, **options)

    monkeypatch.setattr(_core, "rollout", counted_forward)
    monkeypatch.setattr(_core, "rollout_backward", counted_backward)
    return count


def final(sim: ds.Simulator, state: ds.State, force: Tensor | None = None, steps: int = 3) -> Tensor:
    """A scalar of everything a rollout returns."""
    control = None if force is None else ds.Control(force=force)
    end = sim.rollout(state, control, steps)
    return torch.stack([(t * torch.arange(1.0, t.numel() + 1).view(t.shape)).sum() for t in fields(end)]).sum()


def fields(state: ds.State) -> tuple[Tensor, ...]:
    return tuple(getattr(state, name) for name in STATE_FIELDS)


def close(a: Tensor, b: Tensor) -> bool:
    assert a.shape == b.shape
    assert b.abs().max() > 0
    return bool((a - b).abs().max() <= ROUNDING * (1 + b.abs().max()))


@pytest.mark.parametrize("make", [two_bodies, landing_box])
@pytest.mark.parametrize("keep_time", [False, True])
def test_gradcheck(make: Callable[[], ds.Simulator], keep_time: bool) -> None:
    sim = make()
    n = len(sim.body_names)
    start = [t.requires_grad_() for t in fields(sim.initial_state())]
    controls = [torch.randn(n, 3, dtype=torch.float64, requires_grad=True) for _ in range(4)]
    parameters = [p.detach().clone().requires_grad_() for p in (sim.mass, sim.inertia, sim.gravity)]

    def run(*inputs: Tensor) -> tuple[Tensor, ...]:
        state, control, values = inputs[:4], inputs[4:8], dict(zip(("mass", "inertia", "gravity"), inputs[8:]))
        module = RolloutModule(sim, keep_time)
        names = ("force", "torque", "body_velocity", "body_angular_velocity")
        args = (ds.State(*state), only_read(sim, ds.Control(**dict(zip(names, control)))))
        return fields(functional_call(module, {f"sim.{k}": v for k, v in values.items()}, args))

    # Inertia is perturbed one entry at a time: only its symmetric part is read, so symmetric gradients are compared.
    parameters[1] = parameters[1].detach()
    assert torch.autograd.gradcheck(run, (*start, *controls, *parameters), eps=1e-6, atol=1e-6, rtol=1e-5)


class RolloutModule(torch.nn.Module):
    def __init__(self, sim: ds.Simulator, keep_time: bool) -> None:
        super().__init__()
        self.sim, self.keep_time = sim, keep_time

    def forward(self, state: ds.State, control: ds.Control) -> ds.State:
        return self.sim.rollout(state, control, 4) if self.keep_time else self.sim(state, control)


def test_a_step_is_a_rollout_of_one_step(sim: ds.Simulator, state: ds.State, force: Tensor) -> None:
    control = ds.Control(force=force)
    stepped, rolled = sim(state, control), sim.rollout(state, control, 1)
    for a, b in zip(fields(stepped), fields(rolled)):
        assert torch.equal(a, b[0])


def test_nothing_is_recorded_unless_a_gradient_can_be_asked_for(
    sim: ds.Simulator, state: ds.State, calls: Calls
) -> None:
    sim(state)
    moving = state.replace(velocity=state.velocity.clone().requires_grad_())
    with torch.no_grad():
        sim(moving)
    vmap(sim)(sim.initial_state(batch=2))
    assert (calls.forward, calls.recorded) == (3, 0)
    sim(moving)
    assert (calls.forward, calls.recorded) == (4, 1)
    sim.mass.requires_grad_()
    sim(state)
    assert (calls.forward, calls.recorded) == (5, 2)


def test_requires_grad_changes_no_bit(sim: ds.Simulator, state: ds.State) -> None:
    plain = sim.rollout(state, None, 20)
    sim.inertia.requires_grad_()
    tracked = sim.rollout(state.replace(position=state.position.clone().requires_grad_()), None, 20)
    for a, b in zip(fields(plain), fields(tracked)):
        assert torch.equal(a, b)


def test_only_what_is_asked_for_is_computed(sim: ds.Simulator, state: ds.State, force: Tensor, calls: Calls) -> None:
    force.requires_grad_()
    velocity = state.velocity.clone().requires_grad_()
    end = sim(state.replace(velocity=velocity), ds.Control(force=force))
    end.velocity.sum().backward()
    assert len(calls.needs) == 21
    assert [k for k, needed in enumerate(calls.needs) if needed] == [2, 6]  # velocity and force
    assert [g is not None for g in calls.upstream] == [False, False, True, False, False, False]
    assert velocity.grad is not None
    assert velocity.grad.any()
    assert force.grad is not None
    assert force.grad.any()


def gradients(sim: ds.Simulator, state: ds.State, control: ds.Control, names: set[str]) -> dict[str, Tensor]:
    """Gradients of some mix of where everything ends, with respect to the inputs of these names only."""
    inputs = (dict(sim.named_parameters()), state, control)
    paths, structure = pytree.tree_flatten_with_path(inputs)
    leaves = {pytree.keystr(path): t.detach().clone().requires_grad_(pytree.keystr(path) in names) for path, t in paths}
    parameters, state, control = pytree.tree_unflatten(leaves.values(), structure)
    outputs = pytree.tree_leaves(functional_call(sim, parameters, (state, control)))
    loss = torch.stack([(t * torch.linspace(0.5, 1.5, t.numel()).view(t.shape)).sum() for t in outputs]).sum()
    loss.backward()
    return {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None}


@pytest.mark.parametrize("coupling", ["monolithic", "split"])
def test_each_gradient_alone_is_what_it_is_among_all(coupling: str) -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.2), density=300.0, position=(0.5, 0.5, 0.62), angular_velocity=(1.0, 0.3, -0.2))
    scene.add_body(ds.shapes.box(0.2), kind="kinematic", position=(0.5, 0.5, 0.39), velocity=(0, 0, 0.1))
    scene.add_cloth(ds.shapes.sheet((1.0, 1.0), (4, 4)), ds.ClothMaterial(), pinned=[0], position=(0.5, 0.5, 0.505))
    sim = ds.Simulator(scene, dt=0.01, coupling=coupling)
    sim.friction.fill_(0.3)
    state = sim.rollout(sim.initial_state(), None, 5)[-1]
    bodies, nodes = torch.zeros_like(state.position), torch.zeros_like(state.node_position)
    control = only_read(sim, ds.Control(bodies + 0.1, bodies - 0.1, nodes + 1e-3, bodies, bodies, nodes))
    sim(state)
    assert sim.info.contacts > 4
    paths, _ = pytree.tree_flatten_with_path((dict(sim.named_parameters()), state, control))
    names = {pytree.keystr(path) for path, _ in paths} - {"[0]['restitution']"}
    assert len(names) == 21
    together = gradients(sim, state, control, names)
    assert together.keys() == names
    for name in names:
        assert together[name].any(), name
        (alone,) = gradients(sim, state, control, {name}).values()
        assert torch.equal(alone, together[name]), name


def test_backward_runs_twice_with_the_same_result(sim: ds.Simulator, state: ds.State, force: Tensor) -> None:
    force.requires_grad_()
    loss = final(sim, state, force)
    (first,) = torch.autograd.grad(loss, force, retain_graph=True)
    (second,) = torch.autograd.grad(loss, force)
    assert first.any()
    assert torch.equal(first, second)
    with pytest.raises(RuntimeError, match="second time"):
        torch.autograd.grad(loss, force)


def test_inputs_changed_in_place_are_noticed(sim: ds.Simulator, state: ds.State) -> None:
    sim.mass.requires_grad_()
    loss = sim(state).position.sum()
    with torch.no_grad():
        sim.mass.mul_(2.0)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_second_derivatives_are_refused(sim: ds.Simulator, state: ds.State, force: Tensor) -> None:
    force.requires_grad_()
    (first,) = torch.autograd.grad(final(sim, state, force), force, create_graph=True)
    with pytest.raises(NotImplementedError, match="first order only"):
        torch.autograd.grad(first.sum(), force)
    with pytest.raises(NotImplementedError, match="first order only"):
        grad(lambda f: grad(lambda g: final(sim, state, g))(f).sum())(force.detach())


def test_leaving_a_transform_leaves_usable_tensors(sim: ds.Simulator, state: ds.State, force: Tensor) -> None:
    leaked: list[ds.State] = []

    def loss(f: Tensor) -> Tensor:
        leaked.append(sim(state, ds.Control(force=f)))
        return leaked[0].velocity.sum()

    grad(loss)(force)
    expected = sim(sim(state, ds.Control(force=force)))
    assert torch.equal(sim(leaked[0]).position, expected.position)


# ---- batches and vmap ------------------------------------------------------------------------------------------------


def different_states(sim: ds.Simulator, *leading: int) -> ds.State:
    state = sim.initial_state()
    spread = 0.1 * torch.randn(*leading, *state.velocity.shape, dtype=torch.float64)
    full = [t.expand(*leading, *t.shape) for t in (*fields(state), state.node_position, state.node_velocity)]
    return ds.State(*full).replace(velocity=state.velocity + spread)


@pytest.mark.parametrize("make", [two_bodies, landing_box])
def test_batch_equals_single_runs(make: Callable[[], ds.Simulator]) -> None:
    sim = make()
    states = different_states(sim, 3)
    velocity = states.velocity.requires_grad_()
    together = sim.rollout(states.replace(velocity=velocity), None, 6)
    (gradient,) = torch.autograd.grad(together.position.square().sum(), velocity)
    for i in range(3):
        alone = velocity[i].detach().requires_grad_()
        one = sim.rollout(states[i].replace(velocity=alone), None, 6)
        for a, b in zip(fields(together), fields(one)):
            assert torch.equal(a[:, i], b)
        (expected,) = torch.autograd.grad(one.position.square().sum(), alone)
        assert torch.equal(gradient[i], expected)
        assert expected.any()


@pytest.mark.parametrize("make", [two_bodies, landing_box])
def test_vmap_equals_the_native_batch(make: Callable[[], ds.Simulator], calls: Calls) -> None:
    sim = make()
    states = different_states(sim, 3)
    native = sim.rollout(states, None, 4)
    before = calls.forward
    mapped = vmap(lambda s: sim.rollout(s, None, 4), out_dims=1)(states)
    assert calls.forward == before + 1
    for a, b in zip(fields(native), fields(mapped)):
        assert torch.equal(a, b)
    assert mapped.node_position.shape == (4, 3, 0, 3)


@pytest.mark.parametrize("steps", [1, 3])
def test_nested_vmap_over_a_native_batch(sim: ds.Simulator, steps: int) -> None:
    states = different_states(sim, 2, 3, 4)
    forces = PUSHED * torch.randn(3, 2, 3, dtype=torch.float64)

    def run(state: ds.State, force: Tensor) -> ds.State:
        assert state.position.shape == (4, 2, 3)
        return sim.rollout(state, ds.Control(force=force), steps)[-1]

    result = vmap(vmap(run), in_dims=(0, None))(states, forces)
    for i in range(2):
        for j in range(3):
            expected = sim.rollout(states[i, j], ds.Control(force=forces[j]), steps)[-1]
            for a, b in zip(fields(result), fields(expected)):
                assert torch.equal(a[i, j], b)


def test_vmap_over_any_axis_of_controls_with_time(sim: ds.Simulator, state: ds.State) -> None:
    forces = PUSHED[..., None] * torch.randn(5, 2, 3, 4, dtype=torch.float64)  # steps, bodies, xyz, mapped

    def run(force: Tensor) -> Tensor:
        return sim.rollout(state, ds.Control(force=force), 5).velocity

    result = vmap(run, in_dims=3)(forces)
    for i in range(4):
        assert torch.equal(result[i], run(forces[..., i].contiguous()))


def test_vmap_of_grad_gives_one_gradient_each(sim: ds.Simulator) -> None:
    states, mass = different_states(sim, 3), sim.mass.detach()

    def loss(mass: Tensor, state: ds.State) -> Tensor:
        return functional_call(
            sim, {"mass": mass}, (state, ds.Control(force=PUSHED * torch.ones_like(state.velocity)))
        ).velocity.sum()

    mapped = vmap(grad(loss), in_dims=(None, 0))(mass, states)
    assert mapped.shape == (3, 2)
    for i in range(3):
        assert close(mapped[i], grad(loss)(mass, states[i]))


def test_vmap_of_grad_over_a_native_batch_sums_over_it(sim: ds.Simulator) -> None:
    states, force = different_states(sim, 3, 4), PUSHED * torch.randn(5, 2, 3, dtype=torch.float64)

    def loss(force: Tensor, state: ds.State) -> Tensor:
        return sim.rollout(state, ds.Control(force=force), 5).position.square().sum()

    mapped = vmap(grad(loss), in_dims=(None, 0))(force, states)
    for i in range(3):
        assert close(mapped[i], grad(loss)(force, states[i]))


def test_grad_of_vmap(sim: ds.Simulator) -> None:
    states, force = different_states(sim, 3), PUSHED * torch.randn(2, 3, dtype=torch.float64)

    def loss(force: Tensor) -> Tensor:
        return vmap(lambda s: sim.rollout(s, ds.Control(force=force), 3).position)(states).square().sum()

    def looped(force: Tensor) -> Tensor:
        runs = [sim.rollout(states[i], ds.Control(force=force), 3).position.square().sum() for i in range(3)]
        return torch.stack(runs).sum()

    assert close(grad(loss)(force), grad(looped)(force))
    leaf = force.clone().requires_grad_()
    assert close(torch.autograd.grad(loss(leaf), leaf)[0], grad(looped)(force))


def test_jacrev_rows_are_gradients(sim: ds.Simulator, state: ds.State, force: Tensor, calls: Calls) -> None:
    def run(force: Tensor) -> Tensor:
        return sim.rollout(state, ds.Control(force=force), 3).position[-1]

    jacobian = jacrev(run)(force)
    assert calls.forward == 1
    assert jacobian.shape == (2, 3, 2, 3)
    for body in range(2):
        for axis in range(3):
            row = grad(lambda f, b=body, a=axis: run(f)[b, a])(force)  # type: ignore[misc]
            assert torch.equal(jacobian[body, axis], row)
    assert jacobian.any()


def test_jacrev_inside_vmap(sim: ds.Simulator) -> None:
    states, force = different_states(sim, 3), PUSHED * torch.randn(2, 3, dtype=torch.float64)

    def run(force: Tensor, state: ds.State) -> Tensor:
        return sim(state, ds.Control(force=force)).position

    mapped = vmap(jacrev(run), in_dims=(None, 0))(force, states)
    for i in range(3):
        assert close(mapped[i], jacrev(run)(force, states[i]))


def test_vjp_outside_of_its_transform(sim: ds.Simulator, state: ds.State, force: Tensor) -> None:
    output, pull = vjp(lambda f: sim(state, ds.Control(force=f)).velocity, force)
    (first,), (second,) = pull(torch.ones_like(output)), pull(2 * torch.ones_like(output))
    assert first.any()
    assert torch.equal(2 * first, second)


def test_hidden_inputs_are_recorded_under_vmap(sim: ds.Simulator, calls: Calls) -> None:
    """Inside vmap no tensor says that it requires grad; the operator has to find out."""
    states = different_states(sim, 3)
    velocity = states.velocity.requires_grad_()
    result = vmap(sim)(states.replace(velocity=velocity))
    assert (calls.forward, calls.recorded) == (1, 1)
    result.position.sum().backward()
    assert (calls.forward, calls.backward) == (1, 1)
    assert velocity.grad is not None
    assert velocity.grad.any()


# ---- forward-mode AD -------------------------------------------------------------------------------------------------


def test_tangents_are_refused_by_name() -> None:
    scene = ds.Scene()
    scene.add_sphere(0.1, density=1000.0, position=(0, 0, 1))
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    ones = torch.ones_like(state.velocity)
    with forward_ad.dual_level():
        assert torch.equal(sim(state).position, sim(state).position)  # nothing carries a tangent here
        dual = state.replace(velocity=forward_ad.make_dual(state.velocity, ones))
        for call in (lambda: sim(dual), lambda: sim.rollout(dual, None, 3)):
            with pytest.raises(NotImplementedError, match=r"state\.velocity carries a tangent"):
                call()
        force = forward_ad.make_dual(torch.zeros(1, 3, dtype=torch.float64), ones)
        with pytest.raises(NotImplementedError, match=r"control\.force carries a tangent"):
            sim(state, ds.Control(force=force))
        gravity = forward_ad.make_dual(sim.gravity.detach(), ones[0])
        with pytest.raises(NotImplementedError, match="gravity carries a tangent"):
            torch.func.functional_call(sim, {"gravity": gravity}, (state,))
    with pytest.raises(NotImplementedError, match="carries a tangent"):
        torch.func.jvp(lambda v: sim(state.replace(velocity=v)).position, (state.velocity,), (ones,))
