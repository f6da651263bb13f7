"""Which meshes a scene accepts: files, arrays, open and closed ones; and how it refuses the others."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_scenes import CUBE, one_body, open_box

from diffsim import shapes
from diffsim.scene import Scene

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize("suffix", ["stl", "ply", "obj", "off", "glb"])
def test_files_are_read_with_vertices_merged(tmp_path: Path, suffix: str) -> None:
    import trimesh

    path = tmp_path / f"angle.{suffix}"
    trimesh.Trimesh(*shapes.l_shape(), process=False).export(path)
    for mesh in (path, str(path)):
        packed = one_body(mesh=mesh)
        assert (packed.vertex_count[0], packed.face_count[0]) == (12, 20)
        assert packed.mass[0] == pytest.approx(256.0, rel=1e-6)  # formats with single precision


def test_geometries_of_a_file_become_one_mesh(tmp_path: Path) -> None:
    import trimesh

    parts = [trimesh.Trimesh(*CUBE, process=False) for _ in range(2)]
    parts[1].apply_translation((3.0, 0.0, 0.0))
    path = tmp_path / "two.glb"
    trimesh.Scene(parts).export(path)
    packed = one_body(mesh=path)
    assert packed.vertex_count[0] == 16
    assert packed.mass[0] == pytest.approx(2000.0)
    np.testing.assert_allclose(np.sort(np.ptp(packed.vertices, axis=0)), [1.0, 1.0, 4.0])


def test_tiny_meshes_survive_a_file(tmp_path: Path) -> None:
    import trimesh

    path = tmp_path / "micro.ply"
    trimesh.Trimesh(*shapes.icosphere(1e-7, 2), process=False).export(path)
    assert one_body(mesh=path).vertex_count[0] == 162


def test_trimesh_objects_and_arrays() -> None:
    import trimesh

    mesh = trimesh.Trimesh(*CUBE, process=False)
    lists = (CUBE[0].tolist(), CUBE[1].tolist())
    tensors = (torch.from_numpy(CUBE[0]), torch.from_numpy(CUBE[1]).long())
    for given in (mesh, trimesh.Scene([mesh]), lists, tensors, list(CUBE)):
        assert one_body(mesh=given).mass[0] == pytest.approx(1000.0)


def test_unused_vertices_are_dropped() -> None:
    vertices = np.concatenate([[[9.0, 9.0, 9.0]], CUBE[0], [[7.0, 7.0, 7.0]]])
    packed = one_body(mesh=(vertices, CUBE[1] + 1))
    np.testing.assert_array_equal(packed.vertices, CUBE[0])
    np.testing.assert_array_equal(packed.faces, CUBE[1])


def test_mesh_is_copied() -> None:
    vertices, faces = CUBE[0].copy(), CUBE[1].copy()
    scene = Scene()
    scene.add_body((vertices, faces), density=1.0)
    vertices += 1.0
    faces[:] = 0
    np.testing.assert_array_equal(scene.pack().vertices, CUBE[0])
    np.testing.assert_array_equal(scene.pack().faces, CUBE[1])


def changed(vertices: Any = None, faces: Any = None, **at: Any) -> tuple[Any, Any]:
    """The cube with one vertex or face changed."""
    v, f = CUBE[0].copy(), CUBE[1].copy()
    if vertices is not None:
        v[at["row"]] = vertices
    if faces is not None:
        f[at["row"]] = faces
    return v, f


# A face without area beside a closed cube, and a part that points inwards beside one that does not.
SLIVER = (np.concatenate([CUBE[0], [[2, 0, 0], [3, 0, 0], [4, 0, 0]]]), np.concatenate([CUBE[1], [[8, 9, 10]]]))
HALF_INWARD = (
    np.concatenate([CUBE[0], 0.5 * CUBE[0] + [2.0, 0.0, 0.0]]),
    np.concatenate([CUBE[1], CUBE[1][:, ::-1] + 8]),
)
FLAT_CLOSED = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 1]]))

BAD_MESHES: list[tuple[Any, type[Exception], str]] = [
    (open_box(), ValueError, r"the mesh is open \(6 boundary edges\).*fill_holes.*inertia=.*static"),
    (changed(faces=CUBE[1][3][::-1], row=3), ValueError, r"not consistently oriented \(3 edges.*fix_normals"),
    (changed(vertices=[0.0, NAN, 0.0], row=3), ValueError, r"vertex 3 is not finite: \[0\.0, nan, 0\.0\]"),
    (changed(vertices=[INF, 0.0, 0.0], row=0), ValueError, r"vertex 0 is not finite"),
    (changed(faces=[0, 1, 8], row=5), ValueError, r"face 5 is out of range: \[0, 1, 8\] with 8 vertices"),
    (changed(faces=[0, 1, -1], row=5), ValueError, r"face 5 is out of range"),
    (changed(faces=[0, 1, 1], row=5), ValueError, r"face 5 is degenerate: it repeats a vertex, \[0, 1, 1\]"),
    (SLIVER, ValueError, r"face 12 is degenerate: area 0 m².*nondegenerate_faces"),
    (changed(vertices=CUBE[0][1], row=0), ValueError, "degenerate"),
    (HALF_INWARD, ValueError, "part 1 of the mesh points inwards but is no cavity"),
    (FLAT_CLOSED, ValueError, "encloses no volume"),
    ((CUBE[0][:, :2], CUBE[1]), ValueError, r"vertices must have shape \(n, 3\), got \(8, 2\)"),
    ((CUBE[0], CUBE[1].reshape(-1, 4)), ValueError, r"faces must be triangles, shape \(m, 3\).*got \(9, 4\)"),
    ((CUBE[0], CUBE[1][:0]), ValueError, "faces must be triangles"),
    ((CUBE[0], CUBE[1].astype(float)), TypeError, "faces must be integers, got dtype float64"),
    ((CUBE[0].astype(str), CUBE[1]), TypeError, "vertices must be numbers"),
    (CUBE[0], TypeError, r"mesh must be a path, a trimesh.Trimesh or \(vertices, faces\), got ndarray"),
    (None, TypeError, "got NoneType"),
    ("no/such/file.stl", FileNotFoundError, "no/such/file.stl"),
]


@pytest.mark.parametrize(("mesh", "error", "message"), BAD_MESHES)
def test_bad_meshes_are_refused_by_name(mesh: Any, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message) as raised:
        Scene().add_body(mesh, density=1000.0, name="thing")
    assert str(raised.value).startswith("body 'thing': ")


def test_cavity_is_no_part_that_points_inwards() -> None:
    vertices = np.concatenate([CUBE[0], 0.5 * CUBE[0]])
    faces = np.concatenate([CUBE[1], CUBE[1][:, ::-1] + 8])
    assert one_body(mesh=(vertices, faces)).mass[0] == pytest.approx(875.0)
    assert one_body(mesh=(vertices, faces[:, ::-1])).mass[0] == pytest.approx(875.0)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("mesh.xyzq", "hello", r"body 'x': mesh file .*mesh\.xyzq could not be read: .*xyzq"),
        ("mesh.obj", "v 0 0 0\nv 1 0 0\n", r"body 'x': mesh file .*mesh\.obj has no faces"),
        ("mesh.stl", "", r"body 'x': mesh file .*mesh\.stl has no faces"),
    ],
)
def test_files_that_are_no_mesh_are_refused_by_name(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=message):
        Scene().add_body(tmp_path / name, density=1.0, name="x")
