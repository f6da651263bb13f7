"""Does a mesh enclose a volume that can be weighed, every point of it once?"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._mass_properties import FloatArray, IntArray, mesh_mass_properties
from ._mesh import edge_defects, edge_numbers, face_components, find_repeated, is_flat
from ._mesh_queries import winding_number
from ._surfaces import Crossing, Solid, candidate_pairs, inset_points, meeting_faces, touching_depth

# How many of the faces by which a part touches others are tried to tell whether it shares some volume with them.
_TOUCH_SAMPLES = 512

_UNITE = (
    "unite the parts (trimesh: trimesh.boolean.union(mesh.split()), with manifold3d installed), or give both mass= and "
    "inertia="
)


def require_solid(vertices: FloatArray, faces: IntArray, where: str) -> IntArray:
    """Make sure that a mesh encloses a volume, every point of it once, and return its faces oriented outwards.

    A closed mesh whose faces all point inwards is turned around: there is only one solid it can mean. Parts may touch,
    and a part whose faces point inwards may lie inside another: that is a cavity.

    Raises: ValueError naming the defect: repeated faces, an open or inconsistently oriented mesh, a flat one, or
        separate parts that overlap, lie inside one another, or point inwards without being a cavity of another.
    """
    _refuse_repeated_faces(vertices, faces, where)
    defects = edge_defects(faces)
    if defects.open_count:
        raise ValueError(
            f"{where}: the mesh is open ({defects.open_count} boundary edges), so it has no volume to take mass and "
            "inertia from; close it (pymeshfix, trimesh: mesh.fill_holes()), merge vertices if they are merely "
            "repeated (trimesh: mesh.merge_vertices()), give both mass= and inertia=, or make it static"
        )
    if defects.misoriented_count:
        raise ValueError(
            f"{where}: the mesh's faces are not consistently oriented ({defects.misoriented_count} edges with faces "
            "that disagree), so its volume is not defined; orient them (trimesh: mesh.fix_normals())"
        )
    properties = mesh_mass_properties(vertices, faces)
    if is_flat(properties.mass, vertices):
        mend = "give it some thickness"
        if len(np.unique(np.sort(_places(vertices)[faces], axis=1), axis=0)) == len(faces) // 2:
            mend = "each of its faces is there in both senses, as double-sided exports have them: keep one of each"
        raise ValueError(
            f"{where}: the mesh is closed but encloses no volume ({properties.mass:.3g} m³); {mend}, or give both "
            "mass= and inertia="
        )
    if properties.mass < 0.0:
        faces = np.ascontiguousarray(faces[:, ::-1])
    _refuse_shared_volume(vertices, faces, where)
    return faces


def _refuse_repeated_faces(vertices: FloatArray, faces: IntArray, where: str) -> None:
    """Faces with corners at the same places, in the same sense of rotation: what they enclose would count twice.

    In the opposite sense they cancel, as where two boxes share a wall.
    """
    corners = _places(vertices)[faces]
    smallest = np.argmin(corners, axis=1)[:, None]
    corners = np.take_along_axis(corners, (smallest + np.arange(3)) % 3, axis=1)  # which comes first, the sense kept
    if (found := find_repeated(_row_numbers(corners))) is not None:
        first, second, count = found
        raise ValueError(
            f"{where}: mesh faces {first} and {second} are the same "
            f"({count} of {len(faces)} faces repeat another), so that what they enclose would "
            "count twice; keep one of each (trimesh: mesh.merge_vertices(), then "
            "mesh.update_faces(mesh.unique_faces())), or give both mass= and inertia="
        )


def _places(vertices: FloatArray) -> NDArray[np.int64]:
    """Numbers that are equal where vertices are at the same place, shape (n,)."""
    return _row_numbers(vertices + 0.0)  # "+ 0.0" makes -0 and 0 the same


def _row_numbers(rows: NDArray[Any]) -> NDArray[np.int64]:
    """Numbers that are equal where rows are, shape (n,). np.unique(axis=0) takes several times as long."""
    order = np.lexsort(rows.T)
    differs = (rows[order[1:]] != rows[order[:-1]]).any(axis=1)
    numbers = np.zeros(len(rows), dtype=np.int64)
    numbers[order[1:]] = np.cumsum(differs)
    return numbers


# ---- Parts ------------------------------------------------------------------------------------------------------


class _Part(NamedTuple):
    """Faces connected by edges: closed, since all faces at an edge are of one part."""

    solid: Solid
    outward: bool
    first_face: int  #: in the mesh


def _refuse_shared_volume(vertices: FloatArray, faces: IntArray, where: str) -> None:
    """Refuse parts that enclose volume another part counts, too, or cavities of nothing.

    Right beneath the faces of a part, on the side its material is, the other parts must wind 0 times around a part that
    points outwards and once around a cavity. Where no surfaces cross that needs looking at in few places: once per
    part, and where parts touch.
    """
    component = face_components(edge_numbers(faces))
    if not component.any():
        return
    first_faces = np.sort(np.unique(component, return_index=True)[1])  # parts in the order of their first faces
    parts = [_part(vertices, faces, component == component[first], int(first)) for first in first_faces]
    solids = [part.solid for part in parts]
    touching: list[list[NDArray[np.int64]]] = [[part.solid.component_faces] for part in parts]
    touched: list[set[int]] = [set() for _ in parts]
    for a, b in candidate_pairs(solids):
        pairs = meeting_faces(solids[a], solids[b])
        if _cross(solids[a], solids[b], pairs):
            raise ValueError(f"{where}: {_names(parts, a, b)} of the mesh overlap, {_twice(parts, a, b)}; {_UNITE}")
        for own, other, column in ((a, b, 0), (b, a, 1)):
            touching[own].append(pairs[:, column])
            touched[own].update([other] if len(pairs) else [])
    for k, part in enumerate(parts):
        tried = np.unique(np.concatenate(touching[k]))[:_TOUCH_SAMPLES]
        points = inset_points(part.solid, tried, touching_depth(part.solid, part.solid))
        wound = np.array([_winding(points, other) for other in solids])
        wound[k] = 0.0
        total = wound.sum(axis=0)
        if part.outward and total.max() > 0.5:
            other = int(np.argmax(wound[:, np.argmax(total)]))
            if other in touched[k]:
                raise ValueError(
                    f"{where}: {_names(parts, *sorted((k, other)))} of the mesh overlap, {_twice(parts, k, other)}; "
                    f"{_UNITE}"
                )
            raise ValueError(
                f"{where}: part {k} of the mesh (face {part.first_face} and those connected with it) is inside part "
                f"{other} (face {parts[other].first_face}), and its volume would count twice; remove it or, if it is "
                "meant as a cavity, turn its faces inwards (faces[:, ::-1]), or give both mass= and inertia="
            )
        if not part.outward and total.min() < 0.5:
            raise ValueError(
                f"{where}: part {k} of the mesh points inwards but is no cavity of another part; orient all parts "
                "outwards (trimesh: mesh.fix_normals())"
            )


def _cross(a: Solid, b: Solid, pairs: NDArray[np.int64]) -> bool:
    first, second = a.triangles[pairs[:, 0]], b.triangles[pairs[:, 1]]
    return bool(Crossing.of(first, second, touching_depth(a, b)).proper.any())


def _part(vertices: FloatArray, faces: IntArray, own: NDArray[np.bool_], first_face: int) -> _Part:
    used, flat = np.unique(faces[own], return_inverse=True)
    mesh = vertices[used], flat.reshape(-1, 3).astype(np.int32)
    solid = Solid(*mesh, radius=0.0, closed=True, movable=True, R_world_body=np.eye(3))
    return _Part(solid, mesh_mass_properties(*mesh).mass > 0.0, first_face)


def _winding(points: FloatArray, solid: Solid) -> FloatArray:
    """How often a part winds around the points (n, 3): 0 out of its box without a calculation."""
    low, high = solid.box
    near = ((points > low) & (points < high)).all(axis=1)
    result = np.zeros(len(points))
    if near.any():
        result[near] = np.rint(winding_number(points[near], solid.triangles))
    return result


def _names(parts: list[_Part], a: int, b: int) -> str:
    return f"parts {a} and {b} (those of faces {parts[a].first_face} and {parts[b].first_face})"


def _twice(parts: list[_Part], a: int, b: int) -> str:
    if parts[a].outward and parts[b].outward:
        return "and what they share would count twice"
    return "and what a cavity takes away must lie inside another part"
