"""Cloth at rest against theory: pulled, sheared, hanging as a strip, as a chain and as a clamped elastica."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.integrate import solve_bvp
from scipy.optimize import brentq

import diffsim as ds

FloatArray = NDArray[np.float64]

G = 9.81
# What is left of the way to rest when stepping ends, relative to what is looked for.
AT_REST = 1e-7
SIDEWAYS = (0.5**0.5, 0.5**0.5, 0.0, 0.0)  # turns the sheet's y axis up, so that it hangs in the xz plane


def rest(sim: ds.Simulator, control: ds.Control | None = None, steps: int = 400) -> FloatArray:
    """Nodes where motion has ended; implicit Euler with a large step takes the motion out."""
    state = sim.initial_state()
    start = state.node_position
    for _ in range(steps):
        before, state = state, sim(state, control)
        moved = float((state.node_position - before.node_position).abs().max())
        if moved <= 1e-3 * AT_REST * float((state.node_position - start).abs().max()):
            break
    else:
        pytest.fail(f"still moving by {moved:g} m a step after {steps} steps")
    return state.node_position.numpy()


def simulator(scene: ds.Scene, dt: float = 0.1, **options: Any) -> ds.Simulator:
    return ds.Simulator(scene, dt, on_failure="raise", **options)


# ---- in the plane ----------------------------------------------------------------------------------------------------


def first_piola(F: FloatArray, material: ds.ClothMaterial) -> FloatArray:
    """P = F S in the plane, with S = ∂W/∂ε of the energy in ClothMaterial [N/m]."""
    e = 0.5 * (F.T @ F - np.eye(2))
    nu = material.poisson
    along = material.stretch / (1.0 - nu**2)
    shear = 2.0 * material.shear * e[0, 1]
    S = np.array([[along * (e[0, 0] + nu * e[1, 1]), shear], [shear, along * (e[1, 1] + nu * e[0, 0])]])
    return np.asarray(F @ S)


def edge_forces(F: FloatArray, material: ds.ClothMaterial, nx: int, ny: int, size: FloatArray) -> FloatArray:
    """Forces of constant stress P on the nodes of a sheet: P n along each side, half of each edge's to either end."""
    P = first_piola(F, material)
    force = np.zeros((ny, nx, 3))
    across, along = np.full(ny, size[1] / (ny - 1)), np.full(nx, size[0] / (nx - 1))
    for ends in (across, along):
        ends[[0, -1]] *= 0.5
    force[:, -1, :2] += across[:, None] * P[:, 0]
    force[:, 0, :2] -= across[:, None] * P[:, 0]
    force[-1, :, :2] += along[:, None] * P[:, 1]
    force[0, :, :2] -= along[:, None] * P[:, 1]
    return force.reshape(-1, 3)


@pytest.mark.parametrize("poisson", [0.0, 0.3, -0.4])
@pytest.mark.parametrize(
    "deformation",
    [
        [[1.3, 0.0], [0.0, 1.0]],  # with the sides held
        [[1.0, 0.2], [0.0, 1.05]],  # shear
        [[1.1, 0.3], [0.0, 1.2]],
    ],
)
def test_a_patch_under_constant_stress_deforms_homogeneously(deformation: list[list[float]], poisson: float) -> None:
    """By as much as the law says, whatever the triangles: the edge at y = 0 is pinned, the rest is pulled."""
    material = ds.ClothMaterial(stretch=1000.0, shear=300.0, poisson=poisson)
    nx, ny, size = 5, 4, np.array([0.5, 0.4])
    F = np.array(deformation)
    vertices, faces = ds.shapes.sheet(size, (nx, ny))
    vertices[:, 1] += 0.5 * size[1]
    rng = np.random.default_rng(0)
    inner = (np.abs(vertices[:, 0]) < 0.24) & (np.abs(vertices[:, 1] - 0.2) < 0.19)
    vertices[inner, :2] += 0.02 * rng.normal(size=(inner.sum(), 2))  # no regular grid
    expected = vertices.copy()
    expected[:, :2] = vertices[:, :2] @ F.T
    start = vertices.copy()
    start[:nx] = expected[:nx]
    scene = ds.Scene(gravity=(0, 0, 0))
    scene.add_cloth((start, faces), material, pinned=range(nx), rest=vertices)
    force = torch.from_numpy(edge_forces(F, material, nx, ny, size))
    found = rest(simulator(scene), ds.Control(node_force=force))
    moved = np.abs(expected - start).max()
    assert moved > 0.03
    np.testing.assert_allclose(found, expected, rtol=0, atol=AT_REST * moved)


@pytest.mark.parametrize("direction", ["warp", "weft"])
def test_uniaxial_pull_contracts_by_poissons_ratio(direction: str) -> None:
    """Green strains: σ/stretch along, with σ the second Piola stress, and -poisson times it across, to any size."""
    material = ds.ClothMaterial(stretch=2000.0, shear=500.0, poisson=0.35)
    length, width, nx, ny = 0.6, 0.3, 7, 4
    strain = 0.2
    stretched, contracted = np.sqrt(1.0 + 2.0 * strain), np.sqrt(1.0 - 2.0 * material.poisson * strain)
    pull = stretched * material.stretch * strain  # force per width
    scene = ds.Scene(gravity=(0, 0, 0))
    scene.add_cloth(ds.shapes.sheet((length, width), (nx, ny)), material, warp=np.eye(3)[int(direction == "weft")])
    force = torch.zeros(ny, nx, 3, dtype=torch.float64)
    share = np.full(ny, width / (ny - 1))
    share[[0, -1]] *= 0.5
    force[:, -1, 0], force[:, 0, 0] = torch.from_numpy(pull * share), torch.from_numpy(-pull * share)
    found = rest(simulator(scene), ds.Control(node_force=force.reshape(-1, 3)))
    assert np.ptp(found[:, 0]) == pytest.approx(stretched * length, rel=AT_REST)
    assert np.ptp(found[:, 1]) == pytest.approx(contracted * width, rel=AT_REST)
    assert not found[:, 2].any()


@pytest.mark.parametrize("poisson", [0.0, 0.3])
@pytest.mark.parametrize("direction", ["warp", "weft"])
def test_a_hanging_strip_stretches_under_its_weight(direction: str, poisson: float) -> None:
    density, stiffness, length, width, nx, ny = 0.5, 2.0e4, 1.0, 0.1, 5, 41
    scene = ds.Scene(gravity=(0, 0, -G))
    scene.add_cloth(
        ds.shapes.sheet((width, length), (nx, ny)),
        ds.ClothMaterial(density=density, stretch=stiffness, shear=0.4 * stiffness, poisson=poisson),
        pinned=range(nx * (ny - 1), nx * ny),
        orientation=SIDEWAYS,
        warp=np.eye(3)[int(direction == "warp")],
    )
    found = rest(simulator(scene)).reshape(ny, nx, 3)
    stretched = found[-1, :, 2].mean() - found[0, :, 2].mean() - length
    expected = density * G * length**2 / (2.0 * stiffness)
    assert expected > 1e-4
    # Strains are 2.5e-4 at most, and so is what the formula, linear in them, leaves out. Near the pins, which hold the
    # width, the strip is stiffer by Poisson's effect over a length of the width.
    assert stretched == pytest.approx(expected, rel=1e-3 + 2.0 * poisson**2 * width / length)
    contracted = np.ptp(found[:, :, 0], axis=1) / width - 1.0
    height = found[:, 0, 2] - found[0, 0, 2]
    middle = slice(ny // 4, 3 * ny // 4)  # away from the pins and from the end
    expected_strain = -poisson * density * G * height / stiffness
    atol = 1e-2 * np.abs(expected_strain).max() + 1e-4 * AT_REST
    np.testing.assert_allclose(contracted[middle], expected_strain[middle], rtol=0, atol=atol)


# ---- hanging and bending ---------------------------------------------------------------------------------------------


def chain_sag(segments: int, length: float, span: float) -> float:
    scene = ds.Scene(gravity=(0, 0, -G))
    vertices, faces = ds.shapes.sheet((length, 0.02), (segments + 1, 3))
    # It starts as an arc of the right length, so that it need not find its way from a flat sheet.
    angle = brentq(lambda a: np.sin(a) / a - span / length, 1e-3, 3.0)
    radius, turn = 0.5 * length / angle, 2.0 * angle / length * vertices[:, 0]
    arc = np.stack([radius * np.sin(turn), vertices[:, 1], -radius * np.cos(turn)], axis=1)
    ends = [row * (segments + 1) + column for row in range(3) for column in (0, segments)]
    arc[ends, 0] = np.sign(vertices[ends, 0]) * 0.5 * span
    material = ds.ClothMaterial(density=0.2, stretch=1.0e5, shear=1.0e4, bend=1.0e-9)
    scene.add_cloth((arc, faces), material, pinned=ends, rest=vertices)
    height = rest(simulator(scene)).reshape(3, -1, 3)[..., 2].mean(axis=0)
    return float(height[0] - height.min())


def test_a_chain_like_strip_hangs_in_a_catenary() -> None:
    length, span = 1.0, 0.7
    a = brentq(lambda a: 2.0 * a * np.sinh(0.5 * span / a) - length, 0.05, 10.0)
    sag = a * (np.cosh(0.5 * span / a) - 1.0)
    errors = np.array([abs(chain_sag(n, length, span) / sag - 1.0) for n in (8, 16, 32)])
    assert errors[0] < 0.03
    assert errors[-1] < 2e-3
    assert (errors[:-1] / errors[1:] > 3.0).all(), errors  # second order


def elastica(length: float, load: float) -> FloatArray:
    """Tip of a rod clamped horizontally, B θ'' = w (L - s) cos θ, θ(0) = 0, θ'(L) = 0, load = w / B; θ downwards."""
    s = np.linspace(0.0, length, 201)

    def rate(s: FloatArray, y: FloatArray) -> FloatArray:
        return np.stack([y[1], -load * (length - s) * np.cos(y[0]), np.cos(y[0]), np.sin(y[0])])

    def ends(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.array([a[0], b[1], a[2], a[3]])

    guess = np.stack([1.0 * s / length, 0.0 * s, s, 0.5 * s])
    found = solve_bvp(rate, ends, s, guess, tol=1e-9, max_nodes=20000)
    assert found.success
    return np.asarray(found.y[2:, -1])


def tip_of_clamped_strip(nx: int, ny: int, load: float, mesh: str) -> FloatArray:
    """In lengths of the strip. Clamped by two rows of pins, half way between which the bending begins."""
    length, density = 0.1, 0.2
    h, width = length / (nx + 0.5), length / 16.0  # narrow: of what is near each other, most is across it
    vertices, faces = ds.shapes.sheet((length + 0.5 * h, width), (nx + 2, ny + 1))
    vertices[:, 0] += 0.5 * length - 0.25 * h  # from -h/2 to length
    numbers = np.arange(len(vertices)).reshape(ny + 1, nx + 2)
    if mesh == "diagonals alike":
        a, b, c, d = numbers[:-1, :-1], numbers[:-1, 1:], numbers[1:, 1:], numbers[1:, :-1]
        faces = np.stack([a, b, c, a, c, d], axis=-1).reshape(-1, 3)
    elif mesh == "irregular":
        shift = np.random.default_rng(0).normal(size=(ny + 1, nx + 2, 2)).clip(-1.5, 1.5) * 0.2 * [h, width / ny]
        shift[:, [0, 1, -1]] = 0.0
        shift[[0, -1], :, 1] = 0.0
        vertices[:, :2] += shift.reshape(-1, 2)
    scene = ds.Scene(gravity=(0, 0, -G))
    bend = density * G * length**3 / load
    material = ds.ClothMaterial(density=density, stretch=1e4, shear=4e3, bend=bend)
    scene.add_cloth((vertices, faces), material, pinned=numbers[:, :2].ravel().tolist())
    found = rest(simulator(scene, dt=2.0)).reshape(ny + 1, nx + 2, 3)
    tip = found[:, -1].mean(axis=0) / length
    return np.array([tip[0], -tip[2]])


@pytest.mark.parametrize(
    ("mesh", "load", "falls", "error"),
    [
        ("alternating diagonals", 1.0, 0.1, 1e-4),
        ("alternating diagonals", 20.0, 0.7, 1e-3),
        ("diagonals alike", 1.0, 0.1, 1e-4),
        ("diagonals alike", 20.0, 0.7, 1e-3),
        ("irregular", 1.0, 0.1, 2e-4),
    ],
)
def test_a_clamped_strip_bends_as_the_elastica(mesh: str, load: float, falls: float, error: float) -> None:
    """Load is density g L³ / bend: at 1 it is a beam, at 20 it hangs."""
    exact = elastica(1.0, load)
    assert exact[1] > falls
    sizes = [(4, 1), (8, 1), (16, 2), (32, 4)] if mesh == "irregular" else [(4, 1), (8, 1), (16, 1), (32, 2)]
    errors = [float(np.linalg.norm(tip_of_clamped_strip(*size, load, mesh) - exact)) for size in sizes]
    assert (np.array(errors[:-1]) > 2.0 * np.array(errors[1:])).all(), errors
    assert errors[-1] < error


# ---- rigid motion ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (0.6, 0.0, 0.8)])
@pytest.mark.parametrize("shape", ["flat", "curved"])
@pytest.mark.filterwarnings("ignore::diffsim.ConvergenceWarning")  # judged in test_cloth_stiff.py
def test_a_turn_by_90_degrees_costs_no_energy_and_no_force(axis: tuple[float, ...], shape: str) -> None:
    vertices, faces = ds.shapes.sheet(0.5, 6)
    if shape == "curved":
        vertices[:, 2] = 0.3 * np.sin(4.0 * vertices[:, 0]) * np.cos(3.0 * vertices[:, 1])
    scene = ds.Scene(gravity=(0, 0, 0))
    material = ds.ClothMaterial.isotropic(young=1e6, thickness=1e-3, density=1000.0)
    scene.add_cloth((vertices, faces), material)
    sim = ds.Simulator(scene, dt=0.1)
    state = sim.initial_state()
    R = ds.rotation.to_matrix(np.array([0.5**0.5, *(0.5**0.5 * np.array(axis))]))
    turned = state.replace(node_position=torch.from_numpy(vertices @ np.asarray(R).T + [3.0, -2.0, 1.0]))
    bent = turned.replace(node_position=1.001 * turned.node_position)
    scale = float(sim.potential_energy(bent))
    assert scale > 1e-4
    rounding = 1e-15 * np.abs(turned.node_position.numpy()).max() / 0.1  # of a strain: an edge is 0.1 m long
    assert float(sim.potential_energy(turned)) <= 100.0 * material.stretch * 0.25 * rounding**2
    # Forces of rounding's size, over 0.1 s, where mass is 1e-2 kg a node.
    end = sim(turned)
    assert float((end.node_position - turned.node_position).abs().max()) <= 1e-13
    assert float((sim(bent).node_position - bent.node_position).abs().max()) > 1e-5
