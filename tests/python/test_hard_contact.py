"""compliance=0: contacts that do not give way, and the gradients of their limit."""

from __future__ import annotations

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
