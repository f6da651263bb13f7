"""The elastic energy of cloth in torch, against formulas; and what else is measured of cloth."""

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import diffsim as ds
from diffsim._cloth_energy import bending_energy, cloth_elements, dihedral_angle, green_strain, membrane_energy

MATERIAL = ds.ClothMaterial(density=0.3, stretch=700.0, shear=90.0, bend=2e-3, poisson=0.25)
SIZE = (1.2, 0.8)
AREA = SIZE[0] * SIZE[1]
ROUNDING = 1e-12


def sheet_sim(nodes: Any = (9, 7), **arguments: Any) -> ds.Simulator:
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_cloth(ds.shapes.sheet(SIZE, nodes), MATERIAL, **arguments)
    return ds.Simulator(scene, dt=0.01)


def deformed(sim: ds.Simulator, F: Any) -> ds.State:
    state = sim.initial_state()
    return state.replace(node_position=state.node_position @ torch.tensor(F, dtype=torch.float64).T)


def membrane(e11: float, e22: float, e12: float) -> float:
    """Per area [J/m²]"""
    nu = MATERIAL.poisson
    stretched = 0.5 * MATERIAL.stretch / (1 - nu**2) * (e11**2 + e22**2 + 2 * nu * e11 * e22)
    return stretched + 0.5 * MATERIAL.shear * (2 * e12) ** 2


def test_rest_and_rigid_motion_cost_nothing_and_push_nothing() -> None:
    vertices = ds.shapes.sheet(SIZE, (9, 7))[0]
    bent = np.stack([vertices[:, 0], vertices[:, 1], vertices[:, 0] ** 2 - 0.3 * vertices[:, 1] ** 3], axis=1)
    for rest in (vertices, bent):
        scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
        scene.add_cloth((rest, ds.shapes.sheet(SIZE, (9, 7))[1]), MATERIAL)
        sim = ds.Simulator(scene, dt=0.01)
        state = sim.initial_state()
        q = ds.rotation.from_rpy(torch.tensor([0.5 * torch.pi, 0.3, -2.0], dtype=torch.float64))
        for position in (state.node_position, ds.rotation.rotate(q, state.node_position) + 3.0):
            x = position.clone().requires_grad_()
            energy = sim.potential_energy(state.replace(node_position=x))
            (force,) = torch.autograd.grad(energy, x)
            assert 0.0 <= energy < 1e-25
            assert force.abs().max() < 1e-10


@pytest.mark.parametrize(
    ("F", "strain"),
    [
        (np.diag([1.1, 1.0, 1.0]), (0.105, 0.0, 0.0)),
        (np.diag([1.0, 0.9, 1.0]), (0.0, -0.095, 0.0)),
        (np.diag([1.2, 0.7, 1.0]), (0.22, -0.255, 0.0)),
        (np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]), (0.0, 0.045, 0.15)),
    ],
)
def test_uniform_strain_stores_its_energy_density(F: Any, strain: tuple[float, float, float]) -> None:
    sim = sheet_sim()
    energy = sim.potential_energy(deformed(sim, F))
    assert float(energy) == pytest.approx(AREA * membrane(*strain), rel=ROUNDING)
    turned = sheet_sim(orientation=ds.rotation.from_rpy(np.array([0.4, -1.1, 2.0])))
    R = ds.rotation.to_matrix(ds.rotation.from_rpy(np.array([0.4, -1.1, 2.0])))
    rotated = turned.potential_energy(deformed(turned, R @ F @ R.T))
    assert float(rotated) == pytest.approx(float(energy), rel=1e-10)


def test_warp_direction_turns_the_material() -> None:
    stretched = np.diag([1.1, 1.0, 1.0])
    for angle in (0.0, 0.3, 0.25 * np.pi, 0.5 * np.pi):
        c, s = np.cos(angle), np.sin(angle)
        sim = sheet_sim(warp=(c, s, 7.0))  # only its part in the plane counts
        strain = 0.105 * c * c, 0.105 * s * s, -0.105 * c * s
        energy = sim.potential_energy(deformed(sim, stretched))
        assert float(energy) == pytest.approx(AREA * membrane(*strain), rel=1e-10)


def test_rest_shape_sets_the_strain() -> None:
    vertices = ds.shapes.sheet(SIZE, (9, 7))[0]
    sim = sheet_sim(rest=vertices @ np.diag([0.5, 1.0, 1.0]))
    energy = sim.potential_energy(sim.initial_state())
    assert float(energy) == pytest.approx(0.5 * AREA * membrane(1.5, 0.0, 0.0), rel=ROUNDING)


def test_bending_to_a_cylinder() -> None:
    radius, previous = 0.9, np.inf
    for nodes in ((9, 7), (17, 13), (33, 25)):
        sim = sheet_sim(nodes)
        state = sim.initial_state()
        x, y, _ = state.node_position.unbind(-1)
        rolled = torch.stack([radius * torch.sin(x / radius), y, radius * (1 - torch.cos(x / radius))], dim=-1)
        elements = cloth_elements(sim._packed, sim._model)
        energy = bending_energy(dihedral_angle(rolled, elements.hinges), elements, sim.cloth_bend)
        # Half a hinge row is missing at each of the two free edges: the error is first order in the edge's length.
        error = abs(float(energy) / (0.5 * MATERIAL.bend / radius**2 * AREA) - 1.0)
        assert error < 0.6 * previous
        previous = error
    assert previous < 0.05


def test_hinges_turn_the_shorter_way_round() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0], [0.5, -1, 0]])
    folded = vertices.copy()
    folded[3] = [0.5, 0.995, 0.0998]  # nearly onto its neighbour, from above
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_cloth((folded, np.array([[0, 1, 2], [1, 0, 3]])), MATERIAL)
    sim = ds.Simulator(scene, dt=0.01)
    elements = cloth_elements(sim._packed, sim._model)
    below = torch.from_numpy(folded * [1.0, 1.0, -1.0])
    turn = 2 * np.pi - 2 * abs(float(elements.rest_angle))
    assert 0.0 < turn < 0.25
    energy = float(bending_energy(dihedral_angle(below, elements.hinges), elements, sim.cloth_bend))
    assert energy == pytest.approx(0.5 * MATERIAL.bend * float(elements.weight) * turn**2, rel=1e-9)


def test_energy_is_differentiable_to_the_second_order() -> None:
    sim = sheet_sim((4, 3))
    elements = cloth_elements(sim._packed, sim._model)
    noise = torch.randn(12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x = (sim.initial_state().node_position + 0.05 * noise).requires_grad_()
    values = [t.detach().clone().requires_grad_() for t in (sim.cloth_stretch, sim.cloth_shear, sim.cloth_bend)]

    def energy(x: Tensor, stretch: Tensor, shear: Tensor, bend: Tensor) -> Tensor:
        bending = bending_energy(dihedral_angle(x, elements.hinges), elements, bend)
        return membrane_energy(green_strain(x, elements), elements, stretch, shear) + bending

    assert torch.autograd.gradcheck(energy, (x, *values))
    assert torch.autograd.gradgradcheck(energy, (x, *values))


# ---- measurements ----------------------------------------------------------------------------------------------------


def mixed_sim() -> tuple[ds.Simulator, ds.ClothHandle, ds.ClothHandle]:
    scene = ds.Scene()
    first = scene.add_cloth(ds.shapes.sheet(1.0, 4), ds.ClothMaterial.denim(), pinned=[0, 3], position=(0, 0, 3))
    scene.add_body(ds.shapes.box(0.5), density=10.0, position=(0, 0, 5), velocity=(1, 0, 0))
    second = scene.add_cloth(ds.shapes.sheet(0.5, 3), position=(0, 4, 1), velocity=(0.5, -1, 2))
    return ds.Simulator(scene, dt=0.01), first, second


def test_energies_and_momenta_count_free_nodes() -> None:
    sim, first, second = mixed_sim()
    state = sim.initial_state()
    generator = torch.Generator().manual_seed(1)
    state = state.replace(node_velocity=torch.randn(25, 3, dtype=torch.float64, generator=generator))
    elements = cloth_elements(sim._packed, sim._model)
    density = torch.tensor([0.373] * 16 + [0.15] * 9, dtype=torch.float64)
    mass = density * elements.node_area
    assert mass[first.nodes].sum() == pytest.approx(0.373)
    assert mass[second.nodes].sum() == pytest.approx(0.15 * 0.25)
    mass[[0, 3]] = 0.0
    m, body = sim.mass[0], state.velocity[0]
    v, x = state.node_velocity, state.node_position
    weight = -(mass[:, None] * x).sum(0) @ sim.gravity - m * state.position[0] @ sim.gravity
    expected = {
        "kinetic_energy": 0.5 * m * body @ body + 0.5 * (mass * v.square().sum(-1)).sum(),
        "potential_energy": weight,
        "momentum": m * body + (mass[:, None] * v).sum(0),
        "angular_momentum": torch.linalg.cross(state.position[0], m * body)
        + torch.linalg.cross(x, mass[:, None] * v).sum(0),
    }
    batch = ds.State(*(t.expand(2, *t.shape) for t in state.__dict__.values()))
    for name, value in expected.items():
        function = getattr(sim, name)
        torch.testing.assert_close(function(state), value.detach(), rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(function(batch)[1], function(state), rtol=0.0, atol=0.0)
        assert function(state.to(torch.float32)).dtype is torch.float32


def test_energies_are_differentiable_by_the_cloths_parameters() -> None:
    sim, _, second = mixed_sim()
    state = sim.initial_state()
    pulled = state.node_position.clone()
    pulled[second.nodes] *= 1.1
    state = state.replace(node_position=pulled.requires_grad_())
    parameters = [p.requires_grad_() for p in (sim.cloth_density, sim.cloth_stretch, sim.cloth_shear, sim.cloth_bend)]
    grads = torch.autograd.grad(sim.potential_energy(state), [pulled, *parameters], allow_unused=True)
    assert all(g is not None for g in grads)
    assert grads[2][1] > 0.0  # only the second cloth is strained
    assert abs(grads[2][0]) < 1e-20
    (by_density,) = torch.autograd.grad(sim.kinetic_energy(state), sim.cloth_density)
    assert by_density.tolist() == pytest.approx([0.0, 0.5 * 0.25 * 5.25])


def test_vertices_are_those_of_bodies_then_nodes() -> None:
    sim, first, second = mixed_sim()
    state = sim.initial_state(batch=2)
    vertices = sim.vertices(state)
    assert vertices.shape == (2, 8 + 16 + 9, 3)
    assert torch.equal(vertices[:, 8:], state.node_position)
    x = state.node_position.clone().requires_grad_()
    (grad,) = torch.autograd.grad(sim.vertices(state.replace(node_position=x))[..., 2].sum(), x)
    assert torch.equal(grad, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(2, 25, 3))
    one = sim.initial_state()
    for handle in (first, second):
        mesh = sim.mesh(one, handle)
        np.testing.assert_array_equal(mesh.vertices, one.node_position[handle.nodes])
    assert len(sim.mesh(one, 0).faces) == 12
    assert len(sim.mesh(one, -1).faces) == 8
    with pytest.raises(IndexError):
        sim.mesh(one, 3)
