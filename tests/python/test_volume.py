"""Meshes of several parts: what encloses a volume once is weighed, what would count some of it twice is refused."""

from typing import Any

import numpy as np
import pytest

from diffsim import shapes
from diffsim.scene import PackedScene, Scene

CUBE = shapes.box(1.0)
ROUNDING = 1e-12  # relative, of the mass of a few boxes


def joined(*meshes: shapes.Mesh) -> shapes.Mesh:
    """One mesh of several, each a part of its own."""
    first = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    vertices = np.concatenate([vertices for vertices, _ in meshes])
    return vertices, np.concatenate([faces + start for (_, faces), start in zip(meshes, first)]).astype(np.int32)


def moved(mesh: shapes.Mesh, *by: float) -> shapes.Mesh:
    return mesh[0] + np.array(by), mesh[1]


def inwards(mesh: shapes.Mesh) -> shapes.Mesh:
    return mesh[0], np.ascontiguousarray(mesh[1][:, ::-1])


def refined(mesh: shapes.Mesh) -> shapes.Mesh:
    """The same surface with four times as many faces."""
    import trimesh

    return trimesh.remesh.subdivide(*mesh)


def weighed(mesh: Any, **arguments: Any) -> PackedScene:
    scene = Scene()
    scene.add_body(mesh, name="thing", **(arguments or {"density": 1.0}))
    return scene.pack()


def refused(mesh: Any) -> str:
    with pytest.raises(ValueError, match="body 'thing': ") as raised:
        weighed(mesh)
    return str(raised.value)


# ---- Repeated faces ---------------------------------------------------------------------------------------------


def test_a_doubled_face_is_named_as_such_and_not_as_a_hole() -> None:
    vertices, faces = CUBE
    text = refused((vertices, np.concatenate([faces, faces[3:4]])))
    assert "mesh faces 3 and 12 are the same (1 of 13 faces repeat another)" in text
    assert "unique_faces" in text
    assert "open" not in text
    assert "faces 3 and 12 are the same" in refused((vertices, np.concatenate([faces, np.roll(faces[3:4], 1, axis=1)])))


@pytest.mark.parametrize("merged", [True, False])
def test_a_cube_given_twice_is_named(merged: bool) -> None:
    twice = (CUBE[0], np.concatenate([CUBE[1], CUBE[1]])) if merged else joined(CUBE, CUBE)
    assert "mesh faces 0 and 12 are the same (12 of 24 faces repeat another)" in refused(twice)


def test_mends_for_repeated_faces_mend() -> None:
    import trimesh

    mesh = trimesh.Trimesh(*joined(CUBE, CUBE), process=False)
    mesh.merge_vertices()
    mesh.update_faces(mesh.unique_faces())
    assert weighed(mesh).mass[0] == pytest.approx(1.0, rel=ROUNDING)


def test_a_wall_between_two_boxes_is_no_repeated_face() -> None:
    two = joined(CUBE, moved(CUBE, 1.0, 0.0, 0.0))
    vertices, index = np.unique(two[0], axis=0, return_inverse=True)
    for mesh in (two, (vertices, index.reshape(-1)[two[1]])):
        assert weighed(mesh).mass[0] == pytest.approx(2.0, rel=ROUNDING)


def test_a_double_sided_export_is_named() -> None:
    assert "keep one of each" in refused((CUBE[0], np.concatenate([CUBE[1], CUBE[1][:, ::-1]])))
    assert "keep one of each" in refused(joined(CUBE, inwards(CUBE)))


# ---- Parts ------------------------------------------------------------------------------------------------------

OVERLAPPING = {
    "at a corner": joined(CUBE, moved(CUBE, 0.5, 0.4, 0.3)),
    "along an edge": joined(CUBE, moved(CUBE, 0.5, 0.4, 0.0)),
    "by half, sides flush": joined(CUBE, moved(CUBE, 0.5, 0.0, 0.0)),
    "by a hair, sides flush": joined(CUBE, moved(CUBE, 1.0 - 1e-6, 0.0, 0.0)),
    "a rod through a cube": joined(CUBE, shapes.box((0.2, 0.2, 3.0))),
    "split differently": joined(CUBE, refined(CUBE)),
    "in a corner, flush": joined(CUBE, moved(shapes.box(0.5), 0.25, 0.25, 0.25)),
    "far from the origin": moved(joined(CUBE, moved(CUBE, 0.5, 0.4, 0.3)), 1e4, -2e4, 3e4),
}


@pytest.mark.parametrize("name", OVERLAPPING)
@pytest.mark.parametrize("swapped", [False, True])
def test_parts_that_overlap_are_refused(name: str, swapped: bool) -> None:
    vertices, faces = OVERLAPPING[name]
    if swapped:
        faces = np.concatenate([faces[12:], faces[:12]])
    second = len(faces) - 12 if swapped else 12
    text = refused((vertices, faces))
    assert f"parts 0 and 1 (those of faces 0 and {second}) of the mesh overlap" in text
    assert "trimesh.boolean.union" in text
    assert "inertia=" in text


def test_a_part_inside_another_is_refused() -> None:
    text = refused(joined(CUBE, shapes.box(0.5)))
    assert "part 1 of the mesh (face 12 and those connected with it) is inside part 0 (face 0)" in text
    assert "cavity" in text
    assert "part 0 of the mesh (face 0 and those connected with it) is inside" in refused(joined(shapes.box(0.5), CUBE))
    assert "is inside part" in refused(joined(CUBE, shapes.box(0.5), shapes.box(0.25)))
    assert "is inside part" in refused(inwards(joined(CUBE, shapes.box(0.5))))  # turned around as a whole


def test_a_part_inside_another_that_shares_a_vertex_is_refused() -> None:
    vertices, faces = joined(CUBE, moved(shapes.box(0.5), -0.25, -0.25, -0.25))
    vertices, index = np.unique(vertices, axis=0, return_inverse=True)
    assert len(vertices) == 15
    assert "parts 0 and 1" in refused((vertices, index.reshape(-1)[faces]))


def test_cavities_are_taken_away() -> None:
    shell = joined(CUBE, inwards(shapes.box(0.5)))
    assert weighed(shell).mass[0] == pytest.approx(0.875, rel=ROUNDING)
    assert weighed(inwards(shell)).mass[0] == pytest.approx(0.875, rel=ROUNDING)
    clapper = joined(CUBE, inwards(shapes.box(0.5)), shapes.box(0.25))
    assert weighed(clapper).mass[0] == pytest.approx(0.875 + 0.25**3, rel=ROUNDING)
    resting = joined(CUBE, inwards(shapes.box(0.5)), moved(shapes.box(0.25), 0.0, 0.0, -0.125))
    assert weighed(resting).mass[0] == pytest.approx(0.875 + 0.25**3, rel=ROUNDING)
    two = joined(CUBE, inwards(moved(shapes.box(0.2), 0.2, 0, 0)), inwards(moved(shapes.box(0.2), -0.2, 0, 0)))
    assert weighed(two).mass[0] == pytest.approx(1.0 - 2 * 0.2**3, rel=ROUNDING)


def test_cavities_of_nothing_are_refused() -> None:
    assert "part 1 of the mesh points inwards" in refused(joined(CUBE, inwards(moved(shapes.box(0.5), 2.0, 0.0, 0.0))))
    assert "part 2 of the mesh points inwards" in refused(
        joined(CUBE, inwards(shapes.box(0.5)), inwards(shapes.box(0.25)))
    )
    assert "must lie inside another part" in refused(joined(CUBE, inwards(moved(shapes.box(0.5), 0.5, 0.1, 0.05))))


def test_parts_apart_or_touching_are_weighed() -> None:
    for mesh, volume in {
        "apart": (joined(CUBE, moved(CUBE, 3.0, 0.0, 0.0)), 2.0),
        "face to face, shifted": (joined(CUBE, moved(CUBE, 0.3, 0.2, 1.0)), 2.0),
        "edge to edge": (joined(CUBE, moved(CUBE, 1.0, 1.0, 0.0)), 2.0),
        "linked": (joined(shapes.torus(), moved(shapes.torus(), 0.0, 0.0, 5.0)), None),
        "in a channel": (joined(shapes.u_channel(), moved(shapes.u_channel(), 0.0, 0.0, 9.0)), None),
    }.values():
        expected = volume or sum(weighed(part).mass[0] for part in ((mesh[0], half) for half in np.split(mesh[1], 2)))
        assert weighed(mesh).mass[0] == pytest.approx(expected, rel=1e-9)


def test_mass_and_inertia_weigh_what_overlaps() -> None:
    """Its centre of mass is the origin of the mesh's frame, as that of any mesh without a volume."""
    for mesh in (joined(CUBE, moved(CUBE, 0.5, 0.4, 0.3)), joined(CUBE, shapes.box(0.5)), joined(CUBE, CUBE)):
        packed = weighed(mesh, mass=2.0, inertia=np.eye(3))
        assert packed.mass[0] == 2.0
        np.testing.assert_array_equal(packed.mesh_offset, 0.0)
        with pytest.raises(ValueError, match=r"are the same|is inside|overlap"):
            weighed(mesh, mass=2.0)


def test_bodies_without_mass_may_be_made_of_parts_that_overlap() -> None:
    packed = weighed(joined(CUBE, moved(CUBE, 0.5, 0.4, 0.3)), kind="static")
    assert packed.mass[0] == 0.0


def test_many_parts_are_looked_at_by_their_boxes(monkeypatch: pytest.MonkeyPatch) -> None:
    from diffsim import _volume

    asked = []
    monkeypatch.setattr(_volume, "meeting_faces", lambda a, b: asked.append((a, b)))
    grid = [moved(shapes.box(0.5), *place) for place in np.ndindex(6, 6, 6)]
    assert weighed(joined(*grid)).mass[0] == pytest.approx(216 * 0.125, rel=1e-9)
    assert not asked
