"""The linear systems behind adjoint="dense" and "qr", and how well those two solve them: long double says."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import diffsim as ds
from diffsim import scenes
from diffsim.diagnostics import ContactSystem, contact_systems

DT = 0.01
LongArray = NDArray[np.longdouble]


def load(name: str) -> ModuleType:
    """A module of the benchmarks, which are no package."""
    path = Path(__file__).resolve().parents[2] / "benchmarks" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


long_double = load("_long_double")
needs_long_double = pytest.mark.skipif(not long_double.AVAILABLE, reason="long double is no longer than double here")


def stack(mass_ratio: float = 1.0) -> ds.Scene:
    """Two layers of cubes, the upper `mass_ratio` times as heavy, pressed together a little: one zone."""
    scene = ds.Scene()
    scene.add_ground()
    box = ds.shapes.box(0.1)
    for k in range(4):
        scene.add_body(box, mass=1.0, inertia=np.eye(3) / 600.0, position=(0.12 * k, 0.0, 0.05))
    for k in range(3):
        inertia = mass_ratio * np.eye(3) / 600.0
        scene.add_body(box, mass=mass_ratio, inertia=inertia, position=(0.06 + 0.12 * k, 0.003, 0.15))
    return scene


def at_rest(steps: int = 60, **settings: Any) -> tuple[ds.Simulator, ds.State]:
    mass_ratio = settings.pop("mass_ratio", 1.0)
    sim = ds.Simulator(stack(mass_ratio), dt=DT, num_threads=1, on_failure="raise", **settings)
    with torch.no_grad():
        return sim, sim.rollout(sim.initial_state(), None, steps)[-1]


def by_elimination(system: ContactSystem, v: NDArray[np.float64]) -> tuple[LongArray, LongArray]:
    """The whole KKT matrix by Gauss, as in Eq. 9: z and λ."""
    A, J, K = (np.asarray(x, dtype=np.longdouble) for x in (system.inertia, system.jacobian, system.stiffness))
    matrix = np.block([[A, J.T], [J, -np.diag(1 / K)]])
    x = np.concatenate([v, np.zeros_like(K)])
    size = len(x)
    for k in range(size):
        pivot = k + int(np.argmax(np.abs(matrix[k:, k])))
        matrix[[k, pivot]], x[[k, pivot]] = matrix[[pivot, k]], x[[pivot, k]]
        factors = matrix[k + 1 :, k] / matrix[k, k]
        matrix[k + 1 :] -= factors[:, None] * matrix[k]
        x[k + 1 :] -= factors * x[k]
    for k in reversed(range(size)):
        x[k] = (x[k] - matrix[k, k + 1 :] @ x[k + 1 :]) / matrix[k, k]
    return x[: len(A)], x[len(A) :]


def by_householder(system: ContactSystem, v: NDArray[np.float64]) -> tuple[LongArray, LongArray]:
    """As in Eq. 13-15, with the compliance: least squares min |[Bᵀ; -1] x - [L⁻¹ v; 0]|, B = K^½ J L⁻ᵀ, λ = K^½ x."""
    A, J, K = (np.asarray(x, dtype=np.longdouble) for x in (system.inertia, system.jacobian, system.stiffness))
    n, m = len(A), len(J)
    L = np.zeros_like(A)  # Cholesky
    for k in range(n):
        L[k, k] = np.sqrt(A[k, k] - L[k, :k] @ L[k, :k])
        L[k + 1 :, k] = (A[k + 1 :, k] - L[k + 1 :, :k] @ L[k, :k]) / L[k, k]
    work = np.concatenate([v[:, None].astype(np.longdouble), J.T * np.sqrt(K)], axis=1)
    for k in range(n):  # L⁻¹ from the left
        work[k] = (work[k] - L[k, :k] @ work[:k]) / L[k, k]
    matrix = np.concatenate([work[:, 1:], -np.eye(m, dtype=np.longdouble)])
    rhs = np.concatenate([work[:, 0], np.zeros_like(K)])
    for k in range(m):
        mirror = matrix[k:, k].copy()
        mirror[0] += np.copysign(np.linalg.norm(mirror), mirror[0])
        mirror /= np.linalg.norm(mirror)
        matrix[k:] -= 2 * np.outer(mirror, mirror @ matrix[k:])
        rhs[k:] -= 2 * mirror * (mirror @ rhs[k:])
    x = np.zeros_like(K)
    for k in reversed(range(m)):
        x[k] = (rhs[k] - matrix[k, k + 1 : m] @ x[k + 1 :]) / matrix[k, k]
    multipliers = np.sqrt(K) * x
    z = v - J.T @ multipliers
    for factor in (L, L.T):  # A⁻¹
        order = range(n) if factor is L else reversed(range(n))
        for k in order:
            others = np.arange(n) != k
            z[k] = (z[k] - factor[k, others] @ np.where(factor[k, others] != 0, z[others], 0)) / factor[k, k]
    return z, multipliers


def relative(a: LongArray, b: LongArray) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def test_a_system_says_what_it_is_made_of() -> None:
    sim, state = at_rest()
    (system,) = contact_systems(sim, state)
    assert sim.info is not None
    contacts = len(system.stiffness)
    assert contacts >= 20
    np.testing.assert_array_equal(system.bodies, np.arange(7))
    assert system.nodes.shape == (0,)
    assert system.inertia.shape == (42, 42) and system.jacobian.shape == (contacts, 42)
    np.testing.assert_allclose(system.inertia.diagonal()[3::6], sim.mass.detach().numpy())
    np.testing.assert_allclose(np.linalg.eigvalsh(system.inertia), np.repeat([1 / 600.0, 1.0], 21), rtol=1e-12)
    assert (system.stiffness > 0.0).all()
    # Shifting everything sideways opens nothing; upwards, the contacts with the ground alone, by as much.
    shift = np.zeros((7, 6))
    shift[:, 3:5] = (0.3, -0.7)
    np.testing.assert_allclose(system.jacobian @ shift.ravel(), 0.0, atol=1e-12)
    lifted = system.jacobian @ np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 1.0], 7)
    assert set(np.round(lifted, 12)) == {0.0, 1.0}


def test_gradients_are_solutions_of_the_system() -> None:
    for adjoint in ("dense", "qr"):
        sim, state = at_rest(adjoint=adjoint)
        (system,) = contact_systems(sim, state)
        v = np.zeros((7, 6))
        v[:, 3:] = np.random.default_rng(0).standard_normal((7, 3))
        condensed = system.inertia + system.jacobian.T @ (system.stiffness[:, None] * system.jacobian)
        z = np.linalg.solve(condensed, v.ravel()).reshape(7, 6)
        force = torch.zeros(7, 3, dtype=torch.float64, requires_grad=True)
        loss = (sim(state, ds.Control(force=force)).position * torch.from_numpy(v[:, 3:])).sum()
        (gradient,) = torch.autograd.grad(loss, force)
        np.testing.assert_allclose(gradient.numpy(), DT**2 * z[:, 3:], rtol=0.0, atol=1e-11 * DT**2 * np.abs(z).max())


def test_nodes_of_cloth_are_in_it() -> None:
    scene = ds.Scene()
    sheet = scene.add_cloth(ds.shapes.sheet(0.3, 4), pinned=[0, 3, 12, 15])
    scene.add_sphere(0.05, mass=0.2, position=(0.0, 0.0, 0.06), velocity=(0.0, 0.0, -2.0))
    scene.add_cloth(ds.shapes.sheet(0.1, 2), position=(9.0, 0.0, 0.0))  # touches nothing
    sim = ds.Simulator(scene, dt=DT, adjoint="dense")
    state = sim.initial_state()
    with torch.no_grad():
        while sim.info is None or sim.info.contacts == 0:
            before, state = state, sim(state)
    systems = [s for s in contact_systems(sim, before) if len(s.stiffness)]
    assert len(systems) == 1
    (system,) = systems
    free = [k for k in range(16) if k not in (0, 3, 12, 15)]
    np.testing.assert_array_equal(system.nodes, np.arange(sheet.nodes.start, sheet.nodes.stop)[free])
    assert system.inertia.shape == (6 + 36, 6 + 36)
    np.testing.assert_array_equal(system.inertia[:6, 6:], 0.0)
    assert np.abs(system.inertia[6:, 6:] - np.diag(system.inertia.diagonal()[6:])).max() > 0.0  # stretching couples
    assert np.linalg.eigvalsh(system.inertia)[0] > 0.0


def test_without_contact_there_is_none() -> None:
    sim = ds.Simulator(scenes.tilted_box(height=5.0), dt=DT)
    assert contact_systems(sim, sim.initial_state()) == ()
    assert sim.info is None  # nothing was advanced


def test_wrong_input_is_refused() -> None:
    sim = ds.Simulator(scenes.tilted_box(), dt=DT)
    with pytest.raises(ValueError, match="no batch axis"):
        contact_systems(sim, sim.initial_state(batch=2))
    force = torch.zeros(2, 1, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match="no batch axis"):
        contact_systems(sim, sim.initial_state(), ds.Control(force=force))
    with pytest.raises(TypeError, match=r"sim must be a diffsim\.Simulator"):
        contact_systems(None, sim.initial_state())  # type: ignore[arg-type]


@needs_long_double
@pytest.mark.parametrize(
    ("compliance", "mass_ratio"), [(1e-1, 1.0), (1e-4, 1.0), (1e-8, 1.0), (1e-4, 1e3), (1e-8, 1e-3)]
)
def test_dense_and_qr_agree_in_long_double(compliance: float, mass_ratio: float) -> None:
    """So their common answer is what each of them is off from in double."""
    sim, state = at_rest(compliance=compliance, mass_ratio=mass_ratio)
    for system in contact_systems(sim, state):
        v = np.random.default_rng(1).standard_normal(len(system.inertia))
        z, pulled = long_double.solve(system, v)
        for other, multipliers in (by_elimination(system, v), by_householder(system, v)):
            assert relative(other, z) < 1e-15
            assert relative(system.jacobian.T.astype(np.longdouble) @ multipliers, pulled) < 1e-14


@needs_long_double
@pytest.mark.parametrize("adjoint", ["dense", "qr"])
@pytest.mark.parametrize(
    ("compliance", "mass_ratio"), [(1e-1, 1.0), (1e-4, 1.0), (1e-8, 1.0), (1e-4, 1e3), (1e-8, 1e-3)]
)
def test_dense_and_qr_are_good_to_rounding(adjoint: str, compliance: float, mass_ratio: float) -> None:
    sim, state = at_rest(adjoint=adjoint, compliance=compliance, mass_ratio=mass_ratio)
    error = long_double.rounding(sim, state)
    assert 1e-18 < error < 1e-11


@needs_long_double
def test_an_error_is_seen() -> None:
    """The exact mode solves another system, and the measure says by how much."""
    sim, state = at_rest()
    assert long_double.rounding(sim, state) > 1e-9
