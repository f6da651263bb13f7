"""Slips of units are told once per scene, `scale` mends them, and cloth too small to be resolved is refused."""

import copy
import pickle
import warnings
from typing import Any

import numpy as np
import pytest

import diffsim as ds

CUBE = ds.shapes.box(1.0)
SHEET = ds.shapes.sheet(1.0, 4)


def told(add: Any) -> list[str]:
    """What is warned of while objects are added to a scene."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        add(ds.Scene())
    assert all(w.category is ds.UnitsWarning and w.filename == __file__ for w in caught)
    return [str(w.message) for w in caught]


# ---- warnings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("add", "text"),
    [
        (lambda s: s.add_body(ds.shapes.box(101.0), density=1e3, name="x"), "body 'x': it is 101 m long"),
        (lambda s: s.add_body(ds.shapes.box(9e-5), density=1e3, name="x"), "body 'x': it is only 9e-05 m long"),
        (lambda s: s.add_body(CUBE, density=4.9, name="x"), "body 'x': its density is 4.9 kg/m³"),
        (lambda s: s.add_body(CUBE, mass=4.9, name="x"), "body 'x': its density is 4.9 kg/m³"),
        (lambda s: s.add_cloth(ds.shapes.sheet((1.0, 101.0), 3), name="x"), "cloth 'x': it is 101 m long"),
        (lambda s: s.add_cloth(ds.shapes.sheet(9e-5, 3), name="x"), "cloth 'x': it is only 9e-05 m long"),
    ],
)
def test_slips_of_units_are_told_with_the_mend(add: Any, text: str) -> None:
    (message,) = told(add)
    assert text in message
    assert "give scale=" in message
    assert "0.001 for millimetres" in message


def test_round_bodies_are_told_without_a_scale_they_do_not_take() -> None:
    for add in (
        lambda s: s.add_sphere(51.0, density=1e3),
        lambda s: s.add_capsule(1e-5, 2e-5, density=1e3),
        lambda s: s.add_sphere(1.0, density=1.2),
    ):
        (message,) = told(add)
        assert "scale" not in message


def test_a_scene_tells_once() -> None:
    def add(scene: ds.Scene) -> None:
        for k in range(3):
            scene.add_body(CUBE, density=1.0, position=(2 * k, 0, 0))
        scene.add_cloth(ds.shapes.sheet(200.0, 3))
        copy.deepcopy(scene).add_body(CUBE, density=1.0)

    assert len(told(add)) == 1


def test_what_is_common_is_not_told() -> None:
    def add(scene: ds.Scene) -> None:
        scene.add_ground()
        scene.add_body(ds.shapes.box((200.0, 200.0, 1.0)), kind="static", position=(0, 0, -1))
        scene.add_body(ds.shapes.box((150.0, 1.0, 1.0)), kind="kinematic", position=(0, 9, 0))
        scene.add_body(ds.shapes.box(1e-5), kind="static", position=(0, 0, 30))
        scene.add_body(ds.shapes.box((100.0, 1.0, 5e-5)), density=5.0, position=(0, 0, 10))  # a foil, just not too long
        scene.add_body(ds.shapes.box(1e-4), density=2e4, position=(0, 0, 20))
        scene.add_body((CUBE[0], CUBE[1][1:]), mass=1.0, inertia=np.eye(3), position=(0, 0, 15))  # open: no density
        scene.add_sphere(0.5, mass=3.0, position=(0, 0, 5))
        scene.add_cloth(SHEET, position=(0, 0, 40))

    assert told(add) == []


# ---- scale -----------------------------------------------------------------------------------------------------------


def test_a_scaled_body_is_the_body_of_the_scaled_mesh() -> None:
    vertices, faces = ds.shapes.l_shape(1.0, 0.3, 0.5)
    given, scaled = ds.Scene(), ds.Scene()
    options: dict[str, Any] = {"position": (0.5, 0, 1), "orientation": (0.8, 0.6, 0, 0), "margin": 1e-4}
    given.add_body((vertices * 0.25, faces), density=700.0, **options)
    scaled.add_body((vertices, faces), density=700.0, scale=0.25, **options)
    kept = pickle.loads(pickle.dumps(scaled))
    for name in ("vertices", "mass", "inertia", "position", "margin", "mesh_offset"):
        expected = getattr(given.pack(), name)
        np.testing.assert_allclose(getattr(scaled.pack(), name), expected, rtol=1e-13, atol=1e-16)
        np.testing.assert_array_equal(getattr(kept.pack(), name), getattr(scaled.pack(), name))
    assert scaled.pack().thickness == pytest.approx(given.pack().thickness)


def test_a_scaled_cloth_is_the_cloth_of_the_scaled_mesh_and_rest_shape() -> None:
    (vertices, faces), rest = SHEET, 0.9 * SHEET[0]
    given, scaled = ds.Scene(), ds.Scene()
    given.add_cloth((1e-3 * vertices, faces), rest=1e-3 * rest, position=(0, 0, 1), pinned=[0])
    scaled.add_cloth((vertices, faces), rest=rest, position=(0, 0, 1), pinned=[0], scale=1e-3)
    for name in ("node_position", "node_rest", "thickness", "pinned"):
        np.testing.assert_allclose(getattr(scaled.pack(), name), getattr(given.pack(), name), rtol=1e-13)


def test_a_mesh_in_millimetres_is_mended_by_scale() -> None:
    mesh = ds.shapes.box(200.0)
    assert told(lambda s: s.add_body(mesh, density=1e3))
    assert told(lambda s: s.add_body(mesh, density=1e3, scale=1e-3)) == []
    np.testing.assert_array_equal(mesh[0], ds.shapes.box(200.0)[0])  # the caller's own


@pytest.mark.parametrize(
    "add", [lambda s, k: s.add_body(CUBE, mass=1.0, scale=k), lambda s, k: s.add_cloth(SHEET, scale=k)]
)
def test_wrong_scales_are_refused(add: Any) -> None:
    for scale in (0.0, -1.0):
        with pytest.raises(ValueError, match="scale must be positive"):
            add(ds.Scene(), scale)
    with pytest.raises(ValueError, match="scale must be finite"):
        add(ds.Scene(), float("nan"))
    with pytest.raises((TypeError, ValueError), match="scale must be a number"):
        add(ds.Scene(), (1.0, 2.0, 3.0))


# ---- cloth that is not resolved --------------------------------------------------------------------------------------


@pytest.mark.parametrize("nodes", [3, 5, 10, 20])
def test_a_sheet_of_ten_micrometres_is_refused(nodes: int) -> None:
    scene = ds.Scene()
    scene.add_cloth(ds.shapes.sheet(1e-5, nodes), position=(0, 0, 1), name="film")
    with pytest.raises(
        ValueError, match=r"cloth 'film': its triangles, .* are too small for double precision"
    ) as raised:
        ds.Simulator(scene, dt=0.01)
    assert "scale=" in str(raised.value)
    ds.Simulator(scene, dt=0.01, check=False)


def test_small_sheets_that_are_resolved_fall() -> None:
    for size, nodes in ((1e-4, 5), (1e-3, 20)):
        scene = ds.Scene()
        scene.add_cloth(ds.shapes.sheet(size, nodes), position=(0, 0, 1))
        sim = ds.Simulator(scene, dt=0.01, on_failure="raise")
        end = sim.rollout(sim.initial_state(), None, 5)[-1]
        assert end.node_position[:, 2].mean().item() == pytest.approx(1.0 - 15 * 9.81e-4, rel=1e-6)
