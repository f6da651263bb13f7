"""Gradients through sticking, slipping and their changes, against central differences over 45 steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

import diffsim as ds
from diffsim.diagnostics import GradcheckReport, gradcheck

DT = 0.01
STEPS = 45


def slides_to_rest(scene: ds.Scene) -> None:
    scene.add_ground(friction=0.5)
    motion: dict[str, Any] = {"velocity": (1.2, 0.3, 0.0), "angular_velocity": (0.0, 0.0, 2.0)}
    scene.add_body(ds.shapes.box((1.0, 1.0, 0.4)), density=1000.0, position=(0, 0, 0.2004), friction=0.4, **motion)


def angle_tumbles(scene: ds.Scene) -> None:
    scene.add_ground(friction=0.5)
    scene.add_body(
        ds.shapes.l_shape(0.6, 0.2, 0.25),
        density=800.0,
        position=(0.0, 0.0, 0.6),
        orientation=(0.9, 0.2, -0.3, 0.1),
        velocity=(1.0, 0.3, -1.0),
        angular_velocity=(1.0, 2.0, -1.0),
        friction=0.4,
    )


def ball_rolls_off_a_box(scene: ds.Scene) -> None:
    scene.add_ground(friction=0.5)
    scene.add_body(ds.shapes.box((1.0, 1.0, 0.5)), kind="static", position=(0, 0, 0.25), friction=0.6)
    motion: dict[str, Any] = {"velocity": (1.5, 0.1, 0.0), "angular_velocity": (0.5, 1.0, 0.3)}
    scene.add_sphere(0.15, density=700.0, position=(0.2, 0.05, 0.651), friction=0.5, **motion)


def stack_is_hit(scene: ds.Scene) -> None:
    scene.add_ground(friction=0.4)
    scene.add_body(ds.shapes.box((0.6, 0.5, 0.3)), density=600.0, position=(0.0, 0.0, 0.1505), friction=0.5)
    scene.add_body(ds.shapes.box((0.4, 0.4, 0.3)), density=600.0, position=(0.05, 0.03, 0.4515), friction=0.5)
    scene.add_sphere(0.1, density=3000.0, position=(-0.6, 0.02, 0.2), velocity=(3.0, 0.1, 0.5), friction=0.3)


def box_is_pushed(scene: ds.Scene) -> None:
    scene.add_ground(friction=0.4)
    scene.add_sphere(0.1, kind="kinematic", position=(-0.32, 0.12, 0.2), velocity=(0.8, 0.0, 0.0), friction=0.3)
    scene.add_body(ds.shapes.box((0.4, 0.4, 0.3)), density=600.0, position=(0.0, 0.0, 0.1503), friction=0.5)


def box_on_a_turntable(scene: ds.Scene) -> None:
    scene.add_body(ds.shapes.box((4.0, 4.0, 0.5)), kind="kinematic", angular_velocity=(0.0, 0.0, 0.8), friction=0.5)
    box = ds.shapes.box((0.5, 0.5, 0.3))
    scene.add_body(box, density=1000.0, position=(1.0, 0.0, 0.4004), velocity=(0.1, 0.4, 0.0), friction=0.4)


SHEET = ds.ClothMaterial.isotropic(young=1e5, thickness=2e-3, density=300.0, poisson=0.3, damping=1e-3)


def add_held_sheet(scene: ds.Scene) -> None:
    scene.add_cloth(ds.shapes.sheet(0.6, 5), SHEET, pinned=[0, 4, 20, 24], position=(0.0, 0.0, 0.5), friction=0.5)


def sheet_on_a_box(scene: ds.Scene) -> None:
    scene.add_body(ds.shapes.box((0.4, 0.4, 0.3)), kind="static", position=(0, 0, 0.15), friction=0.4)
    motion: dict[str, Any] = {"position": (0.08, 0.03, 0.31), "velocity": (0.5, 0.1, 0.0)}
    scene.add_cloth(ds.shapes.sheet(0.6, 5), SHEET, friction=0.3, **motion)


def ball_on_a_sheet(scene: ds.Scene) -> None:
    add_held_sheet(scene)
    motion: dict[str, Any] = {"velocity": (0.6, 0.2, -0.5), "angular_velocity": (1.0, 0.0, 2.0)}
    scene.add_sphere(0.08, density=300.0, position=(-0.07, 0.02, 0.59), friction=0.4, **motion)


def figurine_on_a_sheet(scene: ds.Scene) -> None:
    add_held_sheet(scene)
    vertices, faces = ds.shapes.icosphere(0.1, 1)
    vertices *= 1.0 + 0.3 * np.cos(40.0 * vertices.sum(axis=1, keepdims=True))  # bumps and hollows
    motion: dict[str, Any] = {"velocity": (0.6, 0.2, -0.5), "angular_velocity": (1.0, 0.0, 2.0)}
    scene.add_body((vertices, faces), density=300.0, position=(-0.07, 0.02, 0.62), friction=0.4, **motion)


def simulator(build: Callable[[ds.Scene], None], **options: Any) -> ds.Simulator:
    scene = ds.Scene()
    build(scene)
    return ds.Simulator(scene, DT, on_failure="raise", **options)


def assert_right(report: GradcheckReport, least: int) -> None:
    """`least`: directions along which contacts and what they do stay the same."""
    assert len(report.stable) >= least, report
    assert report.passed, report  # median 1e-6, all 1e-4
    friction = [d for d in report.stable if d.name == "friction"]
    assert any(d.derivative != 0.0 for d in friction), report


@pytest.mark.parametrize(
    "build",
    [
        slides_to_rest,
        angle_tumbles,
        ball_rolls_off_a_box,
        stack_is_hit,
        sheet_on_a_box,
        ball_on_a_sheet,
        figurine_on_a_sheet,
    ],
    ids=lambda build: build.__name__,
)
def test_gradients_are_central_differences(build: Callable[[ds.Scene], None]) -> None:
    sim = simulator(build)
    report = gradcheck(sim, sim.initial_state(), steps=STEPS, directions=2, eps=1e-6)
    assert_right(report, least=8)


def test_gradients_of_a_turntable_and_its_drive() -> None:
    sim = simulator(box_on_a_turntable)
    drive = torch.tensor([[0.0, 0.0, 0.8], [0.0, 0.0, 0.0]], dtype=torch.float64)
    control = ds.Control(body_velocity=torch.zeros_like(drive), body_angular_velocity=drive)
    report = gradcheck(sim, sim.initial_state(), control, STEPS, directions=2)
    assert_right(report, least=8)
    assert any(d.name == "body_angular_velocity" and d.derivative != 0.0 for d in report.stable)


def test_gradients_of_a_pushed_box() -> None:
    """By forces, not places: its contact is closed by 1e-8 m, and opens under any difference that shows.

    Where what sticks works against what presses, steps end within 1e-9, so that differences have to be large to be
    exact; where friction and mass change so much that contacts do, they are exact to 1e-5.
    """
    sim = simulator(box_is_pushed)
    start = sim.rollout(sim.initial_state(), steps=3)[-1]  # of what touches first at the start, rounding decides
    control = ds.Control(force=torch.zeros(2, 3, dtype=torch.float64))
    forces = gradcheck(sim, start, control, STEPS, wrt=("force", "gravity"), directions=3, eps=1e-4)
    assert len(forces.stable) == 6, forces
    assert forces.passed, forces
    report = gradcheck(
        sim, start, control, STEPS, wrt=("friction", "mass"), directions=3, eps=3e-5, median_tolerance=2e-5
    )
    assert_right(report, least=4)


def test_what_slides_to_rest_forgets_its_push_but_for_where_it_stops() -> None:
    sim = simulator(slides_to_rest)
    start = sim.initial_state()
    velocity = start.velocity.clone().requires_grad_()
    end = sim.rollout(start.replace(velocity=velocity), steps=60)[-1]
    (of_place,) = torch.autograd.grad(end.position[0, 0], velocity, retain_graph=True)
    (of_speed,) = torch.autograd.grad(end.velocity.square().sum() + end.velocity.sum(), velocity)
    assert of_place[0, 0] > 0.1
    assert of_speed.abs().max() < 1e-9


def test_a_backward_in_segments_is_as_exact() -> None:
    """Their sums are rounded otherwise, which what sticks amplifies up to what its multipliers are solved to."""
    sim = simulator(stack_is_hit)
    start = sim.initial_state()
    sim.friction.requires_grad_()
    gradients = [
        torch.autograd.grad(sim.rollout(start, None, STEPS, every).position[-1].sum(), sim.friction)[0]
        for every in (None, 7)
    ]
    assert gradients[0].all()
    torch.testing.assert_close(*gradients, rtol=1e-6, atol=0.0)


def test_the_derivative_where_there_is_no_friction_is_finite() -> None:
    """That of a geometric mean is not: there it counts as zero. It is where one of the two is not zero, too."""
    sim = simulator(slides_to_rest)
    start = sim.initial_state()
    for values in ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0)):
        friction = torch.tensor(values, dtype=torch.float64, requires_grad=True)
        end = sim.rollout(start, steps=10, parameters={"friction": friction})[-1]
        (gradient,) = torch.autograd.grad(end.position.sum(), friction)
        assert not gradient.any()
    both = torch.tensor((0.5, 0.4), dtype=torch.float64, requires_grad=True)
    end = sim.rollout(start, steps=10, parameters={"friction": both})[-1]
    (gradient,) = torch.autograd.grad(end.position[0, 0], both)
    assert gradient[0] / gradient[1] == pytest.approx(0.4 / 0.5)  # of √(μ₁μ₂)
    assert math.isfinite(gradient.sum().item())
