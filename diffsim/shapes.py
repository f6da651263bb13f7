"""Small closed meshes, faces outwards, and sheets for cloth, as `(vertices, faces)`: shape (n, 3) float64 [m] and
(m, 3) int32.

For scenes, tests and first steps; anything else comes from a file or from trimesh. Nothing here is differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

Mesh = tuple[NDArray[np.float64], NDArray[np.int32]]


def box(extents: Sequence[float] | float = 1.0) -> Mesh:
    """A box centred on the origin; `extents` are its three sides, or one for a cube [m]."""
    half = 0.5 * np.broadcast_to(np.asarray(extents, dtype=np.float64), 3)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float64)
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    return corners * half, _split_quads(quads)


def tetrahedron(size: float = 1.0) -> Mesh:
    """A regular tetrahedron with edges of length `size` [m], its centre of mass at the origin, resting on a face z =
    const.

    It is `size * sqrt(2/3)` high, a quarter of it below the origin.
    """
    radius, height = size / np.sqrt(3.0), size * np.sqrt(2.0 / 3.0)
    angles = 2.0 * np.pi / 3.0 * np.arange(3)
    base = np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(3, -0.25 * height)], axis=1)
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], dtype=np.int32)
    return np.concatenate([base, [[0.0, 0.0, 0.75 * height]]]), faces


def icosphere(radius: float = 0.5, subdivisions: int = 2) -> Mesh:
    """A faceted sphere around the origin: an icosahedron whose 20 faces are split in four `subdivisions` times.

    Vertices lie on the sphere, so its volume falls short. For an exact sphere use `Scene.add_sphere`.

    Args:
        radius: Of the sphere the vertices lie on [m].
        subdivisions: 0 for the icosahedron itself; each makes four times as many faces.
    """
    golden = 0.5 * (1.0 + np.sqrt(5.0))
    vertices = np.array([[0.0, i, j * golden] for i in (-1, 1) for j in (-1, 1)])
    vertices = np.concatenate([np.roll(vertices, shift, axis=1) for shift in range(3)])
    # Faces are the triples of vertices that are all at the length of an edge, 2, from each other.
    near = np.isclose(np.linalg.norm(vertices[:, None] - vertices[None], axis=-1), 2.0)
    faces = np.array(
        [t for t in combinations(range(12), 3) if near[t[0], t[1]] and near[t[1], t[2]] and near[t[2], t[0]]]
    )
    inward = np.linalg.det(vertices[faces]) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(subdivisions):
        edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=-1).reshape(-1, 2), axis=1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        middle = len(vertices) + index.reshape(-1, 3)  # of the edges from corner i to corner i + 1
        vertices = np.concatenate([vertices, vertices[unique].mean(axis=1)])
        corners = [np.stack([faces[:, i], middle[:, i], middle[:, i - 1]], axis=1) for i in range(3)]
        faces = np.concatenate([*corners, middle])
    return radius * vertices / np.linalg.norm(vertices, axis=1, keepdims=True), faces.astype(np.int32)


def prism(outline: Sequence[Sequence[float]], height: float) -> Mesh:
    """An outline extruded along z, from -height/2 to height/2 [m].

    Args:
        outline: The corners in the xy plane, counter-clockwise, shape (n, 2) [m]; it may be non-convex, but must not
            cross itself.
        height: [m]
    Raises: ValueError for an outline that is clockwise or repeats a corner.
    """
    points = np.asarray(outline, dtype=np.float64)
    count = len(points)
    top = _triangulate(points)
    vertices = np.concatenate([np.column_stack([points, np.full(count, z)]) for z in (-0.5 * height, 0.5 * height)])
    ring = np.arange(count)
    after = np.roll(ring, -1)
    sides = _split_quads(np.stack([ring, after, after + count, ring + count], axis=1).tolist())
    return vertices, np.concatenate([top[:, ::-1], top + count, sides]).astype(np.int32)


def l_shape(size: float = 1.0, width: float = 0.4, height: float = 0.4) -> Mesh:
    """A non-convex angle: two legs of length `size` and `width` along x and y, extruded by `height` along z [m].

    The outer corner is at (-size/2, -size/2).
    """
    a, w = size, width
    outline = np.array([[0, 0], [a, 0], [a, w], [w, w], [w, a], [0, a]], dtype=np.float64) - 0.5 * a
    return prism(outline.tolist(), height)


def u_channel(width: float = 1.0, depth: float = 0.6, length: float = 1.0, wall: float = 0.2) -> Mesh:
    """A non-convex channel along y, open towards +z, its base at z = 0 [m].

    The gap between its walls is `width - 2 wall` wide and `depth - wall` deep.
    """
    x = 0.5 * width
    half = [[x, 0.0], [x, depth], [x - wall, depth], [x - wall, wall]]
    vertices, faces = prism([*half, *([-x, z] for x, z in reversed(half))], length)
    # The prism's z becomes -y, its y becomes z: a rotation about x, which keeps faces outwards.
    return np.ascontiguousarray(vertices[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])), faces


def torus(radius: float = 0.4, tube: float = 0.15, segments: int = 16, sides: int = 8) -> Mesh:
    """A ring about z: `segments` polygons of `sides` corners and radius `tube` on a circle of `radius` [m]."""
    u, v = np.meshgrid(2 * np.pi / segments * np.arange(segments), 2 * np.pi / sides * np.arange(sides), indexing="ij")
    distance = radius + tube * np.cos(v)
    vertices = np.stack([distance * np.cos(u), distance * np.sin(u), tube * np.sin(v)], axis=-1).reshape(-1, 3)
    index = np.arange(segments * sides).reshape(segments, sides)
    next_u, next_v = np.roll(index, -1, axis=0), np.roll(index, -1, axis=1)
    both = np.roll(next_u, -1, axis=1)
    return vertices, _split_quads(np.stack([index, next_u, both, next_v], axis=-1).reshape(-1, 4).tolist())


def sheet(size: Sequence[float] | float = 1.0, nodes: Sequence[int] | int = 21) -> Mesh:
    """A flat rectangle in the xy plane, centred on the origin, faces towards +z: an open mesh, for `Scene.add_cloth`.

    Nodes are numbered row by row along x: with nx by ny of them, number `j * nx + i` is the i-th of the j-th row, so
    that the corners are 0, nx - 1, nx (ny - 1) and nx ny - 1, and `range(nx)` is the edge at the smallest y. The
    diagonals alternate like the squares of a chessboard: the sheet folds as easily along one as along the other.

    Args:
        size: Sides along x and y, or one for a square [m].
        nodes: Numbers of nodes along x and y, or one for both; at least 2.
    Raises: ValueError for a side that is not positive, or fewer than two nodes along one.
    """
    width, depth = np.broadcast_to(np.asarray(size, dtype=np.float64), 2).tolist()
    nx, ny = np.broadcast_to(np.asarray(nodes), 2).tolist()
    if nx != int(nx) or ny != int(ny) or min(nx, ny) < 2:
        raise ValueError(f"sheet: nodes must be whole numbers, at least 2 along each side, got {nodes}")
    if not (width > 0.0 and depth > 0.0):
        raise ValueError(f"sheet: size must be positive, got {size} [m]")
    x, y = np.linspace(-0.5 * width, 0.5 * width, int(nx)), np.linspace(-0.5 * depth, 0.5 * depth, int(ny))
    vertices = np.stack([np.tile(x, len(y)), np.repeat(y, len(x)), np.zeros(len(x) * len(y))], axis=1)
    index = np.arange(len(vertices)).reshape(len(y), len(x))
    quads = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], axis=-1)
    turn = np.add.outer(np.arange(len(y) - 1), np.arange(len(x) - 1)) % 2 == 1
    quads[turn] = np.roll(quads[turn], -1, axis=-1)  # a quad is split along its first diagonal
    return vertices, _split_quads(quads.reshape(-1, 4).tolist())


def _split_quads(quads: Sequence[Sequence[int]]) -> NDArray[np.int32]:
    corners = np.asarray(quads, dtype=np.int32)
    return np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]])


def _triangulate(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Triangles of a simple counter-clockwise polygon, by cutting off ears; shape (n - 2, 3)."""

    def area(i: int, j: int, k: int) -> float:
        u, v = points[j] - points[i], points[k] - points[i]
        return float(u[0] * v[1] - u[1] * v[0])

    left, triangles = list(range(len(points))), []
    while len(left) > 2:
        for position in range(len(left)):
            i, j, k = left[position - 1], left[position], left[(position + 1) % len(left)]
            others = (p for p in left if p not in (i, j, k))
            if area(i, j, k) > 0.0 and not any(min(area(i, j, p), area(j, k, p), area(k, i, p)) >= 0.0 for p in others):
                triangles.append((i, j, k))
                del left[position]
                break
        else:
            raise ValueError(
                "prism: outline must be a simple counter-clockwise polygon, no corners repeated or straight"
            )
    return np.array(triangles, dtype=np.int32)
