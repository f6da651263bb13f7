"""compliance=0: contacts that do not give way, and the gradients of their limit."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import diffsim as ds
from diffsim import scenes

# Multipliers are iterated until a contact's compression changes by 1e-9 of its range.
HARD_COMPRESSION = 1e-8  # [of the thickness]


def test_resting_bodies_keep_their_distance_exactly() -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box((1.0, 1.0, 1.0)), density=1000.0, position=(0.0, 0.0, 0.6))
    scene.add_body(ds.shapes.box((1.0, 1.0, 1.0)), density=1000.0, position=(0.1, 0.2, 1.7))
    soft, hard = ds.Simulator(scene, dt=0.01), ds.Simulator(scene, dt=0.01, compliance=0.0)
    for sim in (soft, hard):
        sim.rollout(sim.initial_state(), None, steps=100)
        assert sim.info is not None and sim.info.converged and sim.info.contacts >= 8
    assert soft.info is not None and hard.info is not None
    assert soft.info.max_compression > 1e-6 * soft.thickness
    assert hard.info.max_compression < HARD_COMPRESSION * hard.thickness


def test_compliance_tends_to_hard_contact() -> None:
    scene = scenes.tilted_box()
    ends = []
    for compliance in (1e-2, 1e-3, 1e-4, 0.0):
        sim = ds.Simulator(scene, dt=0.01, compliance=compliance)
        ends.append(sim.rollout(sim.initial_state(), None, steps=60).position[-1])
        assert sim.info is not None and sim.info.converged and sim.info.contacts > 0
    errors = [float((end - ends[-1]).abs().max()) for end in ends[:-1]]
    assert errors[0] > errors[1] > errors[2] > 0.0
    assert errors[2] < 0.05 * errors[0]


def stack(*masses: float) -> ds.Scene:
    """Boxes upon each other, the first on the ground."""
    scene = ds.Scene()
    scene.add_ground()
    for k, mass in enumerate(masses):
        position = (0.01 * (k % 2), 0.013 * (k % 3), (k + 0.5) * 0.501)
        scene.add_body(ds.shapes.box(0.5), mass=mass, position=position)
    return scene


def test_a_heavy_body_rests_on_light_ones() -> None:
    """The contacts between the light ones are as stiff as their own masses make them, and are stiffened."""
    sim = ds.Simulator(stack(1.0, 1.0, 1e4), dt=0.01, compliance=0.0, on_failure="raise")
    state = sim.initial_state()
    sim.rollout(state, None, steps=60)
    assert sim.info is not None
    assert sim.info.contacts == 12
    assert sim.info.max_compression < HARD_COMPRESSION * sim.thickness


def draped(lower: float, upper: float) -> ds.Scene:
    """A sheet over a box, and a tilted one that falls on it."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.3), mass=lower, position=(0, 0, 0.15))
    material = ds.ClothMaterial(density=0.2 / 0.36, stretch=1e3, shear=300.0, bend=1e-4)
    scene.add_cloth(ds.shapes.sheet(0.6, 9), material, position=(0.003, 0.004, 0.302))
    scene.add_body(ds.shapes.box(0.25), mass=upper, position=(0.02, 0.01, 0.48), orientation=(1, 0.1, 0.05, 0.2))
    return scene


@pytest.mark.parametrize("masses", [(10.0, 10.0), (1000.0, 1000.0)])
def test_cloth_between_heavy_bodies_converges(masses: tuple[float, float]) -> None:
    """Contacts that a round lists anew go on from their multipliers, not from none."""
    sim = ds.Simulator(draped(*masses), dt=0.01, compliance=0.0, on_failure="raise")
    state = sim.initial_state()
    contacts = 0
    for _ in range(25):
        state = sim(state)
        assert sim.info is not None
        assert sim.info.max_compression < HARD_COMPRESSION * sim.thickness
        contacts = max(contacts, sim.info.contacts)
    assert contacts >= 90


def test_gradient_under_heavy_bodies_equals_central_differences() -> None:
    """The larger the ratio of masses the more of a difference is noise, and the larger eps has to be."""
    for scene, steps, eps in ((stack(1.0, 1.0, 1e4), 15, 1e-4), (draped(1000.0, 1000.0), 5, 1e-6)):
        sim = ds.Simulator(scene, dt=0.01, compliance=0.0)
        state = sim.rollout(sim.initial_state(), None, steps)[-1]
        report = ds.diagnostics.gradcheck(sim, state, steps=1, directions=2, eps=eps)
        assert sim.info is not None
        assert sim.info.converged and sim.info.contacts >= 12
        assert len(report.stable) == len(report.directions)
        assert report.passed, str(report)


@pytest.mark.parametrize("scene", [scenes.tilted_box, scenes.box_on_box])
def test_gradient_equals_central_differences(scene) -> None:  # type: ignore[no-untyped-def]
    sim = ds.Simulator(scene(), dt=0.01, compliance=0.0)
    report = ds.diagnostics.gradcheck(sim, sim.initial_state(), steps=60)
    assert sim.info is not None and sim.info.contacts > 0
    assert report.passed, str(report)


def test_dense_and_qr_agree() -> None:
    gradients = []
    for adjoint in ("dense", "qr"):
        sim = ds.Simulator(scenes.box_on_box(), dt=0.01, compliance=0.0, adjoint=adjoint)
        state = sim.initial_state()
        state.velocity.requires_grad_()
        end = sim.rollout(state, None, steps=60)
        (gradient,) = torch.autograd.grad(end.position[-1].sum() + end.velocity[-1].sum(), [state.velocity])
        gradients.append(gradient)
    assert gradients[0].abs().max() > 0.0
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-9, atol=1e-9 * float(gradients[0].abs().max()))


@pytest.mark.parametrize("mass", [1.0, 2.0, 3.0, 10.0])
@pytest.mark.parametrize("dt", [0.02, 0.01, 0.005])
def test_bodies_go_on_together_after_a_hard_impact(mass: float, dt: float) -> None:
    """They stay at their rest distance up to rounding, where a contact may be found to push or not."""
    for gap in (0.2, 0.205, 0.2137):
        scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
        scene.add_sphere(0.1, mass=1.0, velocity=(1.0, 0.0, 0.0))
        scene.add_sphere(0.1, mass=mass, position=(0.2 + gap, 0.0, 0.0))
        sim = ds.Simulator(scene, dt=dt, compliance=0.0, on_failure="raise")
        end = sim.rollout(sim.initial_state(), steps=round(0.5 / dt))[-1]
        np.testing.assert_allclose(end.velocity[:, 0].numpy(), 1.0 / (1.0 + mass), atol=1e-9)
