"""Elastic steps of split coupling cut short: `newton_iterations=1` is Eq. 3 of Qiao et al. (ICML 2020)."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

import diffsim as ds
from diffsim._cloth_energy import cloth_elements, elastic_energy

FloatArray = NDArray[np.float64]

MATERIAL = ds.ClothMaterial(density=0.3, stretch=700.0, shear=90.0, bend=2e-3, poisson=0.25, damping=0.0)
PINNED = [0, 4]
REFUSAL = "no gradients through newton_iterations: .* third derivatives of the elastic energy"


def strip(dt: float, count: int | None, **options: Any) -> ds.Simulator:
    """Five by two nodes, hung up by two of them and stretched."""
    scene = ds.Scene()
    vertices, faces = ds.shapes.sheet((0.8, 0.2), (5, 2))
    start = vertices * [1.02, 1.1, 1.0] + np.stack(
        [0 * vertices[:, 0], 0 * vertices[:, 0], 0.1 * vertices[:, 0] ** 2], 1
    )
    scene.add_cloth((start, faces), MATERIAL, rest=vertices, pinned=PINNED)
    return ds.Simulator(scene, dt, coupling="split", newton_iterations=count, **options)


def moving(sim: ds.Simulator) -> ds.State:
    velocity = torch.randn(10, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    velocity[PINNED] = 0.0
    return sim.initial_state().replace(node_velocity=velocity)


def newton_iterates(sim: ds.Simulator, state: ds.State, count: int, drive: FloatArray) -> FloatArray:
    """Velocities after `count` times (M + dt² K) Δy = -M (y - ŷ) - dt² dΨ/dx, K by torch, all matrices dense."""
    elements = cloth_elements(sim._packed, sim._model)
    dt, x0 = sim.dt, state.node_position

    def energy(x: Tensor) -> Tensor:
        return elastic_energy(x, elements, sim.cloth_stretch, sim.cloth_shear, sim.cloth_bend)

    mass = (float(sim.cloth_density) * elements.node_area).repeat_interleave(3).numpy()
    free = elements.free.repeat_interleave(3).numpy() > 0.0
    target = (dt * (state.node_velocity + dt * sim.gravity)).numpy().ravel()
    y = np.where(free, 0.0, dt * drive.ravel())
    for _ in range(count):
        x = x0 + torch.from_numpy(y).reshape(-1, 3)
        force = -torch.func.grad(energy)(x).numpy().ravel()
        K = torch.func.hessian(energy)(x).reshape(len(y), len(y)).numpy()
        matrix = (np.diag(mass) + dt**2 * K)[np.ix_(free, free)]
        assert np.linalg.eigvalsh(matrix)[0] > 0.0  # otherwise the core takes another
        y[free] += np.linalg.solve(matrix, (mass * (target - y) + dt**2 * force)[free])
    return (y / dt).reshape(-1, 3)


@pytest.mark.parametrize("count", [1, 2, 4])
@pytest.mark.parametrize("driven", [False, True])
def test_iterates_are_those_of_a_dense_solve(count: int, driven: bool) -> None:
    sim = strip(0.02, count)
    state = moving(sim)
    drive = np.zeros((10, 3))
    if driven:
        drive[PINNED] = [[0.3, -0.2, 0.5], [-0.1, 0.4, 0.2]]
    end = sim(state, ds.Control(node_velocity=torch.from_numpy(drive)))
    expected = newton_iterates(sim, state, count, drive)
    converged = strip(0.02, None)(state, ds.Control(node_velocity=torch.from_numpy(drive)))
    np.testing.assert_allclose(end.node_velocity.numpy(), expected, rtol=0.0, atol=1e-10)
    if count < 4:
        assert np.abs(converged.node_velocity.numpy() - expected).max() > 1e-6
    assert sim.info is not None
    assert sim.info.iterations == count


def test_a_stretched_triangle_by_hand() -> None:
    """Pinned at one side and stretched, along which the stiffness is that of Green's strain: k (F² + ε)."""
    scene = ds.Scene(gravity=(0, 0, 0))
    rest = np.array([[0.0, 0, 0], [0, 1, 0], [1, 0.5, 0]])
    stretched = rest * [1.1, 1.0, 1.0]
    material = ds.ClothMaterial(density=0.3, stretch=700.0, shear=90.0, bend=2e-3, damping=0.0)
    scene.add_cloth((stretched, np.array([[0, 1, 2]])), material, pinned=[0, 1], rest=rest)
    dt, mass, strain, area = 0.02, 0.3 * 0.5 / 3.0, 0.5 * (1.1**2 - 1.0), 0.5
    sim = ds.Simulator(scene, dt, coupling="split", newton_iterations=1)
    end = sim(sim.initial_state())
    force = -area * 700.0 * strain * 1.1
    stiffness = area * 700.0 * (1.1**2 + strain)
    expected = dt * force / (mass + dt**2 * stiffness)
    np.testing.assert_allclose(end.node_velocity[2].numpy(), [expected, 0.0, 0.0], rtol=1e-12, atol=1e-14)


def test_many_iterates_are_the_converged_step() -> None:
    sim = strip(0.02, 12)
    state = moving(sim)
    converged = strip(0.02, None)(state)
    torch.testing.assert_close(sim(state).node_velocity, converged.node_velocity, rtol=0.0, atol=1e-9)


def test_the_error_falls_with_the_step() -> None:
    """Against converged steps of the same size, after the same time."""
    errors = []
    for dt in (0.008, 0.004, 0.002):
        first, converged = (strip(dt, count) for count in (1, None))
        steps = round(0.08 / dt)
        ends = [sim.rollout(moving(sim), None, steps).node_position[-1] for sim in (first, converged)]
        errors.append(float((ends[0] - ends[1]).abs().max()))
    assert errors[-1] > 1e-7
    assert errors[0] > 1.8 * errors[1] > 3.24 * errors[2], errors


def test_contact_still_converges() -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_cloth(ds.shapes.sheet(0.4, 5), MATERIAL, position=(0, 0, 0.05))
    sim = ds.Simulator(scene, 0.01, coupling="split", newton_iterations=1, on_failure="raise")
    end = sim.rollout(sim.initial_state(), None, 30)
    assert float(end.node_position[..., 2].min()) > 0.99 * sim.thickness
    assert float(end.node_position[-1, :, 2].max()) < 1.01 * sim.thickness


def test_gradients_are_refused() -> None:
    sim = strip(0.02, 1)
    state = moving(sim)
    plain = sim(state)
    x = state.node_position.clone().requires_grad_()
    asked = state.replace(node_position=x)
    end = sim(asked)
    torch.testing.assert_close(end.node_position.detach(), plain.node_position, rtol=0.0, atol=0.0)
    with pytest.raises(NotImplementedError, match=REFUSAL):
        end.node_position.sum().backward()
    with pytest.raises(NotImplementedError, match=REFUSAL):
        sim.rollout(asked, None, 4, checkpoint_every=2).node_velocity.sum().backward()
    with pytest.raises(NotImplementedError, match=REFUSAL):
        torch.func.grad(lambda x: sim(state.replace(node_position=x)).node_position.sum())(x.detach())
    with pytest.raises(NotImplementedError, match=REFUSAL):
        torch.func.jacrev(lambda x: sim(state.replace(node_position=x)).node_position)(x.detach())
    sim.cloth_bend.requires_grad_()
    with pytest.raises(NotImplementedError, match=REFUSAL):
        sim(state).node_position.sum().backward()


def test_the_setting_is_kept_and_shown() -> None:
    sim = strip(0.02, 3)
    assert sim._options.newton_iterations == copy.deepcopy(sim)._options.newton_iterations == 3
    assert "newton_iterations=3" in repr(sim)
    assert strip(0.02, None)._options.newton_iterations is None
    assert "newton_iterations=None" in repr(strip(0.02, None))
