"""What a scene accepts as cloth, what it refuses and how it says so, and the arrays it packs."""

import copy
import pickle
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from diffsim import ClothMaterial, Simulator, _cloth_shape, shapes
from diffsim.rotation import from_rpy, rotate, to_matrix
from diffsim.scene import ClothHandle, PackedScene, Scene

SHEET = shapes.sheet((1.0, 0.5), (5, 4))
CUBE = shapes.box(1.0)
NAN = float("nan")


def one_cloth(mesh: Any = SHEET, **arguments: Any) -> PackedScene:
    scene = Scene()
    scene.add_cloth(mesh, **arguments)
    return scene.pack()


# ---- Sheets -----------------------------------------------------------------------------------------------------


def test_sheet_is_a_grid_numbered_row_by_row() -> None:
    vertices, faces = SHEET
    assert vertices.shape == (20, 3)
    assert faces.shape == (24, 3)
    assert (vertices.dtype, faces.dtype) == (np.float64, np.int32)
    np.testing.assert_array_equal(
        vertices[[0, 4, 15, 19], :2], [[-0.5, -0.25], [0.5, -0.25], [-0.5, 0.25], [0.5, 0.25]]
    )
    np.testing.assert_array_equal(vertices[:5, 1], -0.25)
    np.testing.assert_allclose(vertices[2 * 5 + 3], [0.25, 0.25 / 3.0, 0.0], atol=1e-15)
    a, b, c = vertices[faces].transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    np.testing.assert_allclose(0.5 * normal, np.tile([0.0, 0.0, 0.5 / 24], (24, 1)), atol=1e-15)


def test_diagonals_of_a_sheet_alternate() -> None:
    _, faces = shapes.sheet(1.0, 5)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
    step = np.diff(np.unique(edges, axis=0), axis=1).ravel()
    assert np.count_nonzero(step == 6) == np.count_nonzero(step == 4) == 8  # along (1, 1), along (1, -1)
    assert np.count_nonzero(step == 1) == np.count_nonzero(step == 5) == 20


@pytest.mark.parametrize("nodes", [1, (3, 1), 2.5])
def test_sheets_of_no_extent_are_refused(nodes: Any) -> None:
    with pytest.raises(ValueError, match="sheet: nodes must be whole numbers, at least 2 along each side"):
        shapes.sheet(1.0, nodes)
    with pytest.raises(ValueError, match=r"sheet: size must be positive, got \(1.0, 0.0\)"):
        shapes.sheet((1.0, 0.0))


# ---- Packing ----------------------------------------------------------------------------------------------------


def test_packed_arrays_of_two_cloths_and_a_body() -> None:
    scene = Scene()
    first = scene.add_cloth(SHEET, ClothMaterial.denim(), pinned=[4, 0, 4], position=(0, 0, 2), velocity=(1, 2, 3))
    body = scene.add_body(CUBE, density=10.0)
    triangle = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    second = scene.add_cloth(triangle, warp=(0, 2, 0), margin=0.01, position=(5, 0, 0), name="flag")
    scene.add_ground(height=-3.0)
    packed = scene.pack(thickness=0.002)

    assert (packed.names, packed.cloth_names) == (["body_0"], ["cloth_0", "flag"])
    np.testing.assert_array_equal(packed.node_count, [20, 3])
    np.testing.assert_array_equal(packed.triangle_count, [24, 1])
    np.testing.assert_array_equal(packed.triangles, np.concatenate([SHEET[1], [[0, 1, 2]]]))
    np.testing.assert_array_equal(packed.cloth_margin, [0.001, 0.01])
    np.testing.assert_array_equal(packed.warp, [[1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(np.flatnonzero(packed.pinned), [0, 4])
    np.testing.assert_array_equal(packed.node_rest, np.concatenate([SHEET[0], triangle[0]]))
    np.testing.assert_array_equal(packed.node_position[:20], SHEET[0] + [0.0, 0.0, 2.0])
    np.testing.assert_array_equal(packed.node_velocity[[0, 1, 4, 20]], [[0, 0, 0], [1, 2, 3], [0, 0, 0], [0, 0, 0]])
    denim, cotton = ClothMaterial.denim(), ClothMaterial()
    for field in fields(ClothMaterial):
        expected = [getattr(denim, field.name), getattr(cotton, field.name)]
        np.testing.assert_array_equal(getattr(packed, f"cloth_{field.name}"), expected)
    assert packed.friction.shape == packed.restitution.shape == (4,)  # body, two cloths, ground
    assert (first.nodes, second.nodes) == (slice(0, 20), slice(20, 23))
    assert (int(body), int(first), int(second)) == (0, 1, 2)
    for name in ("node_count", "triangle_count", "triangles"):
        assert getattr(packed, name).dtype == np.int32
    assert packed.pinned.dtype == np.uint8
    for field in fields(packed):
        if isinstance(getattr(packed, field.name), np.ndarray):
            assert getattr(packed, field.name).flags.c_contiguous, field.name
    scene.validate(packed)


def test_a_scene_without_cloth_has_empty_arrays_of_it() -> None:
    packed = Scene().pack()
    assert packed.cloth_names == []
    assert packed.node_rest.shape == packed.node_position.shape == packed.triangles.shape == packed.warp.shape == (0, 3)
    assert packed.node_count.shape == packed.cloth_bend.shape == packed.pinned.shape == (0,)


def test_packed_arrays_are_the_callers_own() -> None:
    vertices, faces = (array.copy() for array in SHEET)
    scene = Scene()
    scene.add_cloth((vertices, faces), rest=vertices)
    vertices[:], faces[:] = 7.0, 0
    first = scene.pack()
    np.testing.assert_array_equal(first.node_rest, SHEET[0])
    for field in fields(first):
        if isinstance(getattr(first, field.name), np.ndarray):
            getattr(first, field.name)[...] = 1
    second = scene.pack()
    np.testing.assert_array_equal(second.node_position, SHEET[0])
    np.testing.assert_array_equal(second.node_rest, SHEET[0])
    np.testing.assert_array_equal(second.triangles, SHEET[1])


def test_position_and_orientation_place_the_nodes_but_not_the_rest_shape() -> None:
    q, position = from_rpy(np.array([0.3, -0.7, 1.9])), np.array([5.0, 6.0, 7.0])
    packed = one_cloth(position=position, orientation=2.0 * q)
    np.testing.assert_allclose(packed.node_position, rotate(q, SHEET[0]) + position, atol=1e-14)
    np.testing.assert_array_equal(packed.node_rest, SHEET[0])


def test_rest_shape_apart_from_the_initial_one() -> None:
    packed = one_cloth(rest=0.5 * SHEET[0], warp=torch.tensor([1.0, 1.0, 0.0]))
    np.testing.assert_array_equal(packed.node_rest, 0.5 * SHEET[0])
    np.testing.assert_array_equal(packed.node_position, SHEET[0])
    np.testing.assert_allclose(packed.warp[0], [np.sqrt(0.5), np.sqrt(0.5), 0.0])


@pytest.mark.parametrize("pinned", [[0, 3, 19], np.array([19, 3, 3, 0]), torch.tensor([0, 3, 19]), range(0)])
def test_pinned_nodes_by_index_or_mask(pinned: Any) -> None:
    expected = np.zeros(20, dtype=np.uint8)
    expected[list(pinned)] = 1
    np.testing.assert_array_equal(one_cloth(pinned=pinned).pinned, expected)
    np.testing.assert_array_equal(one_cloth(pinned=expected.astype(bool)).pinned, expected)


@pytest.mark.parametrize("nothing", [None, (), []])
def test_no_pinned_nodes(nothing: Any) -> None:
    np.testing.assert_array_equal(one_cloth(pinned=nothing).pinned, 0)


def test_vertices_of_a_mesh_keep_their_order(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    rng = np.random.default_rng(1)
    order = rng.permutation(20)
    vertices, faces = SHEET[0][order], np.argsort(order)[SHEET[1]].astype(np.int32)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    paths = []
    for suffix in ("obj", "ply", "off"):
        paths.append(tmp_path / f"sheet.{suffix}")
        mesh.export(paths[-1], **({"digits": 17} if suffix != "ply" else {}))
    for source in (mesh, *paths):
        packed = one_cloth(source)
        np.testing.assert_allclose(packed.node_position, vertices, atol=1e-7)
        np.testing.assert_array_equal(packed.triangles, faces)


def test_texture_coordinates_do_not_split_a_cloth(tmp_path: Path) -> None:
    path = tmp_path / "seam.obj"
    corners = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    path.write_text(corners + "f 3/1 4/2 1/3\nf 1/1 2/2 3/4\n")
    packed = one_cloth(path)
    np.testing.assert_array_equal(packed.node_position[:, :2], [[0, 0], [1, 0], [1, 1], [0, 1]])
    np.testing.assert_array_equal(packed.triangles, [[2, 3, 0], [0, 1, 2]])


def test_vertices_repeated_by_a_file_become_one_in_the_order_of_the_file(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "sheet.stl"
    trimesh.Trimesh(*SHEET, process=False).export(path)
    packed = one_cloth(path)
    assert packed.node_count[0] == 20
    flat = SHEET[1].ravel()
    first_use = flat[np.sort(np.unique(flat, return_index=True)[1])]
    np.testing.assert_allclose(packed.node_position, SHEET[0][first_use], atol=1e-7)


def test_default_thickness_follows_a_cloths_width_and_its_triangles() -> None:
    assert one_cloth(shapes.sheet((2.0, 1.0), 5)).thickness == pytest.approx(1e-3)
    assert one_cloth(shapes.sheet((2.0, 1.0), 5), margin=1e-4).thickness == pytest.approx(1e-3)
    fine = one_cloth(shapes.sheet(1.0, 151))
    assert fine.thickness == pytest.approx(0.1 * np.sqrt(0.5) / 150)
    vertices, faces = shapes.sheet((2.0, 1.0), 5)
    ruffled = vertices + 1e-5 * np.random.default_rng(0).normal(size=vertices.shape)
    assert one_cloth((ruffled, faces)).thickness == pytest.approx(1e-3, rel=1e-3)
    assert one_cloth((vertices, faces), rest=1e-3 * vertices).thickness < 1e-4


def test_cloth_thicker_than_its_triangles_is_refused() -> None:
    scene = Scene()
    scene.add_cloth(shapes.sheet(1.0, 11), margin=0.04, name="felt")
    with pytest.raises(ValueError, match=r"cloth 'felt': its smallest triangle is 0.0707 m high, .* 0.08 m thick"):
        scene.pack()
    scene = Scene()
    scene.add_cloth(shapes.sheet(1.0, 11))
    assert scene.pack(thickness=0.07).cloth_margin[0] == 0.035
    with pytest.raises(ValueError, match="give a smaller margin= or thickness=, or a coarser mesh"):
        scene.pack(thickness=0.08)


# ---- Handles ----------------------------------------------------------------------------------------------------


def test_handle_indexes_nodes_cloths_and_objects() -> None:
    scene = Scene()
    scene.add_sphere(0.1, mass=1.0)
    scene.add_cloth(SHEET, position=(0, 0, 3))
    sheet = scene.add_cloth(SHEET, name="sheet")
    assert (sheet.name, sheet.cloth, sheet.nodes, int(sheet)) == ("sheet", 1, slice(20, 40), 2)
    assert repr(sheet) == "ClothHandle(2, 'sheet', nodes 20:40)"
    friction = torch.arange(8.0).reshape(2, 4)
    assert torch.equal(friction[..., int(sheet)], torch.tensor([2.0, 6.0]))
    nodes = torch.arange(120.0).reshape(40, 3)
    assert torch.equal(nodes[..., sheet.nodes, :], nodes[20:])
    scene.add_sphere(0.1, mass=1.0)
    assert int(sheet) == 3  # behind all bodies


def test_handle_of_a_cloth_is_no_index_since_no_tensor_knows_which_axis_is_meant() -> None:
    scene = Scene()
    scene.add_cloth(SHEET, ClothMaterial(bend=1.0))
    sheet = scene.add_cloth(SHEET, ClothMaterial(bend=2.0), position=(0, 0, 3), name="sheet")
    sim, values = Simulator(scene, dt=0.01), np.arange(40.0)
    for tensor in (sim.cloth_bend, sim.friction, sim.initial_state().node_position, values):
        for index in (sheet, (..., sheet), slice(sheet, None)):
            with pytest.raises((IndexError, TypeError)):
                tensor[index]
    with pytest.raises(TypeError, match=r"'sheet'.* is no index: use its \.cloth .* \.nodes .* int\(\)"):
        range(9)[sheet]
    assert sim.cloth_bend[sheet.cloth] == 2.0


def test_handles_pickle_and_copy_with_their_scene() -> None:
    scene = Scene()
    sheet = scene.add_cloth(SHEET, name="sheet")
    scene, sheet = pickle.loads(pickle.dumps((scene, sheet)))
    scene.add_sphere(0.1, mass=1.0)
    assert isinstance(sheet, ClothHandle)
    assert (int(sheet), sheet.nodes, sheet.name) == (1, slice(0, 20), "sheet")
    assert int(copy.deepcopy(sheet)) == 1


def test_repr_counts_cloths() -> None:
    scene = Scene()
    scene.add_cloth(SHEET)
    assert "Scene(0 bodies: none; 1 cloth of 20 nodes; no ground" in repr(scene)
    scene.add_cloth(SHEET)
    assert "2 cloths of 40 nodes" in repr(scene)


# ---- Refusals ---------------------------------------------------------------------------------------------------


def bent(*changes: tuple[int, Any]) -> shapes.Mesh:
    """The sheet with some vertices elsewhere."""
    vertices = SHEET[0].copy()
    for index, place in changes:
        vertices[index] = place
    return vertices, SHEET[1]


THREE_AT_AN_EDGE = (
    np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1]]),
    np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]),
)
DOUBLED = (np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2], [2, 1, 0]]))
UNUSED = (np.concatenate([SHEET[0], [[9.0, 9, 9]]]), SHEET[1])
NEEDLE = (np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1e-8, 0]]), np.array([[0, 1, 2]]))


@pytest.mark.parametrize(
    ("mesh", "arguments", "message"),
    [
        (UNUSED, {}, r"mesh vertex 20 is in no triangle \(1 of 21 vertices\).*remove_unreferenced_vertices"),
        (bent((7, NAN)), {}, r"mesh vertex 7 is not finite"),
        (bent((6, (-0.5, -0.25, 0))), {}, r"mesh face \d+ is degenerate: area 0"),
        (bent((19, SHEET[0][0])), {}, r"mesh vertices 0 and 19 are at the same place, .*merge_vertices"),
        (THREE_AT_AN_EDGE, {}, r"not a sheet: 3 triangles meet at the edge of vertices \[0, 1\] \(1 such edges\)"),
        (DOUBLED, {}, r"mesh triangles 0 and 1 have the same corners, \[0, 1, 2\]; remove one"),
        ((SHEET[0], SHEET[1] + 1), {}, r"mesh face \d+ is out of range: .* with 20 vertices"),
        (NEEDLE, {}, r"mesh face 0 is degenerate: area 5e-09 m², .*give it some height"),
        (SHEET, {"rest": SHEET[0][:-1]}, r"rest must have shape \(20, 3\), got shape \(19, 3\)"),
        (SHEET, {"rest": 0.0 * SHEET[0]}, r"rest shape face 0 is degenerate: area 0"),
        (SHEET, {"rest": NAN * SHEET[0]}, r"rest must be finite"),
        (SHEET, {"warp": (0, 0, 0)}, r"warp must be a direction, got \[0.0, 0.0, 0.0\]"),
        (SHEET, {"warp": (1, 0)}, r"warp must have shape \(3,\), got shape \(2,\)"),
        (SHEET, {"pinned": [3, 20]}, r"pinned node 20 is out of range: the cloth has 20 nodes, 0 to 19"),
        (SHEET, {"pinned": [-1]}, r"pinned node -1 is out of range"),
        (SHEET, {"pinned": [True, False]}, r"pinned must have one boolean per node, 20, got 2"),
        (SHEET, {"position": (0, NAN, 0)}, r"position must be finite"),
        (SHEET, {"orientation": (0, 0, 0, 0)}, r"orientation must be a quaternion"),
        (SHEET, {"velocity": (0, 0)}, r"velocity must have shape \(3,\)"),
        (SHEET, {"margin": 0.0}, r"margin must be positive, got 0 \[m\]"),
        (SHEET, {"friction": -0.5}, r"friction must not be negative"),
    ],
)
def test_wrong_values_are_refused_by_name(mesh: Any, arguments: dict[str, Any], message: str) -> None:
    scene = Scene()
    with pytest.raises(ValueError, match=f"cloth 'flag'.*{message}"):
        scene.add_cloth(mesh, name="flag", **arguments)
    assert scene.pack().cloth_names == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"material": "cotton"}, r"cloth 'cloth_0': material must be a diffsim.ClothMaterial, got str"),
        ({"pinned": [0.5]}, r"cloth 'cloth_0': pinned must be a list of node indices .* got dtype float64"),
        ({"pinned": [[0, 1]]}, r"cloth 'cloth_0': pinned must be a list of node indices .* got shape \(1, 2\)"),
        ({"warp": "x"}, r"cloth 'cloth_0': warp must be numbers of shape \(3,\)"),
        ({"name": 3}, r"cloth 0: name must be a string, got int"),
    ],
)
def test_wrong_types_are_refused_by_name(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(TypeError, match=message):
        Scene().add_cloth(SHEET, **arguments)


def test_names_are_unique_across_bodies_and_cloths() -> None:
    scene = Scene()
    scene.add_sphere(0.1, mass=1.0, name="cloth_0")
    assert scene.add_cloth(SHEET).name == "cloth_1"
    with pytest.raises(ValueError, match="cloth 'cloth_0': the name is already in use"):
        scene.add_cloth(SHEET, name="cloth_0")
    with pytest.raises(ValueError, match="cloth 1: name must not be empty"):
        scene.add_cloth(SHEET, name="")


# ---- Interpenetration -------------------------------------------------------------------------------------------


def scene_with_cube() -> Scene:
    scene = Scene()
    scene.add_body(CUBE, density=100.0, name="cube")
    return scene


def refusal(scene: Scene) -> str:
    with pytest.raises(ValueError, match="at the start") as error:
        scene.validate(scene.pack())
    return str(error.value)


def test_cloth_through_a_body_is_refused() -> None:
    scene = scene_with_cube()
    scene.add_cloth(shapes.sheet(3.0, 11), position=(0.1, 0.05, 0.3), name="sheet")
    assert "body 'cube' and cloth 'sheet' interpenetrate at the start" in refusal(scene)


def test_cloth_inside_a_body_is_refused() -> None:
    scene = scene_with_cube()
    scene.add_cloth(shapes.sheet(0.3, 5), name="sheet")
    assert "body 'cube' and cloth 'sheet' interpenetrate at the start, by about 0.5 m" in refusal(scene)


def test_cloth_in_a_sphere_and_in_the_ground_are_refused() -> None:
    scene = Scene()
    scene.add_sphere(0.5, density=100.0, name="ball")
    scene.add_cloth(shapes.sheet(3.0, 11), position=(0, 0, 0.4), name="sheet")
    assert "body 'ball' and cloth 'sheet' interpenetrate at the start, by about 0.1 m" in refusal(scene)
    scene = Scene()
    scene.add_ground()
    scene.add_cloth(SHEET, position=(0, 0, -0.02), name="sheet")
    assert "cloth 'sheet' and the ground interpenetrate at the start, by 0.02 m; raise 'sheet'" in refusal(scene)


def test_cloths_that_cross_are_refused() -> None:
    scene = Scene()
    scene.add_cloth(SHEET, name="flat")
    scene.add_cloth(SHEET, orientation=from_rpy(np.array([1.2, 0.3, 0.1])), name="steep")
    assert "cloth 'flat' and cloth 'steep' interpenetrate at the start" in refusal(scene)


def test_cloth_that_crosses_itself_is_refused() -> None:
    vertices, faces = shapes.sheet((1.0, 0.2), (21, 3))
    x = vertices[:, 0] * 3.7  # a strip that loops through itself like a ribbon
    loop = np.stack([x**3 - x, vertices[:, 1], x**2], axis=1)
    scene = Scene()
    scene.add_cloth((loop, faces), rest=vertices, name="ribbon")
    message = refusal(scene)
    assert "cloth 'ribbon' crosses itself at the start: triangles " in message
    assert "start from a shape in which it touches itself at most" in message
    scene = Scene()
    sideways = loop + np.array([0.0, 1.0, 0.0]) * x[:, None]  # a helix
    scene.add_cloth((sideways, faces), rest=vertices)
    scene.validate(scene.pack())


def test_corner_folded_through_a_neighbour_is_refused() -> None:
    # Two triangles that share one vertex only, the edge across from it passing through the other.
    vertices = np.array([[0.0, 0, 0], [1, -0.5, 0], [1, 0.5, 0], [0.5, 0, 0.4], [0.5, 0.05, -0.4]])
    scene = Scene()
    scene.add_cloth((vertices, np.array([[0, 1, 2], [0, 3, 4]])), name="bow")
    assert "cloth 'bow' crosses itself at the start: triangles 0 and 1 do;" in refusal(scene)


def test_what_touches_or_surrounds_is_accepted() -> None:
    scene = scene_with_cube()
    scene.add_cloth(shapes.sheet(1.0, 6), position=(0, 0, 0.5))  # lies on the cube
    scene.add_cloth(shapes.sheet(1.0, 6), position=(0.5, 0.5, 0.501))
    scene.add_cloth(shapes.icosphere(3.0, 2))  # a bag around everything
    scene.add_ground(height=-5.0)
    scene.validate(scene.pack())  # raises if it refuses
    scene.add_cloth(shapes.sheet(1.0, 6), position=(0, 0, 0.4), name="deep")  # nearly the same, in the cube
    assert "'deep'" in refusal(scene)
    folded, faces = shapes.sheet((1.0, 0.5), (5, 3))
    folded[folded[:, 0] > 0.2] = folded[folded[:, 0] > 0.2] * [-1.0, 1.0, 1.0] + [0.0, 0.0, 0.01]
    scene = Scene()
    scene.add_cloth((folded, faces))
    scene.validate(scene.pack())


def test_validation_needs_the_arrays_of_the_same_cloths() -> None:
    scene = Scene()
    packed = scene.pack()
    scene.add_cloth(SHEET)
    with pytest.raises(ValueError, match="validate: the packed arrays are of another scene"):
        scene.validate(packed)


# ---- Touching at rest -------------------------------------------------------------------------------------------

# A square whose right half is split at (1, 0.5) and whose left half is not: vertex 6 lies on the edge of 1 and 3.
T_JUNCTION = (
    np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [2, 0, 0], [2, 1, 0], [1, 0.5, 0]], dtype=float),
    np.array([[0, 1, 2], [1, 3, 2], [1, 4, 6], [4, 5, 6], [6, 5, 3]]),
)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_a_t_junction_is_refused_by_vertex_and_edge(dtype: type) -> None:
    vertices, faces = T_JUNCTION
    turn = to_matrix(from_rpy((0.3, 0.4, 0.5)))
    for placed in (vertices, (vertices @ np.asarray(turn).T + [3.0, -2.0, 1.0]).astype(dtype), 1e-3 * vertices):
        with pytest.raises(
            ValueError, match=r"cloth 'flag': mesh vertex 6 lies on the edge of vertices \[1, 3\]"
        ) as raised:
            Scene().add_cloth((placed, faces), name="flag")
        assert "replace triangle 1 by [1, 6, 2] and [6, 3, 2]" in str(raised.value)
    mended = np.concatenate([faces[[0, 2, 3, 4]], [[1, 6, 2], [6, 3, 2]]])
    Scene().add_cloth((vertices, mended))


def test_a_vertex_on_a_face_is_refused_in_the_rest_shape_only() -> None:
    vertices, faces = joined_sheets(0.0)
    with pytest.raises(ValueError, match=r"mesh vertex \d+ lies on triangle \d+ of vertices .* touch itself at rest"):
        Scene().add_cloth((vertices, faces))
    apart = joined_sheets(0.1)[0]
    Scene().add_cloth((vertices, faces), rest=apart)  # touches where it starts, and is moved apart there
    with pytest.raises(ValueError, match=r"rest shape vertex \d+ lies on triangle"):
        Scene().add_cloth((apart, faces), rest=vertices)


def joined_sheets(gap: float) -> shapes.Mesh:
    """A small sheet above a larger one, in one mesh."""
    (below, faces), (above, patch) = shapes.sheet(1.0, 5), shapes.sheet(0.31, 3)
    return np.concatenate([below, above + np.array([0.03, 0.02, gap])]), np.concatenate([faces, patch + len(below)])


def test_sheets_of_any_size_do_not_touch_themselves() -> None:
    for size, nodes in ((1e-3, 20), (1.0, (70, 3)), ((50.0, 1.0), (2, 40))):
        vertices, faces = shapes.sheet(size, nodes)
        assert Scene().add_cloth((vertices, faces)).nodes == slice(0, len(vertices))  # and is not refused
    ball = shapes.icosphere(0.5, 3)
    assert Scene().add_cloth(ball).nodes == slice(0, len(ball[0]))


def test_vertices_on_triangles_are_found_among_triangles_of_all_sizes() -> None:
    rng = np.random.default_rng(3)
    size = 10.0 ** rng.uniform(-3, 0, size=(60, 1, 1))
    corners = rng.uniform(-1, 1, size=(60, 1, 3)) + size * rng.normal(size=(60, 3, 3))
    weights = rng.dirichlet(np.ones(3), size=60)
    on = np.einsum("kw,kwi->ki", weights, corners)[:20]  # a point on each of the first
    others = on[:, None] + 0.1 * rng.normal(size=(20, 2, 3))
    corners = np.concatenate([corners, np.concatenate([on[:, None], others], axis=1)])
    found = _cloth_shape._vertices_on_triangles(corners.reshape(-1, 3), np.arange(240).reshape(-1, 3))
    np.testing.assert_array_equal(found, [180 + 3 * np.arange(20), np.arange(20)])
