import os

import numpy as np
import pytest

from diffsim import shapes
from diffsim._mass_properties import capsule_mass_properties, mesh_mass_properties, sphere_mass_properties

ROUNDING = 1e-12  # relative; sums over a few to a few thousand faces


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q * np.sign(np.linalg.det(q))


def box_inertia(mass: float, extents: np.ndarray) -> np.ndarray:
    return mass / 12.0 * np.diag(np.sum(extents**2) - extents**2)


def about(point: np.ndarray, mass: float, center: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    r = center - point
    return inertia + mass * (r @ r * np.eye(3) - np.outer(r, r))


def test_box() -> None:
    extents = np.array([0.3, 1.1, 2.0])
    found = mesh_mass_properties(*shapes.box(tuple(extents)))
    mass = float(np.prod(extents))
    assert found.mass == pytest.approx(mass, rel=ROUNDING)
    np.testing.assert_allclose(found.center, 0.0, atol=ROUNDING)
    np.testing.assert_allclose(found.inertia, box_inertia(mass, extents), rtol=ROUNDING, atol=ROUNDING)


def test_symmetry_is_exact() -> None:
    found = mesh_mass_properties(*shapes.box((0.1, 0.3, 0.7)))
    assert not found.center.any()
    assert np.count_nonzero(found.inertia) == 3


def test_tetrahedron_about_its_centre() -> None:
    size = 0.7
    found = mesh_mass_properties(*shapes.tetrahedron(size))
    mass = size**3 / (6.0 * np.sqrt(2.0))
    assert found.mass == pytest.approx(mass, rel=ROUNDING)
    np.testing.assert_allclose(found.center, 0.0, atol=ROUNDING)
    np.testing.assert_allclose(found.inertia, mass * size**2 / 20.0 * np.eye(3), atol=ROUNDING)


def test_any_tetrahedron() -> None:
    rng = np.random.default_rng(1)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)
    for _ in range(20):
        vertices = rng.normal(size=(4, 3)) + 5.0
        volume = np.linalg.det(vertices[1:] - vertices[0]) / 6.0
        center = vertices.mean(axis=0)
        # ∫ (x - c)(x - c)ᵀ dV = V/20 Σ (x_i - c)(x_i - c)ᵀ
        second = volume / 20.0 * (vertices - center).T @ (vertices - center)
        found = mesh_mass_properties(vertices, faces)
        assert found.mass == pytest.approx(volume, rel=1e-10)
        np.testing.assert_allclose(found.center, center, rtol=1e-10)
        np.testing.assert_allclose(found.inertia, np.trace(second) * np.eye(3) - second, atol=1e-10 * abs(volume))


def test_rigid_motion_carries_over() -> None:
    rng = np.random.default_rng(2)
    vertices, faces = shapes.l_shape(1.0, 0.3, 0.5)
    here = mesh_mass_properties(vertices, faces)
    rotation, shift = random_rotation(rng), np.array([1e4, -2e4, 5e3])
    there = mesh_mass_properties(vertices @ rotation.T + shift, faces)
    rounding = 1e-10  # coordinates of 1e4 carry absolute errors of 1e-12
    assert there.mass == pytest.approx(here.mass, rel=rounding)
    np.testing.assert_allclose(there.center, rotation @ here.center + shift, rtol=rounding)
    np.testing.assert_allclose(there.inertia, rotation @ here.inertia @ rotation.T, atol=rounding)


def test_nonconvex_angle_is_the_sum_of_two_boxes() -> None:
    size, width, height = 1.0, 0.4, 0.6
    found = mesh_mass_properties(*shapes.l_shape(size, width, height))
    sides = np.array([[size, width, height], [width, size - width, height]])
    corners = np.array([[0.0, 0.0, 0.0], [0.0, width, 0.0]]) + np.array([-size / 2, -size / 2, -height / 2])
    masses, centers = sides.prod(axis=1), corners + sides / 2
    center = masses @ centers / masses.sum()
    inertia = sum(about(center, m, c, box_inertia(m, s)) for m, c, s in zip(masses, centers, sides))
    assert found.mass == pytest.approx(masses.sum(), rel=ROUNDING)
    np.testing.assert_allclose(found.center, center, atol=ROUNDING)
    np.testing.assert_allclose(found.inertia, inertia, atol=ROUNDING)


def test_cavity_is_subtracted() -> None:
    outer, inner = shapes.box(2.0), shapes.box(1.0)
    vertices = np.concatenate([outer[0], inner[0]])
    faces = np.concatenate([outer[1], inner[1][:, ::-1] + 8]).astype(np.int32)
    found = mesh_mass_properties(vertices, faces)
    assert found.mass == pytest.approx(7.0, rel=ROUNDING)
    inertia = box_inertia(8.0, np.full(3, 2.0)) - box_inertia(1.0, np.ones(3))
    np.testing.assert_allclose(found.inertia, inertia, atol=ROUNDING)


def test_inward_faces_change_the_sign_only() -> None:
    vertices, faces = shapes.u_channel()
    out, inwards = mesh_mass_properties(vertices, faces), mesh_mass_properties(vertices, faces[:, ::-1])
    assert inwards.mass == pytest.approx(-out.mass, rel=ROUNDING)
    np.testing.assert_allclose(inwards.center, out.center, rtol=ROUNDING, atol=ROUNDING)


def test_sphere_is_the_limit_of_facets() -> None:
    exact = sphere_mass_properties(0.7)
    errors = []
    for subdivisions in (3, 4):
        found = mesh_mass_properties(*shapes.icosphere(0.7, subdivisions))
        errors.append([1.0 - found.mass / exact.mass, 1.0 - found.inertia[0, 0] / exact.inertia[0, 0]])
        np.testing.assert_allclose(found.inertia, found.inertia[0, 0] * np.eye(3), atol=1e-12)
    assert np.all(np.array(errors[1]) > 0.0)
    np.testing.assert_allclose(np.array(errors[0]) / np.array(errors[1]), 4.0, rtol=0.02)  # second order


def test_capsule_is_the_limit_of_facets() -> None:
    import trimesh

    radius, length = 0.3, 0.9
    exact = capsule_mass_properties(radius, length)
    mesh = trimesh.creation.capsule(height=length, radius=radius, count=[256, 256])
    found = mesh_mass_properties(mesh.vertices - mesh.vertices.mean(axis=0), mesh.faces)
    facets = 1e-3  # of 256 segments, relative
    assert found.mass == pytest.approx(exact.mass, rel=facets)
    np.testing.assert_allclose(np.diag(found.inertia), np.diag(exact.inertia), rtol=facets)
    assert exact.inertia[0, 0] > 2.0 * exact.inertia[2, 2]


def test_capsule_without_length_is_a_sphere() -> None:
    sphere, capsule = sphere_mass_properties(0.4), capsule_mass_properties(0.4, 1e-300)
    assert capsule.mass == pytest.approx(sphere.mass, rel=ROUNDING)
    np.testing.assert_allclose(capsule.inertia, sphere.inertia, rtol=ROUNDING)


def test_bunny_agrees_with_trimesh() -> None:
    pymeshfix = pytest.importorskip("pymeshfix", reason="the bunny comes with pymeshfix")
    import trimesh

    path = os.path.join(os.path.dirname(pymeshfix.__file__), "examples", "StanfordBunny.ply")
    scan = trimesh.load_mesh(path)
    vertices, faces = pymeshfix.clean_from_arrays(np.asarray(scan.vertices), np.asarray(scan.faces))
    reference = trimesh.Trimesh(vertices, faces, process=False)
    assert reference.is_watertight
    found = mesh_mass_properties(reference.vertices.astype(np.float64), reference.faces.astype(np.int32))
    rounding = 1e-9  # trimesh sums in another order, about another origin
    assert found.mass == pytest.approx(reference.volume, rel=rounding)
    np.testing.assert_allclose(found.center, reference.center_mass, atol=rounding * reference.scale)
    inertia = reference.moment_inertia
    np.testing.assert_allclose(found.inertia, inertia, atol=rounding * np.abs(inertia).max())
