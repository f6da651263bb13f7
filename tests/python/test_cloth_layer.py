"""Cloth under autograd and torch.func: the layer's promises, on motions whose outcome is known."""

import copy
import pickle

import torch
from small_scenes import only_read
from torch import Tensor
from torch.func import functional_call, grad, jacrev, vjp, vmap

import diffsim as ds

DT = 0.01
NODES = 16 + 9
FIELDS = tuple(ds.State.__dataclass_fields__)
# A step with cloth is solved to a relative residual of 1e-10.
SOLVED = 1e-9


def make_sim(pinned: tuple[int, ...] = (0, 3), bodies: int = 1) -> ds.Simulator:
    """Cloths and bodies too far from each other to touch."""
    scene = ds.Scene()
    material = ds.ClothMaterial(density=0.3, stretch=200.0, shear=50.0, bend=1e-3, damping=0.02, poisson=0.2)
    scene.add_cloth(ds.shapes.sheet(1.0, 4), material, pinned=pinned, position=(0, 0, 3))
    for k in range(bodies):
        scene.add_body(ds.shapes.box(0.5), density=10.0, position=(3.0 * k, 0, 9), velocity=(1, 0, 0))
    scene.add_cloth(ds.shapes.sheet(0.5, 3), position=(0, 4, 1), velocity=(0, 1, 0))
    return ds.Simulator(scene, dt=DT)


def moved(before: ds.State, after: ds.State) -> bool:
    """Whether the nodes moved: all else here would hold for cloth that hangs in the air, too."""
    return bool((after.node_position[..., 5, :] != before.node_position[..., 5, :]).any())


def shaken(sim: ds.Simulator, seed: int = 0) -> ds.State:
    """Nodes strained and in motion."""
    state, generator = sim.initial_state(), torch.Generator().manual_seed(seed)
    x, v = (torch.randn(NODES, 3, dtype=torch.float64, generator=generator) for _ in range(2))
    return state.replace(node_position=state.node_position + 0.02 * x, node_velocity=state.node_velocity + 0.5 * v)


def some(*shape: int, seed: int = 1) -> Tensor:
    return torch.randn(*shape, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def assert_same(a: ds.State, b: ds.State) -> None:
    for name in FIELDS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_unstrained_cloth_falls_like_anything_else() -> None:
    sim = make_sim(pinned=())
    start = sim.initial_state()
    trajectory = sim.rollout(start, None, 10)
    k = torch.arange(1.0, 11.0, dtype=torch.float64)[:, None, None]
    velocity = start.node_velocity + k * DT * sim.gravity
    position = start.node_position + k * DT * start.node_velocity + 0.5 * k * (k + 1) * DT**2 * sim.gravity
    torch.testing.assert_close(trajectory.node_velocity, velocity.detach(), rtol=SOLVED, atol=SOLVED)
    torch.testing.assert_close(trajectory.node_position, position.detach(), rtol=SOLVED, atol=SOLVED)
    assert sim.info is not None and sim.info.converged


def test_pinned_nodes_stand_still_or_move_as_told() -> None:
    sim = make_sim()
    start, pins = sim.initial_state(), [0, 3]
    still = sim.rollout(start, None, 3)
    assert moved(start, still[-1])
    assert torch.equal(still.node_position[:, pins], start.node_position[pins].expand(3, 2, 3))
    assert not still.node_velocity[:, pins].any()
    drive = torch.zeros(3, NODES, 3, dtype=torch.float64)
    drive[:, pins] = some(3, 2, 3)
    driven = sim.rollout(start, ds.Control(node_velocity=drive), 3)
    expected = start.node_position[pins] + DT * drive[:, pins].cumsum(0)
    torch.testing.assert_close(driven.node_position[:, pins], expected, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(driven.node_velocity[:, pins], drive[:, pins], rtol=1e-12, atol=1e-12)
    assert_same(driven, sim.rollout(start, [ds.Control(node_velocity=v) for v in drive], 3))
    only_first = sim.rollout(start, [ds.Control(node_velocity=drive[0]), ds.Control(), ds.Control()], 3)
    assert not only_first.node_velocity[1:, pins].any()


def test_forces_in_proportion_to_mass_act_like_gravity_and_tell_the_density() -> None:
    sim = make_sim(pinned=(), bodies=0)
    start = sim.initial_state()
    assert sim._elements is not None
    density = sim.cloth_density.detach().clone().requires_grad_()
    mass = sim.cloth_density.detach()[sim._elements.node_cloth] * sim._elements.node_area
    push = torch.tensor([0.3, -0.2, 4.0], dtype=torch.float64)
    control = ds.Control(node_force=mass[:, None] * push)
    end = functional_call(sim, {"cloth_density": density}, (start, control))
    expected = start.node_velocity + DT * (sim.gravity.detach() + push)
    torch.testing.assert_close(end.node_velocity.detach(), expected, rtol=SOLVED, atol=SOLVED)
    (by_density,) = torch.autograd.grad(end.node_velocity[..., 2].sum(), density)
    per_cloth = torch.tensor([16.0, 9.0]).double() * -DT * push[2] / sim.cloth_density.detach()
    torch.testing.assert_close(by_density, per_cloth, rtol=1e-7, atol=1e-7)


def test_gradients_equal_central_differences() -> None:
    sim = make_sim()
    control = ds.Control(
        node_force=0.05 * some(NODES, 3),
        node_velocity=0.3 * some(NODES, 3, seed=2),
        force=some(1, 3),
        torque=some(1, 3),
    )
    control = only_read(sim, control)
    report = ds.diagnostics.gradcheck(sim, shaken(sim), control, steps=3)
    names = {check.name for check in report.directions}
    assert {"node_position", "node_velocity", "node_force", "node_drive", "force"} < names
    assert {f"cloth_{name}" for name in ("density", "stretch", "shear", "bend", "damping")} < names
    assert not {name for name in report.zero_gradients if "node" in name or "cloth" in name}
    assert report.passed, str(report)
    alone = make_sim(bodies=0)
    assert ds.diagnostics.gradcheck(alone, shaken(alone), steps=3).passed


def test_batches_equal_single_runs_bit_by_bit() -> None:
    sim = make_sim()
    states = [shaken(sim, seed) for seed in range(3)]
    batch = ds.State(*(torch.stack(column) for column in zip(*(s.__dict__.values() for s in states))))
    force = some(3, NODES, 3)
    together = sim.rollout(batch, ds.Control(node_force=force), 4)
    assert moved(batch, together[-1])
    for k, state in enumerate(states):
        assert_same(together[:, k], sim.rollout(state, ds.Control(node_force=force[k]), 4))
    shared = sim(states[0], ds.Control(node_force=force))
    assert shared.node_position.shape == (3, NODES, 3)
    assert_same(shared[1], sim(states[0], ds.Control(node_force=force[1])))


def test_rollouts_checkpoints_and_copies_change_no_bit() -> None:
    sim = make_sim()
    start = shaken(sim)
    trajectory = sim.rollout(start, None, 7)
    assert moved(start, trajectory[-1])
    state = start
    for expected in trajectory:
        state = sim(state)
        assert_same(state, expected)
    for copied in (copy.deepcopy(sim), pickle.loads(pickle.dumps(sim))):
        assert_same(copied.rollout(start, None, 7, checkpoint_every=3), trajectory)
    grads = []
    for every in (None, 3):
        velocity = start.node_velocity.clone().requires_grad_()
        end = sim.rollout(start.replace(node_velocity=velocity), None, 7, checkpoint_every=every)
        assert torch.equal(end.node_position.detach(), trajectory.node_position)
        grads.append(torch.autograd.grad(end.node_position.square().sum(), velocity)[0])
    assert grads[0].any()
    torch.testing.assert_close(grads[0], grads[1], rtol=1e-11, atol=1e-11)


def test_float32_is_rounded_once() -> None:
    sim = make_sim()
    start = shaken(sim).to(torch.float32)
    end, exact = sim(start), sim(start.to(torch.float64))
    assert moved(start, end)
    assert_same(end, exact.to(torch.float32))


def test_functional_call_and_vmap_over_parameters_and_nodes() -> None:
    sim = make_sim()
    start, force = shaken(sim), some(3, NODES, 3)
    mapped = vmap(lambda f: sim(start, ds.Control(node_force=f)))(force)
    assert moved(start, mapped)
    for k in range(3):
        assert_same(mapped[k], sim(start, ds.Control(node_force=force[k])))

    def loss(stretch: Tensor, x: Tensor) -> Tensor:
        end = functional_call(sim, {"cloth_stretch": stretch}, (start.replace(node_position=x),))
        return end.node_velocity.square().sum()

    stretch = torch.stack([sim.cloth_stretch.detach() * s for s in (0.5, 1.0, 2.0)])
    x = torch.stack([shaken(sim, seed).node_position for seed in range(3)])
    per_sample = vmap(grad(loss, argnums=(0, 1)))(stretch, x)
    for k in range(3):
        one = grad(loss, argnums=(0, 1))(stretch[k], x[k])
        assert one[0].all()
        for a, b in zip(per_sample, one):
            torch.testing.assert_close(a[k], b, rtol=1e-11, atol=1e-11)


def test_jacrev_is_its_rows() -> None:
    sim = make_sim()
    start = shaken(sim)

    def end(v: Tensor) -> Tensor:
        return sim(start.replace(node_velocity=v)).node_position[5]

    jacobian = jacrev(end)(start.node_velocity)
    assert jacobian.shape == (3, NODES, 3)
    assert jacobian[0, 5, 0] > 0.1 * DT
    assert not jacobian[:, [0, 3]].any()  # pinned
    assert not jacobian[:, 16:].any()  # the other cloth
    _, pull_back = vjp(end, start.node_velocity)
    for row, unit in zip(jacobian, torch.eye(3, dtype=torch.float64)):
        torch.testing.assert_close(row, pull_back(unit)[0], rtol=1e-12, atol=1e-12)
