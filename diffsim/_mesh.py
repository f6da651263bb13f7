"""Reading triangle meshes, and refusing those no simulation can be built on."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ._mass_properties import FloatArray, IntArray

NDArrayInt = NDArray[np.int64]

# A face whose height is below this fraction of its longest edge has no normal worth the name: its direction is
# rounding.
_DEGENERATE_HEIGHT = 1e-12
# A closed mesh whose volume is below this fraction of its bounding box's diagonal cubed is flat: its inertia is
# rounding.
_FLAT_VOLUME = 1e-12

_CLOSED_MEND = "remove such faces (trimesh: mesh.update_faces(mesh.nondegenerate_faces())) and close the mesh again"


class EdgeDefects(NamedTuple):
    """What keeps a mesh from enclosing a volume."""

    open_count: int  #: edges that bound an odd number of faces
    misoriented_count: int  #: edges whose faces all run along them in the same direction


def read_mesh(mesh: Any, where: str) -> tuple[FloatArray, IntArray]:
    """Turn what a user calls a mesh into checked arrays.

    Args:
        mesh: A path trimesh can read (all its geometries become one mesh and vertices at the same place become one),
            a `trimesh.Trimesh` or `trimesh.Scene`, or `(vertices, faces)`.
        where: The object's name in error messages.
    Returns: vertices, shape (n, 3) float64, each used by a face; faces, shape (m, 3) int32. Both are fresh copies.
    Raises:
        FileNotFoundError: No such file.
        TypeError: Not a mesh, or faces that are not integers.
        ValueError: Wrong shapes, non-finite vertices, faces out of range or degenerate.
    """
    if isinstance(mesh, (str, os.PathLike)):
        vertices, faces = _read_file(os.fspath(mesh), where)
        # Formats such as STL repeat a vertex for every face that uses it. "+ 0.0" makes -0 and 0 the same.
        vertices, index = np.unique(vertices + 0.0, axis=0, return_inverse=True)
        faces = index.reshape(-1)[faces]
        faces = faces[~_collapsed(faces)]  # that merging made into edges: they enclose nothing
    else:
        vertices, faces = _read_object(mesh, where)
    _check_mesh(vertices, faces, where, _CLOSED_MEND)
    used, flat = np.unique(faces, return_inverse=True)
    return np.ascontiguousarray(vertices[used]), flat.reshape(faces.shape).astype(np.int32)


def read_mesh_in_order(mesh: Any, where: str) -> tuple[FloatArray, IntArray]:
    """As `read_mesh`, but vertex i stays vertex i, whether a face uses it or not.

    Only where a file repeats vertices, as STL does for every face, they become one each, in the order in which the file
    first names them.
    """
    if isinstance(mesh, (str, os.PathLike)):
        vertices, faces = _read_file(os.fspath(mesh), where)
        places, first, index = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)
        if len(places) < len(vertices):
            order = np.argsort(first)
            rank = np.empty_like(order)
            rank[order] = np.arange(len(order))
            vertices, faces = places[order], rank[index.reshape(-1)][faces]
            faces = faces[~_collapsed(faces)]
    else:
        vertices, faces = _read_object(mesh, where)
    _check_mesh(vertices, faces, where, "remove such faces (trimesh: mesh.update_faces(mesh.nondegenerate_faces()))")
    return np.array(vertices, order="C"), np.array(faces, dtype=np.int32, order="C")


def _collapsed(faces: NDArrayInt) -> NDArray[np.bool_]:
    """Which faces have the same vertex at two corners, shape (m,)."""
    return np.asarray((faces == np.roll(faces, 1, axis=1)).any(axis=1))


def _read_object(mesh: Any, where: str) -> tuple[FloatArray, NDArrayInt]:
    if hasattr(mesh, "to_mesh"):
        mesh = mesh.to_mesh()
    if hasattr(mesh, "vertices") and hasattr(mesh, "faces"):
        mesh = (mesh.vertices, mesh.faces)
    if not isinstance(mesh, (tuple, list)) or len(mesh) != 2:
        raise TypeError(
            f"{where}: mesh must be a path, a trimesh.Trimesh or (vertices, faces), got {type(mesh).__name__}"
        )
    return _read_arrays(mesh[0], mesh[1], where)


def _read_file(path: str, where: str) -> tuple[FloatArray, NDArrayInt]:
    if not os.path.exists(path):
        raise FileNotFoundError(f"{where}: mesh file not found: {path}")
    import trimesh  # lazily: importing diffsim must not cost what reading files costs

    try:
        # process=False: trimesh would merge within an absolute 1e-8, whatever the size of the object. maintain_order:
        # it would split and sort the vertices of an OBJ file with texture coordinates.
        loaded = trimesh.load_scene(path, process=False, maintain_order=True).to_mesh()
    except (NotImplementedError, ValueError) as error:  # an extension it does not know; a broken file
        raise ValueError(f"{where}: mesh file {path} could not be read: {error}") from error
    if len(loaded.faces) == 0:
        raise ValueError(f"{where}: mesh file {path} has no faces")
    return _read_arrays(loaded.vertices, loaded.faces, where)


def _read_arrays(vertices: Any, faces: Any, where: str) -> tuple[FloatArray, NDArrayInt]:
    vertices, faces = to_numpy(vertices, f"{where}: mesh vertices"), to_numpy(faces, f"{where}: mesh faces")
    if vertices.dtype.kind not in "fiu":
        raise TypeError(f"{where}: mesh vertices must be numbers, got dtype {vertices.dtype}")
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise ValueError(f"{where}: mesh vertices must have shape (n, 3), got {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
        raise ValueError(f"{where}: mesh faces must be triangles, shape (m, 3) with m > 0, got {faces.shape}")
    if faces.dtype.kind not in "iu":
        raise TypeError(f"{where}: mesh faces must be integers, got dtype {faces.dtype}")
    return np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)


def to_numpy(value: Any, where: str) -> np.ndarray[Any, Any]:
    """Any array-like, torch tensors included, as a numpy array."""
    if hasattr(value, "detach"):
        if value.requires_grad:
            raise ValueError(
                f"{where}: got a tensor that requires grad, but a scene carries no gradients; pass value.detach() "
                "here, and give the tensor itself to the simulator (initial state, control or parameter)"
            )
        value = value.detach().cpu().numpy()
    try:
        return np.asarray(value)
    except ValueError as error:  # ragged lists
        raise ValueError(f"{where}: not an array: {error}") from None


def _check_mesh(vertices: FloatArray, faces: NDArrayInt, where: str, mend: str) -> None:
    finite = np.isfinite(vertices).all(axis=1)
    if not finite.all():
        first = int(np.argmin(finite))
        raise ValueError(
            f"{where}: mesh vertex {first} is not finite: {vertices[first].tolist()} "
            f"({np.count_nonzero(~finite)} of {len(vertices)} vertices); remove or repair them"
        )
    in_range = ((faces >= 0) & (faces < len(vertices))).all(axis=1)
    if not in_range.all():
        first = int(np.argmin(in_range))
        raise ValueError(
            f"{where}: mesh face {first} is out of range: {faces[first].tolist()} with {len(vertices)} vertices "
            "(indices start at 0)"
        )
    repeated = _collapsed(faces)
    if repeated.any():
        first = int(np.argmax(repeated))
        raise ValueError(
            f"{where}: mesh face {first} is degenerate: it repeats a vertex, {faces[first].tolist()} "
            f"({np.count_nonzero(repeated)} of {len(faces)} faces); {mend}"
        )
    check_triangles(vertices, faces, f"{where}: mesh", mend)


def check_triangles(
    vertices: FloatArray,
    faces: NDArrayInt | IntArray,
    where: str,
    mend: str,
    least_height: float = _DEGENERATE_HEIGHT,
) -> None:
    """Refuse faces without an area worth the name: lower than `least_height` of their longest edge."""
    corners = vertices[faces]
    edges = np.roll(corners, -1, axis=1) - corners
    longest_sq = np.einsum("fki,fki->fk", edges, edges).max(axis=1)
    double_area = np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1)
    flat = ~(double_area > least_height * longest_sq)
    if flat.any():
        first = int(np.argmax(flat))
        raise ValueError(
            f"{where} face {first} is degenerate: area {0.5 * double_area[first]:.3g} m², vertices "
            f"{corners[first].tolist()} ({np.count_nonzero(flat)} of {len(faces)} faces); {mend}"
        )


def edge_defects(faces: IntArray) -> EdgeDefects:
    """Count the edges at which a mesh is open, or changes its orientation.

    A mesh is closed when every edge is run through as often in one direction as in the other. Two closed parts that
    share an edge pass: what they enclose is well defined.
    """
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    edge = edge_numbers(faces).ravel()
    balance = np.bincount(edge, weights=np.where(start < end, 1.0, -1.0))
    odd = np.bincount(edge) % 2 == 1
    return EdgeDefects(int(np.count_nonzero(odd)), int(np.count_nonzero((balance != 0.0) & ~odd)))


def edge_numbers(faces: IntArray) -> IntArray:
    """For each face its three edges, numbered from 0, shape (m, 3)."""
    ends = np.stack([faces, np.roll(faces, -1, axis=1)]).astype(np.int64)
    key = ends.min(axis=0) * (int(faces.max()) + 1) + ends.max(axis=0)
    return np.unique(key, return_inverse=True)[1].reshape(-1, 3).astype(np.int32)


def face_components(faces: IntArray) -> IntArray:
    """Number the connected parts of a mesh: for each face the part it belongs to, from 0, shape (m,).

    Connected are faces with a vertex in common or, of the result of `edge_numbers`, with an edge.
    """
    labels = np.arange(int(faces.max()) + 1)
    while True:
        lowest = labels[faces].min(axis=1)
        merged = labels.copy()
        for corner in range(3):
            np.minimum.at(merged, faces[:, corner], lowest)
            # Hook whole labels, or a long strip takes O(m) sweeps.
            np.minimum.at(merged, labels[faces[:, corner]], lowest)
        merged = merged[merged]
        if np.array_equal(merged, labels):
            return np.unique(labels[faces[:, 0]], return_inverse=True)[1].astype(np.int32)
        labels = merged


def is_flat(volume: float, vertices: FloatArray) -> bool:
    """Whether the volume [m³] a closed mesh encloses, of either sign, is no more than rounding."""
    diagonal = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    return not abs(volume) > _FLAT_VOLUME * diagonal**3


def find_repeated(rows: NDArray[Any]) -> tuple[int, int, int] | None:
    """A row and the first that repeats one before it, by index, and how many do; None if none does."""
    _, index, group = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    first_there = index[group.reshape(-1)]
    repeated = first_there != np.arange(len(rows))
    if not repeated.any():
        return None
    second = int(np.argmax(repeated))
    return int(first_there[second]), second, int(np.count_nonzero(repeated))
