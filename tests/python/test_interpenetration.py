"""Overlap at the start: touching passes, overlapping does not, and the depth is right."""

import re
from itertools import product

import ipctk
import numpy as np
import pytest

from diffsim import _interpenetration, _surfaces, scenes, shapes
from diffsim._mesh_queries import (
    distance_to_surface,
    point_triangle_distance,
    segment_segment_distance,
    segment_triangle_distance,
    winding_number,
)
from diffsim.rotation import from_matrix, multiply, rotate
from diffsim.scene import PackedScene, Scene

DEPTH_ROUNDING = 1e-12  # absolute, for coordinates of about 1 m


def check(scene: Scene) -> None:
    scene.validate(scene.pack())


def depth_found(scene: Scene) -> float:
    """The depth in the error message, to its six digits; 0 if there is no error."""
    return packed_depth(scene, scene.pack())


def packed_depth(scene: Scene, packed: PackedScene) -> float:
    try:
        scene.validate(packed)
    except ValueError as error:
        return float(re.search(r"interpenetrate at the start, by (?:about )?(\S+) m", str(error)).group(1))
    return 0.0


def random_quaternion(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4)
    return q / np.linalg.norm(q)


def pair(a: tuple, b: tuple, shift: object, turn: np.ndarray | None = None, world: np.ndarray | None = None) -> Scene:
    """Mesh a, and mesh b displaced and turned, all of it then turned by `world`."""
    world = np.array([1.0, 0.0, 0.0, 0.0]) if world is None else world
    turn = np.array([1.0, 0.0, 0.0, 0.0]) if turn is None else turn
    scene = Scene()
    scene.add_body(a, density=1.0, orientation=world, name="a")
    position = rotate(world, np.asarray(shift, dtype=np.float64))
    scene.add_body(b, density=1.0, position=position, orientation=multiply(world, turn), name="b")
    return scene


# ---- Touching ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("turned", [False, True])
def test_packed_cubes_touch_and_pass(turned: bool) -> None:
    rng = np.random.default_rng(0)
    world = random_quaternion(rng) if turned else np.array([1.0, 0.0, 0.0, 0.0])
    scene, edge = Scene(), 0.1  # ten tenths are not one: positions carry rounding
    for cell in product(range(5), repeat=3):
        position = rotate(world, edge * np.array(cell) + np.array([3.0, -7.0, 5.0]))
        scene.add_body(shapes.box(edge), density=1.0, position=position, orientation=world)
    check(scene)


@pytest.mark.parametrize("refined", [False, True])
def test_touching_meshes_pass_the_exact_test_of_triangles(refined: bool) -> None:
    """Without the help of the broad phase: many coplanar triangles that share edges and lie on each other."""
    import trimesh

    mesh = trimesh.Trimesh(*shapes.box(1.0), process=False)
    if refined:
        mesh = mesh.subdivide().subdivide()
    box = (mesh.vertices, mesh.faces)
    rng = np.random.default_rng(1)
    shifts = [(0, 0, 1), (0.5, 0, 1), (0.5, 0.25, 1), (1, 0, 1), (1, 1, 1), (0.3, 0.2, -1), (0, -1, 0.7)]
    for shift in shifts:
        for world in (None, random_quaternion(rng)):
            scene = pair(box, box, shift, world=world)
            packed = scene.pack()
            solids = scene._solids(packed)
            assert len(_surfaces.meeting_faces(*solids)) > 0 or world is not None
            assert _interpenetration._pair_depth(*solids) == 0.0


def test_touching_at_a_corner_and_along_crossed_edges_passes() -> None:
    half_diagonal = np.sqrt(0.5)
    about_x = np.array([np.cos(np.pi / 8), np.sin(np.pi / 8), 0.0, 0.0])
    about_y = np.array([np.cos(np.pi / 8), 0.0, np.sin(np.pi / 8), 0.0])
    box = shapes.box(1.0)
    assert depth_found(pair(box, box, (0.0, 0.0, 0.5 + half_diagonal), about_x)) == 0.0  # edge on face
    for a, b in ((about_x, about_y), (about_y, about_x)):  # edge on edge
        scene = Scene()
        scene.add_body(box, density=1.0, orientation=a)
        scene.add_body(box, density=1.0, orientation=b, position=(0.0, 0.0, 2.0 * half_diagonal))
        check(scene)
    up = np.array([1.0, 1.0, 1.0]) / np.sqrt(3.0)  # corner on face
    axis = np.cross(up, [0.0, 0.0, 1.0])
    x = axis / np.linalg.norm(axis)
    matrix = np.stack([x, np.cross([0.0, 0.0, 1.0], x), [0.0, 0.0, 1.0]], 1) @ np.stack([x, np.cross(up, x), up])
    lowest = np.sqrt(0.75)
    assert depth_found(pair(box, box, (0.1, 0.2, 0.5 + lowest), from_matrix(matrix))) == 0.0
    assert depth_found(pair(box, box, (0.1, 0.2, 0.5 + lowest - 0.01), from_matrix(matrix))) == pytest.approx(0.01)


def test_nearer_than_the_thickness_passes() -> None:
    scene = pair(shapes.box(1.0), shapes.box(1.0), (0.0, 0.0, 1.0 + 1e-6))
    assert scene.pack().thickness > 1e-4
    check(scene)


# ---- Depth ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("depth", [0.3, 1e-2, 1e-4, 1e-6, 1e-8])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.3, 0.2), (0.5, 0.0)])
@pytest.mark.parametrize("turned", [False, True])
def test_sunken_cube(depth: float, shift: tuple[float, float], turned: bool) -> None:
    """Coplanar side faces included, where no two triangles properly cross."""
    world = random_quaternion(np.random.default_rng(2)) if turned else None
    found = depth_found(pair(shapes.box(1.0), shapes.box(1.0), (*shift, 1.0 - depth), world=world))
    assert found == pytest.approx(depth, rel=1e-5, abs=DEPTH_ROUNDING)


@pytest.mark.parametrize("turned", [False, True])
def test_overlap_of_rounding_passes(turned: bool) -> None:
    world = random_quaternion(np.random.default_rng(3)) if turned else None
    assert depth_found(pair(shapes.box(1.0), shapes.box(1.0), (0.3, 0.2, 1.0 - 5e-10), world=world)) == 0.0


@pytest.mark.parametrize("turned", [False, True])
def test_coinciding_bodies(turned: bool) -> None:
    world = random_quaternion(np.random.default_rng(4)) if turned else None
    assert depth_found(pair(shapes.box(1.0), shapes.box(1.0), (0, 0, 0), world=world)) == pytest.approx(1.0)
    for make in (shapes.l_shape, shapes.torus, shapes.u_channel):
        assert depth_found(pair(make(), make(), (0, 0, 0), world=world)) > 0.01


def test_body_wholly_inside_another() -> None:
    inner, outer = shapes.box(0.1), shapes.box(1.0)
    for a, b in ((inner, outer), (outer, inner)):
        assert depth_found(pair(a, b, (0.0, 0.0, 0.2))) == pytest.approx(0.35, abs=0.1)


def test_second_part_of_a_mesh_inside_another() -> None:
    far, near = shapes.box(0.1), shapes.box(0.1)
    two = (np.concatenate([far[0] + [5.0, 0.0, 0.0], near[0]]), np.concatenate([far[1], near[1] + 8]))
    assert depth_found(pair(two, shapes.box(1.0), (0.0, 0.0, 0.0))) > 0.4
    assert depth_found(pair(shapes.box(1.0), two, (0.0, 0.0, 0.0))) > 0.4


def test_crossed_rods_have_no_vertex_in_each_other() -> None:
    a, b = shapes.box((2.0, 0.2, 0.2)), shapes.box((0.2, 2.0, 0.2))
    assert depth_found(pair(a, b, (0.03, 0.02, 0.15))) == pytest.approx(0.05, abs=1e-6)
    assert depth_found(pair(a, b, (0.03, 0.02, 0.0))) > 0.0
    assert depth_found(pair(a, b, (0.03, 0.02, 0.2))) == 0.0


def test_shell_holds_what_its_cavity_has_room_for() -> None:
    outer, inner = shapes.box(1.0), shapes.box(0.8)
    shell = (np.concatenate([outer[0], inner[0]]), np.concatenate([outer[1], inner[1][:, ::-1] + 8]))
    assert depth_found(pair(shell, shapes.box(0.6), (0.1, 0.0, 0.0))) == 0.0  # touches the wall of the cavity
    assert depth_found(pair(shell, shapes.box(0.6), (0.15, 0.0, 0.0))) == pytest.approx(0.05, abs=1e-6)
    scene = Scene()
    scene.add_body(shell, density=1.0)
    scene.add_sphere(0.3, mass=1.0, position=(0.1, 0.0, 0.0))
    check(scene)


# ---- Against closed forms, at random ----------------------------------------------------------------------------


def box_penetration(c_a: np.ndarray, h_a: np.ndarray, R_a: np.ndarray, c_b: object, h_b: object, R_b: object) -> float:
    """Least overlap of two boxes over all separating axes; negative if they are apart."""
    axes = [*R_a.T, *R_b.T, *(np.cross(u, v) for u in R_a.T for v in R_b.T)]
    overlap = np.inf
    for axis in axes:
        length = np.linalg.norm(axis)
        if length > 1e-9:
            n = axis / length
            overlap = min(overlap, np.abs(n @ R_a) @ h_a + np.abs(n @ R_b) @ h_b - abs(n @ (c_b - c_a)))
    return float(overlap)


def boxes_of(shape: str) -> tuple[tuple, list[tuple[np.ndarray, np.ndarray]]]:
    """A mesh, and the boxes (centre, half sides) it is the union of."""
    if shape == "box":
        return shapes.box((1.0, 0.7, 0.4)), [(np.zeros(3), np.array([0.5, 0.35, 0.2]))]
    if shape == "angle":
        legs = [(np.array([0.0, -0.3, 0.0]), np.array([0.5, 0.2, 0.2])), (np.array([-0.3, 0.0, 0.0]), [0.2, 0.5, 0.2])]
        return shapes.l_shape(1.0, 0.4, 0.4), legs
    walls = [(np.array([x, 0.0, 0.3]), np.array([0.1, 0.5, 0.3])) for x in (-0.4, 0.4)]
    return shapes.u_channel(1.0, 0.6, 1.0, 0.2), [*walls, (np.array([0.0, 0.0, 0.1]), np.array([0.5, 0.5, 0.1]))]


@pytest.mark.parametrize(("shape_a", "shape_b"), [("box", "box"), ("angle", "channel"), ("channel", "box")])
def test_random_pairs_agree_with_separating_axes(shape_a: str, shape_b: str) -> None:
    """Non-convex shapes as unions of boxes: overlap is decided, and for boxes the depth known, by a closed form."""
    rng = np.random.default_rng(5)
    (mesh_a, boxes_a), (mesh_b, boxes_b) = boxes_of(shape_a), boxes_of(shape_b)
    hits = misses = 0
    for _ in range(200):
        q, shift = random_quaternion(rng), rng.uniform(-0.8, 0.8, size=3)
        R = rotate(q, np.eye(3)).T
        truth = max(
            box_penetration(c_a, np.asarray(h_a), np.eye(3), R @ c_b + shift, np.asarray(h_b), R)
            for (c_a, h_a), (c_b, h_b) in product(boxes_a, boxes_b)
        )
        found = depth_found(pair(mesh_a, mesh_b, shift, q))
        if truth > 1e-6:
            hits += 1
            assert found > 0.0
            if shape_a == shape_b == "box":
                assert found == pytest.approx(truth, rel=1e-5)
        elif truth < -1e-6:
            misses += 1
            assert found == 0.0
    assert hits >= 50
    assert misses >= 50


def test_linked_rings_and_a_rod_through_a_ring_pass() -> None:
    upright = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    ring = shapes.torus(0.4, 0.1, 32, 16)
    assert depth_found(pair(ring, ring, (0.4, 0.0, 0.0), upright)) == 0.0
    assert depth_found(pair(ring, ring, (0.2, 0.0, 0.0), upright)) == pytest.approx(0.1, abs=0.1)
    assert depth_found(pair(ring, shapes.box((0.1, 0.1, 2.0)), (0.05, 0.0, 0.3))) == 0.0
    assert depth_found(pair(ring, shapes.box((0.1, 0.1, 2.0)), (0.27, 0.0, 0.3))) > 0.0


def test_block_in_the_gap_of_a_channel_touches_three_walls_and_passes() -> None:
    channel, block = shapes.u_channel(1.0, 0.6, 1.0, 0.2), shapes.box((0.6, 0.8, 0.5))
    for world in (None, random_quaternion(np.random.default_rng(6))):
        assert depth_found(pair(channel, block, (0.0, 0.0, 0.45), world=world)) == 0.0
        assert depth_found(pair(channel, block, (0.01, 0.0, 0.45), world=world)) == pytest.approx(0.01, abs=1e-6)
        assert depth_found(pair(channel, block, (0.0, 0.0, 0.44), world=world)) == pytest.approx(0.01, abs=1e-6)


# ---- Spheres, capsules, margins ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("position", "depth"),
    [
        ((0.2, 0.1, 0.6), 0.0),  # touches a face
        ((0.2, 0.1, 0.55), 0.05),
        ((0.2, 0.1, 0.3), 0.3),  # wholly inside: centre 0.2 below the surface
        ((0.5 + 0.1 / np.sqrt(2), 0.0, 0.5 + 0.1 / np.sqrt(2)), 0.0),  # touches an edge
        ((0.5 + 0.04, 0.0, 0.5 + 0.03), 0.05),
        ((0.5 + 0.02, 0.5 + 0.03, 0.5 + 0.06), 0.03),  # a corner
        ((0.5 + 0.06, 0.5 + 0.06, 0.5 + 0.06), 0.0),  # boxes overlap, bodies do not
    ],
)
def test_sphere_and_box(position: tuple[float, float, float], depth: float) -> None:
    scene = Scene()
    scene.add_body(shapes.box(1.0), density=1.0)
    scene.add_sphere(0.1, mass=1.0, position=position)
    assert depth_found(scene) == pytest.approx(depth, rel=1e-5, abs=DEPTH_ROUNDING)


def test_small_box_inside_a_sphere() -> None:
    scene = Scene()
    scene.add_sphere(1.0, mass=1.0)
    scene.add_body(shapes.box(0.2), density=1.0, position=(0.3, 0.0, 0.0))
    assert depth_found(scene) == pytest.approx(0.8)


def test_round_bodies() -> None:
    x_axis = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)  # turns z to x
    for gap, depth in ((0.5, 0.0), (0.4, 0.1), (0.0, 0.5)):
        scene = Scene()
        scene.add_sphere(0.3, mass=1.0)
        scene.add_sphere(0.2, mass=1.0, position=(0.0, 0.0, gap))
        assert depth_found(scene) == pytest.approx(depth, abs=DEPTH_ROUNDING)
        scene = Scene()
        scene.add_capsule(0.3, 1.0, mass=1.0, orientation=x_axis)
        scene.add_sphere(0.2, mass=1.0, position=(0.4, 0.0, gap))
        assert depth_found(scene) == pytest.approx(depth, abs=DEPTH_ROUNDING)
        scene = Scene()
        scene.add_capsule(0.3, 1.0, mass=1.0, orientation=x_axis)
        scene.add_capsule(0.2, 1.0, mass=1.0, position=(0.4, 0.0, gap + 0.5))
        assert depth_found(scene) == pytest.approx(depth, abs=DEPTH_ROUNDING)


def test_capsule_and_box() -> None:
    for height, depth in ((0.5 + 0.1, 0.0), (0.5 + 0.08, 0.02)):
        scene = Scene()
        scene.add_body(shapes.box(1.0), density=1.0)
        x_axis = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
        scene.add_capsule(0.1, 3.0, mass=1.0, orientation=x_axis, position=(0.0, 0.0, height))
        assert depth_found(scene) == pytest.approx(depth, abs=DEPTH_ROUNDING)
    scene = Scene()
    scene.add_body(shapes.box(1.0), density=1.0)
    scene.add_capsule(0.1, 3.0, mass=1.0)  # right through the box, both ends outside
    assert depth_found(scene) == pytest.approx(0.6)


def test_depth_is_the_shortest_way_out_of_convex_bodies_and_about_it_else() -> None:
    cube, ball = shapes.box(1.0), shapes.icosphere(0.5, 2)
    assert depth_found(pair(cube, cube, (0.9, 0.35, 0.4))) == pytest.approx(0.1)
    assert depth_found(pair(cube, cube, (0.9, 0.0, 0.0))) == pytest.approx(0.1)
    assert depth_found(pair(cube, shapes.box(0.1), (0.0, 0.0, 0.2))) == pytest.approx(0.35)
    reach = float(ball[0][:, 0].max())
    assert depth_found(pair(cube, ball, (0.5 + reach - 0.1, 0.2, 0.1))) == pytest.approx(0.1, rel=1e-3)
    for other, words in ((cube, r"by 0\.1 m;"), (shapes.torus(0.5, 0.1), r"by about 0\.\d{1,3} m;")):
        with pytest.raises(ValueError, match=words):
            check(pair(other, cube, (0.9, 0.0, 0.0)))


def test_given_margins_are_part_of_the_body() -> None:
    for gap, depth in ((0.03, 0.0), (0.02, 0.01), (-0.1, 0.13)):
        scene = Scene()
        scene.add_body(shapes.box(1.0), density=1.0, margin=0.01)
        scene.add_body(shapes.torus(1.0, 0.5), density=1.0, margin=0.02, position=(0.0, 0.0, 1.0 + gap), name="ring")
        # The hole of the ring is above the box; sink its lowest edge into the box by moving it sideways.
        packed = scene.pack()
        low = packed.vertices[packed.vertex_count[0] :, 2].min()
        packed.position[1] = (-1.0, 0.0, 0.5 - low + gap)
        assert packed_depth(scene, packed) == pytest.approx(depth, rel=0.2, abs=1e-9)


# ---- Ground, kinds, open meshes ---------------------------------------------------------------------------------


def test_ground() -> None:
    for height, depth in ((0.0, 0.0), (1e-5, 0.0), (-0.01, 0.01)):
        scene = Scene()
        scene.add_ground(height=2.0)
        scene.add_body(shapes.box(1.0), density=1.0, position=(0.0, 0.0, 2.5 + height), name="box")
        assert depth_found(scene) == pytest.approx(depth, abs=DEPTH_ROUNDING)
        scene = Scene()
        scene.add_ground(height=2.0)
        scene.add_sphere(0.3, mass=1.0, position=(0.0, 0.0, 2.3 + height))
        assert depth_found(scene) == pytest.approx(depth, abs=DEPTH_ROUNDING)
    scene.add_body(shapes.box(1.0), kind="static", position=(5.0, 0.0, 0.0))
    scene.add_body(shapes.box(1.0), kind="kinematic", position=(5.0, 0.0, 2.0))
    with pytest.raises(ValueError, match=r"'body_0' and the ground interpenetrate at the start, by 0\.01 m; raise"):
        check(scene)


def test_ground_with_a_margin() -> None:
    scene = Scene()
    scene.add_ground(margin=0.1)
    scene.add_body(shapes.box(1.0), density=1.0, position=(0.0, 0.0, 0.55))
    assert depth_found(scene) == pytest.approx(0.05, abs=DEPTH_ROUNDING)


def test_only_pairs_with_a_dynamic_body_matter() -> None:
    kinds = ("dynamic", "static", "kinematic")
    for a, b in product(kinds, kinds):
        scene = Scene()
        scene.add_body(shapes.box(1.0), density=1.0, kind=a)  # type: ignore[arg-type]
        scene.add_body(shapes.box(1.0), density=1.0, kind=b, position=(0.5, 0.1, 0.2))  # type: ignore[arg-type]
        assert (depth_found(scene) > 0.0) == ("dynamic" in (a, b))


def terrain() -> tuple[np.ndarray, np.ndarray]:
    """An open sheet: z = 0.2 sin x sin y on a grid."""
    count = 21
    x, y = np.meshgrid(np.linspace(-3, 3, count), np.linspace(-3, 3, count), indexing="ij")
    vertices = np.stack([x, y, 0.2 * np.sin(x) * np.sin(y)], axis=-1).reshape(-1, 3)
    index = np.arange(count * count).reshape(count, count)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1).reshape(-1, 4)
    return vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def test_open_terrain() -> None:
    for z, sunk in ((0.8, False), (0.5, True), (-2.0, False)):
        scene = Scene()
        scene.add_body(terrain(), kind="static")
        scene.add_body(shapes.box(1.0), density=1.0, position=(0.1, 0.2, z))
        found = depth_found(scene)
        assert (found > 1e-3) == sunk
        assert found < 1.0


def test_open_sheet_may_lie_on_a_box_but_not_cut_it() -> None:
    sheet = (np.array([[-2.0, -2.0, 0.0], [2.0, -2.0, 0.0], [0.0, 3.0, 0.0]]), np.array([[0, 1, 2]]))
    flipped = (sheet[0], sheet[1][:, ::-1])
    for mesh, z in product((sheet, flipped), (0.5, -0.5)):
        scene = Scene()
        scene.add_body(mesh, kind="static")
        scene.add_body(shapes.box(1.0), density=1.0, position=(0.0, 0.0, z))
        check(scene)
        scene.add_body(shapes.box(0.1), density=1.0, position=(1.0, 0.0, 0.02))
        assert depth_found(scene) == pytest.approx(0.03, abs=0.001)


def test_room_with_inward_faces_holds_bodies() -> None:
    vertices, faces = shapes.box(10.0)
    scene = Scene()
    scene.add_body((vertices, faces[:, ::-1]), kind="static", name="room")
    scene.add_body(shapes.box(1.0), density=1.0, position=(0.0, 0.0, -4.5))  # stands on its floor
    check(scene)
    scene.add_body(shapes.box(1.0), density=1.0, position=(3.0, 0.0, -4.6), name="sunk")
    with pytest.raises(ValueError, match="'room' and body 'sunk'"):
        check(scene)


# ---- Message and cost -------------------------------------------------------------------------------------------


def test_message_names_the_deepest_pair_and_counts_the_others() -> None:
    scene = Scene()
    for index, x in enumerate((0.0, 0.9, 1.7)):
        scene.add_body(shapes.box(1.0), density=1.0, position=(x, 0.0, 0.0), name=f"cube {index}")
    with pytest.raises(ValueError, match=r"body 'cube 1' and body 'cube 2' .* by 0\.2 m \(the deepest of 2 pairs"):
        check(scene)


def test_separated_and_touching_boxes_cost_no_narrow_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> float:
        raise AssertionError("narrow phase entered")

    monkeypatch.setattr(_interpenetration, "_pair_depth", refuse)
    check(scenes.falling_cubes(1000))
    check(scenes.two_layer_stack(200))
    world = random_quaternion(np.random.default_rng(7))
    scene = Scene()
    for cell in product(range(6), repeat=3):
        scene.add_body(shapes.box(1.0), density=1.0, position=rotate(world, np.array(cell) * 1.0), orientation=world)
    check(scene)
    with pytest.raises(AssertionError, match="narrow phase"):
        check(pair(shapes.box(1.0), shapes.box(1.0), (0.0, 0.0, 0.9)))


# ---- Queries ----------------------------------------------------------------------------------------------------


def test_distances_agree_with_ipctk() -> None:
    rng = np.random.default_rng(8)
    for case in range(300):
        a, b, c, p, q = rng.normal(size=(5, 3))
        if case % 3 == 0:
            q = p + 1e-3 * (q - p)
        if case % 3 == 1:  # parallel segments
            q = p + rng.normal() * (b - a)
        triangle = np.array([[a, b, c]])
        point = np.sqrt(ipctk.point_triangle_distance(p, a, b, c))
        assert point_triangle_distance(p, triangle)[0] == pytest.approx(point, rel=1e-9, abs=1e-12)
        edge = np.sqrt(ipctk.edge_edge_distance(a, b, p, q))
        assert segment_segment_distance(a, b, p, q) == pytest.approx(edge, rel=1e-6, abs=1e-9)
        either = min(
            point,
            np.sqrt(ipctk.point_triangle_distance(q, a, b, c)),
            *(np.sqrt(ipctk.edge_edge_distance(p, q, *e)) for e in ((a, b), (b, c), (c, a))),
        )
        normal = np.cross(b - a, c - a)
        if (normal @ (p - a)) * (normal @ (q - a)) < 0.0:
            s = normal @ (p - a) / (normal @ (p - q))
            weights = np.linalg.solve(np.stack([a, b, c], 1), p + s * (q - p))
            either = 0.0 if weights.min() > 0.0 else either
        assert segment_triangle_distance(p, q, triangle)[0] == pytest.approx(either, rel=1e-6, abs=1e-9)


def test_winding_number_of_a_box() -> None:
    vertices, faces = shapes.box(1.0)
    points = np.random.default_rng(9).uniform(-1.0, 1.0, size=(500, 3))
    inside = np.abs(points).max(axis=1) < 0.5
    assert 20 < inside.sum() < 200
    np.testing.assert_allclose(winding_number(points, vertices[faces]), inside, atol=1e-12)
    np.testing.assert_allclose(winding_number(points, vertices[faces][:, ::-1]), -1.0 * inside, atol=1e-12)
    expected = np.where(
        inside, 0.5 - np.abs(points).max(axis=1), np.linalg.norm(np.maximum(np.abs(points) - 0.5, 0), axis=1)
    )
    np.testing.assert_allclose(distance_to_surface(points, vertices[faces]), expected, atol=1e-12)
