from collections.abc import Callable

import numpy as np
import pytest

from diffsim import shapes
from diffsim._mass_properties import mesh_mass_properties
from diffsim._mesh import edge_defects, face_components

VOLUMES: list[tuple[Callable[[], shapes.Mesh], float]] = [
    (lambda: shapes.box(), 1.0),
    (lambda: shapes.box((1.0, 2.0, 3.0)), 6.0),
    (lambda: shapes.tetrahedron(2.0), 8.0 / (6.0 * np.sqrt(2.0))),
    (lambda: shapes.icosphere(1.0, 0), 5.0 / 12.0 * (3.0 + np.sqrt(5.0)) * (1.0 / np.sin(2.0 * np.pi / 5.0)) ** 3),
    (lambda: shapes.prism([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]], 0.5), 1.5),
    (lambda: shapes.l_shape(1.0, 0.4, 0.5), (0.4 + 0.4 * 0.6) * 0.5),
    (lambda: shapes.u_channel(1.0, 0.6, 1.5, 0.2), (1.0 * 0.2 + 2 * 0.2 * 0.4) * 1.5),
    (
        lambda: shapes.torus(0.4, 0.15, 16, 8),
        # Pappus for both polygons: the section's area is carried around a 16-gon.
        0.5 * 8 * np.sin(2 * np.pi / 8) * 0.15**2 * 16 * np.sin(2 * np.pi / 16) * 0.4,
    ),
]


@pytest.mark.parametrize(("make", "volume"), VOLUMES)
def test_closed_outward_and_of_the_right_volume(make: Callable[[], shapes.Mesh], volume: float) -> None:
    vertices, faces = make()
    assert vertices.dtype == np.float64
    assert faces.dtype == np.int32
    assert set(faces.ravel()) == set(range(len(vertices)))
    defects = edge_defects(faces)
    assert (defects.open_count, defects.misoriented_count) == (0, 0)
    assert face_components(faces).max() == 0
    assert mesh_mass_properties(vertices, faces).mass == pytest.approx(volume, rel=1e-12)


def test_icosphere_vertices_lie_on_the_sphere() -> None:
    vertices, faces = shapes.icosphere(0.7, 2)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 0.7, rtol=1e-14)
    assert (len(vertices), len(faces)) == (162, 320)


def test_edges_of_the_tetrahedron() -> None:
    vertices, _ = shapes.tetrahedron(0.9)
    distances = np.linalg.norm(vertices[:, None] - vertices[None], axis=-1)[np.triu_indices(4, 1)]
    np.testing.assert_allclose(distances, 0.9, rtol=1e-14)


def test_u_channel_opens_upwards() -> None:
    vertices, _ = shapes.u_channel(1.0, 0.6, 1.5, 0.2)
    np.testing.assert_allclose(vertices.min(axis=0), [-0.5, -0.75, 0.0])
    np.testing.assert_allclose(vertices.max(axis=0), [0.5, 0.75, 0.6])
    assert set(np.abs(vertices[np.isclose(vertices[:, 2], 0.2)][:, 0])) == {0.3}


@pytest.mark.parametrize("outline", [[[0, 0], [0, 1], [1, 0]], [[0, 0], [1, 1], [1, 0], [0, 1]]])
def test_prism_refuses_a_clockwise_or_crossing_outline(outline: list[list[float]]) -> None:
    with pytest.raises(ValueError, match="simple counter-clockwise"):
        shapes.prism(outline, 1.0)
