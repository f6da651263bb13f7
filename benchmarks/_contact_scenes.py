"""Scenes of `contact_rich.py` that only it needs: scans, and very thin and very small things."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import diffsim as ds

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]
SCAN_SIZE = 0.2  # longest side of a scan [m]


def scan(faces: int, seed: int = 0) -> Mesh:
    """A closed, lumpy, rough surface of about so many faces, as a scanner finds them; longest side `SCAN_SIZE`.

    An icosahedron whose edges are divided in n parts (20 n² faces), with lumps of a third of its radius, and
    roughness of a tenth of its edges' length.
    """
    rng = np.random.default_rng(seed)
    points, triangles = _divided_icosahedron(max(1, round((faces / 20.0) ** 0.5)))
    radius = np.ones(len(points))
    for frequency in (2.0, 3.0, 5.0, 8.0, 13.0):
        wave, phase = frequency * rng.normal(size=(3, 3)), rng.uniform(0.0, 2.0 * np.pi, 3)
        radius += (0.25 / frequency) * np.cos(points @ wave + phase).sum(axis=1)
    points = points * np.maximum(radius, 0.3)[:, None] * [1.0, 0.8, 0.9]
    edge = np.linalg.norm(points[triangles[:, 0]] - points[triangles[:, 1]], axis=1).mean()
    points = points + 0.1 * edge * rng.uniform(-1.0, 1.0, points.shape)
    return points * (SCAN_SIZE / np.ptp(points, axis=0).max()), triangles


def _divided_icosahedron(parts: int) -> Mesh:
    """Its edges in so many parts, its points moved onto the unit sphere."""
    corners, faces = ds.shapes.icosphere(1.0, 0)
    i, j = np.array([(i, j) for i in range(parts + 1) for j in range(parts + 1 - i)]).T
    weights = np.stack([parts - i - j, i, j], axis=1) / parts
    row = {(a, b): k for k, (a, b) in enumerate(zip(i, j))}
    small = [(row[a, b], row[a + 1, b], row[a, b + 1]) for a, b in row if a + b < parts]
    small += [(row[a + 1, b], row[a + 1, b + 1], row[a, b + 1]) for a, b in row if a + b < parts - 1]
    points = np.einsum("kc,fcx->fkx", weights, corners[faces]).reshape(-1, 3)
    triangles = (np.array(small) + len(i) * np.arange(len(faces))[:, None, None]).reshape(-1, 3)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    _, first, merged = np.unique(np.round(points, 9), axis=0, return_index=True, return_inverse=True)
    return points[first], merged.reshape(-1)[triangles]


def scan_on_scan(faces: int, mesh: Path | None = None) -> ds.Scene:
    """A scan falls, tumbling, onto another, which stands on the ground. `mesh`: a file to take in its place."""
    if mesh is None:
        vertices, triangles = scan(faces)
    else:
        import trimesh

        loaded = trimesh.load(mesh)
        vertices, triangles = np.asarray(loaded.vertices), np.asarray(loaded.faces)
        vertices = (vertices - loaded.center_mass) * (SCAN_SIZE / np.ptp(vertices, axis=0).max())
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body((vertices, triangles), density=1000.0, position=(0.0, 0.0, 0.15), name="lower")
    scene.add_body(
        (vertices, triangles),
        density=1000.0,
        position=(0.03, 0.02, 0.45),
        orientation=(0.9, 0.3, 0.2, 0.1),
        name="upper",
    )
    return scene


def wire_under_sheet(nodes: int = 21) -> ds.Scene:
    """A sheet of cloth, 1 m wide, falls on a wire 0.1 mm thick."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box((1.2, 1e-4, 1e-4)), kind="static", position=(0.0, 0.013, 0.2), name="wire")
    scene.add_cloth(ds.shapes.sheet(1.0, nodes), position=(0.0, 0.0, 0.21), name="sheet")
    return scene


def specks(size: float = 1e-6) -> ds.Scene:
    """Four boxes of `size` [m] fall onto the ground and onto each other in steps in which they move far."""
    scene = ds.Scene()
    scene.add_ground()
    for index in range(4):
        scene.add_body(
            ds.shapes.box((size, 0.8 * size, 0.6 * size)),
            density=1000.0,
            position=(0.3 * size * (index % 2), 0.2 * size * index, (1.0 + 1.6 * index) * size),
            orientation=(1.0, 0.1 * index, 0.2, 0.0),
            name=f"speck_{index}",
        )
    return scene
