"""Mass and inertia that move together, as one density does."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from small_scenes import BOX
from torch import Tensor

import diffsim as ds


def scene_of(density: float, cloth_density: float = 0.1) -> tuple[ds.Simulator, ds.BodyHandle, ds.ClothHandle]:
    """A ball that strikes the end of a box, which turns, above a sheet, which hangs."""
    scene = ds.Scene()
    box = scene.add_body(ds.shapes.box(BOX), density=density, position=(0, 0, 1), name="box")
    scene.add_sphere(0.1, density=500.0, position=(0.4, 0.0, 1.35), velocity=(0, 0, -8), name="ball")
    scene.add_body(ds.shapes.box(1.0), kind="static", position=(5, 0, 0), name="block")
    material = ds.ClothMaterial(density=cloth_density)
    sheet = scene.add_cloth(ds.shapes.sheet((1.0, 1.0), (3, 3)), material, pinned=[0], position=(0, 0, -3))
    return ds.Simulator(scene, dt=0.01), box, sheet


def end_of(sim: ds.Simulator, parameters: dict[str, Tensor]) -> Tensor:
    end = sim.rollout(sim.initial_state(), steps=15, parameters=parameters)[-1]
    return end.position[..., 0, 2] + end.angular_velocity[..., 0, 1] + end.node_position[..., -1, 2]


def test_a_scaled_density_is_that_of_a_scene_made_of_it() -> None:
    sim, box, sheet = scene_of(100.0)
    scaled = ds.parameters.scaled_density(sim, {box: 3.0, sheet: torch.tensor(2.0)})
    assert scaled.keys() == {"mass", "inertia", "cloth_density"}
    other, _, _ = scene_of(300.0, 0.2)
    for name, value in scaled.items():
        torch.testing.assert_close(value, getattr(other, name).detach(), rtol=1e-12, atol=0.0)
    found = end_of(sim, scaled)
    assert (found - end_of(sim, {})).abs() > 1e-3
    torch.testing.assert_close(found, end_of(other, {}), rtol=1e-9, atol=0.0)


def test_gradient_of_a_density_is_a_central_difference_and_not_that_of_the_mass_alone() -> None:
    sim, box, sheet = scene_of(100.0)

    def loss(factors: Tensor) -> Tensor:
        return end_of(sim, ds.parameters.scaled_density(sim, {box: factors[0], sheet: factors[1]}))

    factors = torch.ones(2, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(loss(factors), factors)
    assert (gradient.abs() > 1e-6).all()
    for i in range(2):
        step = 1e-5 * torch.eye(2, dtype=torch.float64)[i]
        difference = (loss(factors.detach() + step) - loss(factors.detach() - step)) / 2e-5
        torch.testing.assert_close(gradient[i], difference, rtol=1e-5, atol=1e-9)
    mass = sim.mass.detach().clone().requires_grad_()
    (alone,) = torch.autograd.grad(end_of(sim, {"mass": mass}), mass)
    assert ((alone @ mass.detach() * torch.tensor([1.0, 0, 0]).double()).sum() / gradient[0] - 1.0).abs() > 0.1


def test_all_forms_of_factors_and_one_per_scene_compose_with_other_parameters() -> None:
    sim, box, sheet = scene_of(100.0)
    per_scene = torch.tensor([0.5, 1.0, 2.0], requires_grad=True)  # float32 is taken, too
    gravity = torch.tensor([0.0, 1.0, -5.0], dtype=torch.float64)
    together = end_of(sim, {**ds.parameters.scaled_density(sim, {box: per_scene, sheet: 2.0}), "gravity": gravity})
    (gradients,) = torch.autograd.grad(together.sum(), per_scene)
    for i, factor in enumerate([0.5, 1.0, 2.0]):
        alone = {**ds.parameters.scaled_density(sim, {box: factor, sheet: 2.0}), "gravity": gravity}
        assert torch.equal(together[i], end_of(sim, alone))
        assert gradients[i] != 0.0
    for factor in (2.0, torch.tensor(2.0), torch.full((3,), 2.0), torch.full((4, 1), 2.0), torch.full((4, 3), 2.0)):
        scaled = ds.parameters.scaled_density(sim, factor)
        assert scaled.keys() == {"mass", "inertia"}
        batch = (4,) if getattr(factor, "ndim", 0) == 2 else ()
        assert torch.equal(scaled["mass"], (2.0 * sim.mass).expand(*batch, 3))
        assert torch.equal(scaled["inertia"], (2.0 * sim.inertia).expand(*batch, 3, 3, 3))


def test_wrong_factors_are_named() -> None:
    sim, box, sheet = scene_of(100.0)
    other = ds.Scene().add_sphere(0.1, density=1.0, name="stone")
    cases: list[tuple[Any, type[Exception], str]] = [
        ("2", TypeError, "scaled_density: factor must be a number or a torch.Tensor, got str"),
        (torch.ones(3, dtype=torch.int64), TypeError, "factor must be of floating point, got torch.int64"),
        (torch.ones(2), ValueError, "factor must have shape (), (3,), (B, 1) or (B, 3), got (2,)"),
        ({box: torch.ones(2, 1)}, ValueError, "factor of 'box' must have shape () or (B,), got (2, 1)"),
        ({box: torch.ones(2), sheet: torch.ones(3)}, ValueError, "factor must be of one number of scenes"),
        ({2: 2.0}, ValueError, "factor of 'block' has no meaning: static and kinematic bodies have no mass"),
        ({other: 2.0}, ValueError, "is of another scene"),
        ({9: 2.0}, IndexError, ""),
    ]
    for factor, error, text in cases:
        with pytest.raises(error) as caught:
            ds.parameters.scaled_density(sim, factor)
        assert text in str(caught.value)
    with pytest.raises(ValueError, match=r"mass.*'box'|'box'.*mass"):
        sim(sim.initial_state(), parameters=ds.parameters.scaled_density(sim, {box: -1.0}))
