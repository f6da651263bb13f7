"""Steps that are not found at once and are taken in shorter ones."""

from __future__ import annotations

import math
import warnings

import pytest
import torch
from small_scenes import assert_same

import diffsim as ds
from diffsim import scenes

DT, COMPLIANCE, MU = 0.01, 1e-4, 0.1
EPS = 1e-6  # of differences
CARD, LEAN = (0.5, 0.3, 0.02), math.radians(65.0)  # [m]


def two_cards() -> ds.Scene:
    """They lean on each other, and friction is too little to hold them: edges slide off edges as they fall."""
    scene = ds.Scene()
    scene.add_ground(friction=MU)
    length, _, thick = CARD
    gap = 1e-3 * thick
    across = length * math.cos(LEAN) + thick * math.sin(LEAN)
    height = length * math.sin(LEAN) + thick * math.cos(LEAN)
    for side, angle in ((-1, LEAN), (1, math.pi - LEAN)):
        scene.add_body(
            ds.shapes.box(CARD),
            density=700.0,
            friction=MU,
            position=(0.5 * side * (across + gap), 0.0, gap + 0.5 * height),
            orientation=(math.cos(0.5 * angle), 0.0, -math.sin(0.5 * angle), 0.0),
        )
    return scene


def before_a_refined_step(sim: ds.Simulator) -> ds.State:
    state = sim.initial_state()
    for _ in range(40):
        after = sim(state)
        assert sim.info is not None
        if sim.info.refined_steps:
            return state
        state = after
    pytest.fail("every step was found at once")


def test_it_is_two_steps_of_half_the_time() -> None:
    sim = ds.Simulator(two_cards(), DT, compliance=COMPLIANCE, on_failure="raise")
    state = before_a_refined_step(sim)
    end = sim(state)
    assert sim.info is not None
    assert sim.info.converged
    assert float((end.velocity - state.velocity).norm()) > 0.01
    halves = ds.Simulator(two_cards(), 0.5 * DT, compliance=4.0 * COMPLIANCE, on_failure="raise")
    path = halves.rollout(state, None, 2)
    assert halves.info is not None
    assert halves.info.refined_steps == 0
    assert_same(path[-1], end)
    contacts, expected = sim.contacts(state), halves.contacts(path[0])
    assert len(contacts.force) > 0
    torch.testing.assert_close(contacts.force, expected.force, rtol=0.0, atol=0.0)


@pytest.mark.filterwarnings("ignore::diffsim.ConvergenceWarning")  # of steps before
def test_its_gradient_is_that_of_the_shorter_steps() -> None:
    """A landing, which takes one iteration more than it may have: where cards slide, all depends on rounding."""
    sim = ds.Simulator(scenes.tilted_box(), DT, max_iterations=4)
    state = before_a_refined_step(sim)
    weight = torch.tensor([[1.0, -0.5, 0.7]], dtype=torch.float64)

    def loss(velocity: torch.Tensor, mass: torch.Tensor, force: torch.Tensor) -> torch.Tensor:
        end = sim(state.replace(velocity=velocity), ds.Control(force=force), parameters={"mass": mass})
        assert sim.info is not None
        assert sim.info.refined_steps == 1
        assert sim.info.converged
        return (weight * (end.velocity + end.position + end.angular_velocity)).sum()

    values = [state.velocity, sim.mass.detach(), torch.tensor([[3.0, 2.0, -1.0]], dtype=torch.float64)]
    leaves = [v.clone().requires_grad_() for v in values]
    found = torch.autograd.grad(loss(*leaves), leaves)
    generator = torch.Generator().manual_seed(1)
    for k, gradient in enumerate(found):
        direction = torch.randn(values[k].shape, generator=generator, dtype=torch.float64)
        ends = []
        for sign in (1.0, -1.0):
            moved = list(values)
            moved[k] = values[k] + sign * EPS * direction
            with torch.no_grad():
                ends.append(float(loss(*moved)))
        expected = (ends[0] - ends[1]) / (2.0 * EPS)
        assert abs(expected) > 1e-5
        assert float((gradient * direction).sum()) == pytest.approx(expected, rel=1e-5, abs=1e-8)


def test_forces_of_its_end_have_gradients() -> None:
    sim = ds.Simulator(scenes.tilted_box(), DT, max_iterations=4, on_failure="warn")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ds.ConvergenceWarning)
        state = before_a_refined_step(sim)

    def push(velocity: torch.Tensor) -> torch.Tensor:
        contacts = sim.contacts(state.replace(velocity=velocity))
        assert sim.info is not None
        assert sim.info.refined_steps == 1
        return contacts.net_force()[0, 2]

    velocity = state.velocity.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(push(velocity), velocity)
    along = torch.tensor([[0.2, -0.3, 1.0]], dtype=torch.float64)
    with torch.no_grad():
        ends = [float(push(state.velocity + sign * 10.0 * EPS * along)) for sign in (1.0, -1.0)]
    expected = (ends[0] - ends[1]) / (20.0 * EPS)
    assert abs(expected) > 100.0
    # Forces are known as well as places, times contacts' stiffness: 1e-5 N here.
    assert float((gradient * along).sum()) == pytest.approx(expected, rel=3e-3)


def test_its_bits_are_those_of_a_batch_and_of_checkpoints() -> None:
    sim = ds.Simulator(two_cards(), DT, compliance=COMPLIANCE)
    state = before_a_refined_step(sim)
    end = sim.rollout(state, None, 3)[-1]
    assert sim.info is not None
    assert sim.info.refined_steps >= 1
    both = sim.rollout(ds.State.stack([state, state]), None, 3)
    assert_same(both[-1, 1], end)
    gradients = []
    for every in (None, 1):
        velocity = state.velocity.clone().requires_grad_()
        last = sim.rollout(state.replace(velocity=velocity), None, 3, checkpoint_every=every)[-1]
        gradients.append(torch.autograd.grad(last.position.sum(), velocity)[0])
    assert float(gradients[0].norm()) > 1e-3
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=1e-12)
