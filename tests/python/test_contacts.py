"""What a step's contacts are and how hard they push, and the derivatives of that."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch

import diffsim as ds
from diffsim import scenes

DT = 0.01


def settled(sim: ds.Simulator, steps: int = 60) -> ds.State:
    return sim.rollout(sim.initial_state(), steps=steps)[-1].detach()


def cube_on_ground(**options: object) -> ds.Simulator:
    """4 kg, tilted by nothing."""
    scene = ds.Scene(gravity=(0.0, 0.0, -9.81))
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.2), density=500.0, position=(0.3, -0.2, 0.101), name="cube")
    return ds.Simulator(scene, dt=DT, **options)


@pytest.mark.parametrize("compliance", [1e-4, 0.0])
def test_a_cube_at_rest_weighs_on_the_ground(compliance: float) -> None:
    sim = cube_on_ground(compliance=compliance)
    contacts = sim.contacts(settled(sim))
    assert len(contacts) == 4
    assert set(contacts.names()) == {("cube", "ground")}
    np.testing.assert_allclose(contacts.net_force().numpy(), [[0.0, 0.0, 39.24]], atol=1e-6)
    np.testing.assert_allclose(contacts.net_torque().numpy(), np.zeros((1, 3)), atol=1e-6)
    np.testing.assert_allclose(contacts.normal.numpy(), np.tile([0.0, 0.0, 1.0], (4, 1)))
    np.testing.assert_allclose(contacts.position[:, :2].abs().amin(dim=0).numpy(), [0.2, 0.1], atol=1e-6)
    assert (contacts.distance > 0.0).all()
    assert (contacts.distance <= sim.thickness).all()


def test_nothing_pushes_in_free_fall() -> None:
    sim = cube_on_ground()
    start = sim.initial_state()
    contacts = sim.contacts(start.replace(position=start.position + torch.tensor([0.0, 0.0, 1.0])))
    assert len(contacts) == 0
    assert contacts.net_force().shape == (1, 3)
    assert not contacts.net_force().any()
    assert not contacts.net_torque().any()


def impact(sim: ds.Simulator) -> ds.State:
    """The state before the step in which most pushes."""
    state = sim.initial_state()
    states, forces = [state], []
    for _ in range(40):
        forces.append(float(sim.contacts(states[-1]).net_force().norm()))
        states.append(sim(states[-1]).detach())
    return states[int(np.argmax(forces))]


@pytest.mark.parametrize("make", [scenes.tilted_box, scenes.two_spheres, scenes.nonconvex_pair])
def test_the_net_force_is_what_changes_the_momentum(make: Callable[[], ds.Scene]) -> None:
    sim = ds.Simulator(make(), dt=DT)
    state = impact(sim)
    contacts = sim.contacts(state)
    change = sim.mass[:, None] * (contacts.end.velocity - state.velocity - DT * sim.gravity)
    dynamic = sim.mass > 0.0
    assert contacts.net_force()[dynamic].abs().max() > 1.0
    np.testing.assert_allclose(
        DT * contacts.net_force()[dynamic], change[dynamic], rtol=1e-6, atol=1e-8 * float(change.abs().max())
    )


def test_a_batch_has_the_contacts_of_its_scenes() -> None:
    sim = cube_on_ground()
    rest = settled(sim)
    states = [rest, rest.replace(position=rest.position + torch.tensor([0.0, 0.0, 1.0])), rest]
    batch = rest.replace(
        **{name: torch.stack([getattr(s, name) for s in states]) for name in ("position", "orientation")},
        **{name: torch.stack([getattr(s, name) for s in states]) for name in ("velocity", "angular_velocity")},
    )
    contacts = sim.contacts(batch)
    assert contacts.scene.tolist() == [0, 0, 0, 0, 2, 2, 2, 2]
    np.testing.assert_allclose(contacts.net_force()[:, 0, 2].numpy(), [39.24, 0.0, 39.24], atol=1e-6)
    alone = sim.contacts(rest)
    np.testing.assert_array_equal(contacts.force[:4].numpy(), alone.force.numpy())


def boxes_that_cross() -> ds.Simulator:
    """Edge on edge, edges on a face, and a corner on the ground."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.4), density=500.0, position=(0.0, 0.0, 0.201), name="below")
    scene.add_body(
        ds.shapes.box((0.1, 0.1, 0.5)),
        density=800.0,
        position=(0.2, 0.0, 0.55),
        orientation=(0.8, 0.6, 0.05, 0.1),
        velocity=(-0.3, 0.1, -1.0),
        name="rod",
    )
    return ds.Simulator(scene, dt=DT)


def ball_on_sheet() -> ds.Simulator:
    scene = ds.Scene()
    scene.add_cloth(ds.shapes.sheet(1.0, 7), pinned=[0, 6, 42, 48], name="sheet")
    scene.add_body(ds.shapes.icosphere(0.15, 1), density=300.0, position=(0.03, 0.01, 0.16), velocity=(0.1, 0.0, -1.0))
    return ds.Simulator(scene, dt=DT)


def test_edges_that_are_nearly_parallel_push_by_finite_forces() -> None:
    """Cubes that land in a row, turned by 1e-3 and less: some closest points lie at an edge's end."""
    sim = ds.Simulator(scenes.two_layer_stack(6), dt=DT)
    state = sim(sim.initial_state()).detach()
    leaf = state.orientation.clone().requires_grad_()
    contacts = sim.contacts(state.replace(orientation=leaf))
    assert contacts.force.isfinite().all()
    change = sim.mass[:, None] * (contacts.end.velocity - state.velocity - DT * sim.gravity)
    np.testing.assert_allclose(DT * contacts.net_force().detach(), change.detach(), rtol=1e-6, atol=1e-9)
    (gradient,) = torch.autograd.grad(contacts.net_torque().sum(), [leaf])
    assert gradient.isfinite().all()
    assert gradient.any()


def test_contacts_are_refused_inside_transforms() -> None:
    sim = cube_on_ground()
    state = sim.initial_state()
    with pytest.raises(NotImplementedError, match=r"contacts: cannot run inside a transform"):
        torch.func.vmap(lambda v: sim.contacts(state.replace(velocity=v)).force)(state.velocity[None])


FIELDS = ("position", "orientation", "velocity", "angular_velocity", "node_position", "node_velocity")


@pytest.mark.parametrize("make", [boxes_that_cross, ball_on_sheet], ids=["boxes", "sheet"])
def test_derivatives_of_forces_are_those_of_differences(make: Callable[[], ds.Simulator]) -> None:
    sim = make()
    state = sim.initial_state()
    for _ in range(60):
        if len(sim.contacts(state)) > (3 if make is ball_on_sheet else 4):
            break
        state = sim(state).detach()
    weights: dict[str, torch.Tensor] = {}
    generator = torch.Generator().manual_seed(1)
    count = len(sim.contacts(state))
    assert count > 0

    def loss(values: dict[str, torch.Tensor]) -> torch.Tensor:
        parameters = {name: values[name] for name in ("mass", "cloth_density") if name in values}
        moved = state.replace(**{name: values[name] for name in FIELDS if name in values})
        contacts = sim.contacts(moved, parameters=parameters)
        if len(contacts) != count:
            return torch.tensor(torch.nan, dtype=torch.float64)  # moved too far
        total = torch.zeros((), dtype=torch.float64)
        for name, scale in (("force", 1e-3), ("position", 1.0), ("normal", 1.0), ("distance", 1e3)):
            value = getattr(contacts, name)
            if name not in weights:
                weights[name] = scale * torch.randn(value.shape, generator=generator, dtype=torch.float64)
            total = total + (weights[name] * value).sum()
        return total + 1e-3 * (contacts.net_torque() * torch.arange(1.0, 4.0)).sum()

    inputs = {name: getattr(state, name) for name in FIELDS if getattr(state, name).numel()}
    inputs["mass"] = sim.mass.detach()
    if sim.cloth_names:
        inputs["cloth_density"] = sim.cloth_density.detach()
    leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    gradients = dict(zip(leaves, torch.autograd.grad(loss(leaves), list(leaves.values()))))
    for name, value in inputs.items():
        direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
        if name == "orientation":
            direction = direction - value * (value * direction).sum(dim=-1, keepdim=True)
        expected = float((gradients[name] * direction).sum())
        assert expected != 0.0, name
        best = np.inf
        for eps in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7):
            ends = []
            for by in (-eps, eps):
                moved = value + by * direction
                if name == "orientation":
                    moved = moved / moved.norm(dim=-1, keepdim=True)
                try:
                    with torch.no_grad():
                        ends.append(loss({**inputs, name: moved}).item())
                except ValueError:  # moved into each other
                    ends.append(np.nan)
            best = np.fmin(best, abs((ends[1] - ends[0]) / (2.0 * eps) - expected))
        scale = float((gradients[name] * direction).abs().sum())
        assert best < 2e-5 * scale, f"{name}: {expected} is off by {best}, of {scale}"


def test_a_tactile_loss_finds_the_push_that_a_wall_feels() -> None:
    """Newton's method on the control by the gradient of the net force: linear, so that one step is enough."""
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(ds.shapes.box((0.1, 1.0, 1.0)), kind="static", position=(0.05, 0.0, 0.0), name="wall")
    scene.add_body(ds.shapes.box(0.2), density=125.0, position=(-0.101, 0.0, 0.0), name="cube")
    sim = ds.Simulator(scene, dt=DT)
    control = ds.Control(
        force=torch.zeros(2, 3, dtype=torch.float64).index_put(
            (torch.tensor(1),), torch.tensor([5.0, 0.0, 0.0], dtype=torch.float64)
        )
    )
    state = sim.rollout(sim.initial_state(), control, 50)[-1].detach()
    force = control.force.clone().requires_grad_()
    felt = sim.contacts(state, ds.Control(force=force)).net_force()
    assert float(felt[0, 0].detach()) == pytest.approx(5.0, rel=1e-6)
    (gradient,) = torch.autograd.grad(felt[0, 0], [force])
    assert float(gradient[1, 0]) == pytest.approx(1.0, abs=2e-3)


def test_forces_of_hard_contacts_say_that_they_have_no_gradient() -> None:
    sim = cube_on_ground(compliance=0.0)
    state = settled(sim)
    position = state.position.clone().requires_grad_()
    contacts = sim.contacts(state.replace(position=position))
    with pytest.raises(NotImplementedError, match="compliance=0"):
        contacts.net_force().sum().backward()


def test_contacts_of_float32_states_are_float32() -> None:
    sim = cube_on_ground()
    contacts = sim.contacts(settled(sim).to(torch.float32))
    assert contacts.force.dtype is torch.float32
    assert float(contacts.net_force()[0, 2]) == pytest.approx(39.24, rel=0.05)
    assert "4 contacts" in repr(contacts)
