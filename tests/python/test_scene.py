"""What a scene accepts, what it refuses and how it says so, and the arrays it packs."""

import copy
import math
import pickle
import re
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
import torch
from small_scenes import CUBE, one_body, open_box

from diffsim import scenes, shapes
from diffsim.rotation import from_rpy, rotate, to_matrix
from diffsim.scene import BodyHandle, Scene

NAN, INF = float("nan"), float("inf")


"""What a scene accepts, what it refuses and how it says so, and the arrays it packs."""


# ---- Packing ----------------------------------------------------------------------------------------------------


def test_an_empty_scene_packs() -> None:
    packed = Scene().pack()
    assert packed.names == []
    assert packed.vertices.shape == packed.faces.shape == packed.position.shape == (0, 3)
    assert packed.orientation.shape == (0, 4)
    assert packed.inertia.shape == (0, 3, 3)
    assert (packed.has_ground, packed.ground_height, packed.ground_margin) == (False, 0.0, 0.0)
    assert packed.thickness == 1e-3
    np.testing.assert_array_equal(packed.gravity, [0.0, 0.0, -9.81])
    Scene().validate(packed)


def test_packed_arrays_of_a_mixed_scene() -> None:
    scene = Scene(gravity=(0.1, 0.2, -9.0))
    scene.add_body(CUBE, density=10.0, position=(0, 0, 2), velocity=(1, 2, 3), angular_velocity=(4, 5, 6), name="cube")
    scene.add_body(shapes.tetrahedron(), kind="static", position=(3, 0, 0))
    scene.add_sphere(0.25, density=100.0, position=(0, 3, 1))
    scene.add_capsule(0.1, 0.6, mass=2.0, position=(0, -3, 1))
    scene.add_body(open_box(), kind="kinematic", velocity=(1, 0, 0), position=(-3, 0, 0), margin=0.02)
    scene.add_ground(height=-1.0, margin=0.05)
    packed = scene.pack(thickness=0.01)

    assert packed.names == ["cube", "body_1", "body_2", "body_3", "body_4"]
    np.testing.assert_array_equal(packed.kind, [0, 1, 0, 0, 2])
    np.testing.assert_array_equal(packed.margin, [0.005, 0.005, 0.25, 0.1, 0.02])
    np.testing.assert_array_equal(packed.vertex_count, [8, 4, 1, 2, 8])
    np.testing.assert_array_equal(packed.face_count, [12, 4, 0, 0, 10])
    assert len(packed.vertices) == 23
    assert len(packed.faces) == 26
    assert packed.faces[12:16].max() == 3  # local to the body
    np.testing.assert_array_equal(packed.vertices[13:15], [[0, 0, -0.3], [0, 0, 0.3]])
    np.testing.assert_array_equal(packed.position[0], [0, 0, 2])
    np.testing.assert_array_equal(packed.velocity[:, 0], [1, 0, 0, 0, 1])
    np.testing.assert_array_equal(packed.angular_velocity[0], [4, 5, 6])
    sphere = 100.0 * 4.0 / 3.0 * math.pi * 0.25**3
    np.testing.assert_allclose(packed.mass, [10.0, 0.0, sphere, 2.0, 0.0], rtol=1e-14)
    np.testing.assert_allclose(packed.inertia[0], 10.0 / 6.0 * np.eye(3), atol=1e-14)
    np.testing.assert_allclose(packed.inertia[2], 0.4 * sphere * 0.25**2 * np.eye(3), rtol=1e-14)
    assert not packed.inertia[[1, 4]].any()
    assert packed.friction.shape == packed.restitution.shape == (6,)
    np.testing.assert_array_equal(packed.gravity, [0.1, 0.2, -9.0])
    assert (packed.has_ground, packed.ground_height, packed.ground_margin) == (True, -1.0, 0.05)
    assert packed.thickness == 0.01
    expected = {"kind": np.int32, "vertex_count": np.int32, "face_count": np.int32, "faces": np.int32}
    expected |= {"node_count": np.int32, "triangle_count": np.int32, "triangles": np.int32, "pinned": np.uint8}
    for field in fields(packed):
        value = getattr(packed, field.name)
        if isinstance(value, np.ndarray):
            assert value.dtype == expected.get(field.name, np.float64), field.name
            assert value.flags.c_contiguous, field.name
    scene.validate(packed)
    copied = pickle.loads(pickle.dumps(packed))
    np.testing.assert_array_equal(copied.vertices, packed.vertices)


def test_position_places_the_mesh_and_state_speaks_of_the_centre_of_mass() -> None:
    vertices, faces = shapes.l_shape()
    vertices += np.array([2.0, -1.0, 0.5])
    q, position = from_rpy(np.array([0.3, -0.7, 1.9])), np.array([5.0, 6.0, 7.0])
    packed = one_body(mesh=(vertices, faces), position=position, orientation=q)
    np.testing.assert_allclose(packed.position[0], position + rotate(q, packed.mesh_offset[0]), rtol=1e-14)
    world = rotate(packed.orientation[0], packed.vertices) + packed.position[0]
    np.testing.assert_allclose(world, rotate(q, vertices) + position, atol=1e-14)
    second = one_body(mesh=(vertices - packed.mesh_offset[0], faces))
    np.testing.assert_allclose(second.mesh_offset, 0.0, atol=1e-14)
    np.testing.assert_allclose(second.inertia, packed.inertia, atol=1e-12)


def test_packed_arrays_are_the_callers_own() -> None:
    scene = scenes.falling_cubes(2)
    first = scene.pack()
    for field in fields(first):
        value = getattr(first, field.name)
        if isinstance(value, np.ndarray):
            value[...] = 1
    assert scene.pack().gravity[2] == -9.81
    assert scene.pack().position[0, 2] == 1.0
    assert scene.pack().vertices.min() == -0.5


def test_orientation_is_normalised() -> None:
    packed = one_body(orientation=(1.0001, 0.0, 0.0, 0.0))
    np.testing.assert_array_equal(packed.orientation[0], [1.0, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(to_matrix(one_body(orientation=(2, 0, 0, 2)).orientation[0])[0], [0, -1, 0], atol=1e-15)


def test_default_thickness_of_an_object_is_a_thousandth_of_its_smallest_extent() -> None:
    assert one_body().thickness == pytest.approx(1e-3)
    assert one_body(mesh=shapes.box((2.0, 0.05, 1.0))).thickness == pytest.approx(5e-5)
    assert one_body(mesh=shapes.box((2.0, 0.05, 1.0)), margin=0.1).thickness == pytest.approx(2.5e-4)
    scene = Scene()
    scene.add_ground()
    scene.add_body(CUBE, density=1.0)
    scene.add_sphere(0.1, density=1.0, position=(2.0, 0.0, 0.0))
    scene.add_capsule(0.05, 3.0, density=1.0, position=(4.0, 0.0, 0.0))
    scene.add_cloth(shapes.sheet((2.0, 0.5), 3), position=(0.0, 0.0, 2.0))
    packed = scene.pack()
    np.testing.assert_allclose(packed.object_thickness, [1e-3, 2e-4, 1e-4, 5e-4], rtol=1e-12)
    np.testing.assert_allclose(packed.margin, [5e-4, 0.1, 0.05], rtol=1e-12)
    np.testing.assert_allclose(packed.cloth_margin, [2.5e-4], rtol=1e-12)
    assert packed.thickness == packed.object_thickness.max()
    assert packed.ground_margin is None  # half of that of what meets it
    packed = scene.pack(thickness=2e-3)
    assert packed.object_thickness.tolist() == [2e-3] * 4
    assert packed.ground_margin == 1e-3


@pytest.mark.parametrize("noise", [0.0, 1e-10, 1e-8, 1e-5, 1e-2])
def test_thickness_of_a_flat_static_mesh_does_not_follow_its_noise(noise: float) -> None:
    flat = (np.array([[0.0, 0, 0], [4, 0, 0], [4, 2, noise], [0, 2, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    assert one_body(mesh=flat, kind="static").thickness == pytest.approx(2e-3)


def test_thickness_of_a_closed_mesh_that_is_flat_up_to_rounding_is_not_that_rounding() -> None:
    slab = shapes.box((4.0, 2.0, 1e-7))
    assert one_body(mesh=slab, kind="static").thickness == pytest.approx(2e-3)
    card = shapes.box((4.0, 2.0, 1e-4))
    assert one_body(mesh=card, kind="static").thickness == pytest.approx(1e-7)


def test_a_landscape_is_not_thicker_than_what_moves_over_it() -> None:
    scene = Scene()
    scene.add_body(shapes.box(100.0), kind="static")
    scene.add_body(CUBE, density=1.0, position=(0.0, 0.0, 51.0))
    scene.add_sphere(0.05, density=1.0, position=(3.0, 0.0, 51.0))
    np.testing.assert_allclose(scene.pack().object_thickness, [1e-3, 1e-3, 1e-4], rtol=1e-12)


# ---- Handles ----------------------------------------------------------------------------------------------------


def test_handle_is_an_index_with_a_name() -> None:
    scene = Scene()
    first, second = scene.add_body(CUBE, density=1.0), scene.add_sphere(0.1, mass=1.0, name="ball")
    assert (first, second) == (0, 1)
    assert (first.name, second.name) == ("body_0", "ball")
    assert repr(second) == "BodyHandle(1, 'ball')"
    position = torch.arange(24.0).reshape(4, 2, 3)
    assert torch.equal(position[..., second, :], position[:, 1])
    assert np.arange(6).reshape(2, 3)[second, 0] == 3
    for copied in (pickle.loads(pickle.dumps(second)), copy.deepcopy(second)):
        assert isinstance(copied, BodyHandle)
        assert (copied, copied.name) == (1, "ball")


def test_made_up_names_avoid_given_ones() -> None:
    scene = Scene()
    scene.add_sphere(0.1, mass=1.0, name="body_1")
    assert scene.add_sphere(0.1, mass=1.0).name == "body_2"


def test_failed_add_leaves_the_scene_as_it_was() -> None:
    scene = Scene()
    with pytest.raises(ValueError, match="position"):
        scene.add_body(CUBE, density=1.0, position=(0, 0, NAN), name="cube")
    assert scene.add_body(CUBE, density=1.0, name="cube") == 0


def test_scene_copies_pickles_and_prints() -> None:
    scene = scenes.box_on_box()
    for copied in (copy.deepcopy(scene), pickle.loads(pickle.dumps(scene))):
        np.testing.assert_array_equal(copied.pack().position, scene.pack().position)
        copied.add_sphere(0.1, mass=1.0)
    assert len(scene.pack().names) == 2
    expected = "Scene(2 bodies: 1 dynamic, 1 static; ground at 0 m; gravity (0.0, 0.0, -9.81) m/s²)"
    assert repr(scene) == expected


# ---- Mass -------------------------------------------------------------------------------------------------------


def test_mass_scales_a_uniform_density() -> None:
    by_density, by_mass = one_body(mesh=shapes.l_shape(), density=500.0), Scene()
    by_mass.add_body(shapes.l_shape(), mass=3.0)
    packed = by_mass.pack()
    assert packed.mass[0] == 3.0
    np.testing.assert_allclose(packed.inertia[0] / 3.0, by_density.inertia[0] / by_density.mass[0], rtol=1e-14)


def test_given_inertia_replaces_that_of_the_mesh() -> None:
    inertia = np.array([[2.0, 0.1, 0.0], [0.1, 3.0, 0.2], [0.0, 0.2, 4.0]])
    for arguments in ({"mass": 2.0, "density": None}, {"density": 2.0}):
        packed = one_body(mesh=shapes.l_shape(), inertia=inertia, **arguments)
        np.testing.assert_array_equal(packed.inertia[0], inertia)
        assert packed.mesh_offset[0].any()
    scene = Scene()
    scene.add_sphere(0.1, mass=1.0, inertia=0.01 * np.eye(3))  # hollow
    np.testing.assert_array_equal(scene.pack().inertia[0], 0.01 * np.eye(3))


def test_open_mesh_with_mass_and_inertia_has_its_origin_as_centre_of_mass() -> None:
    vertices, faces = open_box()
    packed = one_body(mesh=(vertices + 1.0, faces), density=None, mass=2.0, inertia=np.eye(3))
    assert packed.mass[0] == 2.0
    np.testing.assert_array_equal(packed.mesh_offset, 0.0)
    np.testing.assert_array_equal(packed.vertices, vertices + 1.0)


def test_inward_faces_are_turned_around() -> None:
    vertices, faces = shapes.l_shape()
    inwards, outwards = one_body(mesh=(vertices, faces[:, ::-1])), one_body(mesh=(vertices, faces))
    np.testing.assert_allclose(inwards.mass, outwards.mass)
    np.testing.assert_allclose(inwards.inertia, outwards.inertia, atol=1e-12)
    np.testing.assert_array_equal(inwards.faces, faces[:, ::-1][:, ::-1])


def test_static_and_kinematic_bodies_need_no_mass_and_may_be_open() -> None:
    for kind in ("static", "kinematic"):
        for mesh in (CUBE, open_box(), (CUBE[0], CUBE[1][:, ::-1])):
            packed = one_body(mesh=mesh, density=None, kind=kind)
            assert packed.mass[0] == 0.0
            assert not packed.inertia.any()
    room = one_body(mesh=(CUBE[0], CUBE[1][:, ::-1]), kind="static")
    np.testing.assert_array_equal(room.faces, CUBE[1][:, ::-1])  # stays a room


# ---- Values -----------------------------------------------------------------------------------------------------

BAD_VALUES: list[tuple[dict[str, Any], type[Exception], str]] = [
    ({"density": 0.0}, ValueError, r"density must be positive, got 0 \[kg/m³\]"),
    ({"density": -1.0}, ValueError, "density must be positive, got -1"),
    ({"density": NAN}, ValueError, "density must be finite, got nan"),
    ({"density": "heavy"}, TypeError, "density must be a number, got 'heavy'"),
    ({"density": None}, ValueError, r"needs density= \[kg/m³\] or mass= \[kg\]; or give kind='static'"),
    ({"mass": 1.0}, ValueError, "density= or mass=, not both"),
    ({"density": None, "mass": -2.0}, ValueError, r"mass must be positive, got -2 \[kg\]"),
    ({"density": None, "mass": True}, TypeError, "mass must be a number, got True"),
    ({"density": None, "inertia": np.eye(3)}, ValueError, "needs density="),
    ({"inertia": np.eye(2)}, ValueError, r"inertia must have shape \(3, 3\), got shape \(2, 2\)"),
    ({"inertia": np.diag([1.0, 1.0, -1.0])}, ValueError, "inertia must be positive definite.*moment -1"),
    ({"inertia": np.diag([1.0, 1.0, 0.0])}, ValueError, "inertia must be positive definite"),
    ({"inertia": [[1, 0.5, 0], [0, 1, 0], [0, 0, 1]]}, ValueError, "inertia must be symmetric"),
    ({"inertia": np.full((3, 3), NAN)}, ValueError, "inertia must be finite"),
    ({"margin": 0.0}, ValueError, r"margin must be positive, got 0 \[m\]"),
    ({"margin": -0.1}, ValueError, "margin must be positive"),
    ({"position": (0, 0)}, ValueError, r"position must have shape \(3,\), got shape \(2,\)"),
    ({"position": (0, 0, INF)}, ValueError, r"position must be finite, got \[0.0, 0.0, inf\]"),
    ({"position": "here"}, TypeError, "position must be numbers"),
    ({"position": [1, [2], 3]}, ValueError, "position"),
    ({"position": torch.zeros(3, requires_grad=True)}, ValueError, r"position: .*requires grad.*detach\(\)"),
    ({"orientation": (0, 0, 0, 0)}, ValueError, r"orientation must be a quaternion \(w, x, y, z\) other than zero"),
    ({"orientation": (0, 0, 0)}, ValueError, r"orientation must have shape \(4,\)"),
    ({"orientation": (NAN, 0, 0, 0)}, ValueError, "orientation must be finite"),
    ({"velocity": (NAN, 0, 0)}, ValueError, "velocity must be finite"),
    ({"angular_velocity": np.zeros((1, 3))}, ValueError, r"angular_velocity must have shape \(3,\)"),
    ({"kind": "Dynamic"}, ValueError, "kind must be one of 'dynamic', 'static', 'kinematic', got 'Dynamic'"),
    ({"kind": 1}, ValueError, "kind must be one of"),
    ({"kind": "static", "velocity": (1, 0, 0)}, ValueError, "velocity must be zero for a static body.*'kinematic'"),
    ({"kind": "static", "density": -1.0}, ValueError, "density must be positive"),
    ({"friction": -0.5}, ValueError, "friction must not be negative"),
    ({"friction": NAN}, ValueError, "friction must be finite"),
    ({"friction": INF}, ValueError, "friction must be finite"),
    ({"restitution": 0.5}, NotImplementedError, "restitution=0.5 is not implemented yet"),
    ({"restitution": 1.5}, ValueError, "restitution must lie between 0 and 1"),
]


@pytest.mark.parametrize(("arguments", "error", "message"), BAD_VALUES)
def test_bad_values_are_refused_by_name(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    given = {"density": 1000.0, **arguments}
    for add in (lambda scene: scene.add_body(CUBE, name="thing", **given), _add_sphere(given)):
        if add is not None:
            scene = Scene()
            with pytest.raises(error, match=message) as raised:
                add(scene)
            assert str(raised.value).startswith("body 'thing': ")
            assert scene.pack().names == []


def _add_sphere(given: dict[str, Any]) -> Any:
    return None if "margin" in given else lambda scene: scene.add_sphere(0.5, name="thing", **given)


@pytest.mark.parametrize("radius", [0.0, -1.0, NAN, "big", None])
def test_bad_radius_and_length(radius: Any) -> None:
    for add in (
        lambda scene: scene.add_sphere(radius, mass=1.0, name="thing"),
        lambda scene: scene.add_capsule(radius, 1.0, mass=1.0, name="thing"),
        lambda scene: scene.add_capsule(1.0, radius, mass=1.0, name="thing"),
    ):
        with pytest.raises((ValueError, TypeError), match=r"body 'thing': (radius|length) must be"):
            add(Scene())


def test_bad_names() -> None:
    scene = Scene()
    scene.add_body(CUBE, density=1.0, name="cube")
    with pytest.raises(ValueError, match="body 'cube': the name is already in use"):
        scene.add_sphere(1.0, mass=1.0, name="cube")
    with pytest.raises(ValueError, match="body 1: name must not be empty"):
        scene.add_sphere(1.0, mass=1.0, name="")
    with pytest.raises(TypeError, match="body 1: name must be a string, got int"):
        scene.add_sphere(1.0, mass=1.0, name=3)  # type: ignore[arg-type]


def test_bad_gravity_ground_and_thickness() -> None:
    with pytest.raises(ValueError, match="Scene: gravity must be finite"):
        Scene(gravity=(0.0, 0.0, NAN))
    with pytest.raises(ValueError, match=r"Scene: gravity must have shape \(3,\), got shape \(\)"):
        Scene(gravity=-9.81)
    scene = Scene()
    with pytest.raises(ValueError, match="ground: height must be finite"):
        scene.add_ground(height=INF)
    with pytest.raises(ValueError, match="ground: margin must be positive"):
        scene.add_ground(margin=-1.0)
    with pytest.raises(ValueError, match=r"ground: friction must not be negative, got -0\.3"):
        scene.add_ground(friction=-0.3)
    scene.add_ground(height=1.5)
    with pytest.raises(ValueError, match=re.escape("already has a ground, at height 1.5 m")):
        scene.add_ground()
    for thickness in (0.0, -1e-3, NAN):
        with pytest.raises(ValueError, match="thickness must be"):
            scene.pack(thickness)


def test_validate_refuses_the_arrays_of_another_scene() -> None:
    scene = scenes.falling_cubes(2)
    packed = scene.pack()
    scene.add_sphere(0.1, mass=1.0)
    with pytest.raises(ValueError, match="another scene, or objects were added"):
        scene.validate(packed)


# ---- Shared scenes ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", scenes.__all__)
def test_shared_scenes_start_free_of_overlap(name: str) -> None:
    scene = getattr(scenes, name)()
    packed = scene.pack()
    assert packed.kind.tolist().count(0) >= 1
    scene.validate(packed)


def test_shared_scenes_take_their_size() -> None:
    assert len(scenes.falling_cubes(7).pack().names) == 7
    assert len(scenes.row_of_cubes(7).pack().names) == 7
    assert len(scenes.two_layer_stack(7).pack().names) == 13
    assert len(scenes.collapsing_stack(7).pack().names) == 7
    assert len(scenes.boxes_in_bin(7).pack().names) == 7 + 4
    assert len(scenes.tumbling_layers(3, layers=2).pack().names) == 18
    assert len(scenes.heap_of_boxes_and_balls(7).pack().names) == 7
    assert len(scenes.touching_boxes(7).pack().names) == 7
    assert scenes.falling_cubes(1).pack().vertices.shape == (8, 3)
    free = scenes.box_on_box(fixed=False)
    free.validate(free.pack())
