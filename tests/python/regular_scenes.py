"""Scenes as people build them, everything aligned: grids, stacks and walls of equal things, edge on edge, side by side.

Edges are parallel, faces coplanar, corners above corners, exactly or up to rounding: what random poses never are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import diffsim as ds

QUARTER = np.pi / 4.0
GAPS = (0.0, 0.0, 1e-3, 0.05)  # between neighbours, of their size


def regular_scene(seed: int, index: int) -> ds.Scene:
    """Families take turns, so that a few scenes hold one of each."""
    rng = np.random.default_rng([seed, index])
    scene = ds.Scene(gravity=(0.0, 0.0, -9.81 if rng.random() < 0.9 else 0.0))
    scene.add_ground()
    FAMILIES[index % len(FAMILIES)](scene, rng)
    return scene


def motion(rng: np.random.Generator, *, speed: float = 4.0) -> dict[str, Any]:
    """Of a body, along one axis of the world or none, without spin; its density one of four decades."""
    velocity = np.zeros(3)
    if rng.random() < 0.6:
        velocity[rng.integers(3)] = rng.choice([-1.0, -0.25, 0.25, 1.0]) * speed
    return {"velocity": tuple(velocity), "density": float(10.0 ** rng.integers(1, 5))}


def turned(rng: np.random.Generator, step: float = QUARTER) -> Any:
    """A quaternion of turns about the axes by multiples of `step` [rad]."""
    return ds.rotation.from_rpy(step * rng.integers(0, 8, size=3))


def grid(scene: ds.Scene, rng: np.random.Generator) -> None:
    """Equal boxes in rows and columns on the ground, all of which may be turned by the same multiple of 45°."""
    extents = rng.choice([0.5, 1.0], size=3)
    pitch = extents[:2] * (1.0 + rng.choice(GAPS))
    yaw = QUARTER * rng.integers(8)
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    for i in range(rng.integers(1, 4)):
        for j in range(rng.integers(2, 4)):
            x, y = turn @ (pitch * (i, j))
            orientation = ds.rotation.from_rpy(np.array([0.0, 0.0, yaw]))
            position = (x, y, 0.5 * extents[2])
            scene.add_body(ds.shapes.box(extents), position=position, orientation=orientation, **motion(rng))


def stack(scene: ds.Scene, rng: np.random.Generator) -> None:
    """Boxes on boxes, of one size or smaller and smaller, each turned by a multiple of 45 or 90° about the vertical."""
    step, shrink, gap = QUARTER * rng.integers(0, 3), rng.choice([1.0, 1.0, 0.5]), rng.choice(GAPS)
    offset = rng.choice([0.0, 0.0, 0.5, 1.0]) * rng.choice([-1.0, 1.0])  # half over the one below, edge above edge
    size, height, x = 1.0, 0.0, 0.0
    for _ in range(rng.integers(2, 6)):
        orientation = ds.rotation.from_rpy(np.array([0.0, 0.0, step * rng.integers(8)]))
        position = (x, 0.0, height + 0.5 * size)
        scene.add_body(ds.shapes.box(size), position=position, orientation=orientation, **motion(rng, speed=1.0))
        height += size * (1.0 + gap)
        x += 0.5 * size * offset
        size *= shrink


def wall(scene: ds.Scene, rng: np.random.Generator) -> None:
    """Bricks in courses, each half over two of the one below."""
    gap = rng.choice(GAPS)
    for course in range(3):
        for column in range(3 - course % 2):
            position = ((column + 0.5 * (course % 2)) * (1.0 + gap), 0.0, (course + 0.5) * 0.5 * (1.0 + gap))
            scene.add_body(ds.shapes.box((1.0, 0.5, 0.5)), position=position, **motion(rng, speed=1.0))


def on_edges(scene: ds.Scene, rng: np.random.Generator) -> None:
    """Boxes and tetrahedra that come down on a box with an edge or a corner first, on its edge, corner or middle."""
    kind = rng.choice(["static", "dynamic"])
    base: dict[str, Any] = {"kind": kind} if kind == "static" else {"density": 1000.0}
    scene.add_body(ds.shapes.box(1.0), position=(0.0, 0.0, 0.5), **base)
    for side in range(rng.integers(1, 3)):
        mesh = ds.shapes.box(1.0) if rng.random() < 0.7 else ds.shapes.tetrahedron(0.5)
        corner = np.array([0.0, np.arctan(np.sqrt(0.5)), 0.0])  # a cube's diagonal upright
        orientation = (
            turned(rng) if rng.random() < 0.7 else ds.rotation.from_rpy(np.array([QUARTER, 0.0, 0.0]) + corner)
        )
        position = (*rng.choice([-0.5, 0.0, 0.5], size=2), 2.0 + 1.8 * side)
        options = motion(rng) | {"velocity": (0.0, 0.0, -4.0)}
        scene.add_body(mesh, position=position, orientation=orientation, **options)


def spheres(scene: ds.Scene, rng: np.random.Generator) -> None:
    """Equal balls: in a row, in a square on the ground, or one exactly above the other."""
    radius, step = 0.25, 0.5 * (1.0 + rng.choice(GAPS))
    shape = rng.choice([(4, 1, 1), (2, 2, 1), (1, 1, 3), (2, 2, 2)])
    for i, j, k in np.ndindex(*shape):
        scene.add_sphere(radius, position=(i * step, j * step, radius + k * step), **motion(rng, speed=1.0))


def capsules(scene: ds.Scene, rng: np.random.Generator) -> None:
    """Equal capsules side by side, end to end, in layers along or across each other, or standing in a row."""
    radius, length = 0.2, 0.8
    step = 2.0 * radius * (1.0 + rng.choice(GAPS))
    upright, layers, across = rng.random() < 0.3, rng.integers(1, 3), rng.random() < 0.5
    shift = rng.choice([0.0, 0.0, 0.5, 1.0]) * length  # of every second one, along
    for layer in range(layers):
        for i in range(2):
            place = np.array([i * step, shift * (i % 2), 0.0])
            rpy = np.array([2.0 * QUARTER, 0.0, 0.0])
            if upright:
                rpy[0] = 0.0
            elif across and layer % 2:
                place, rpy = place[[1, 0, 2]], np.array([0.0, 2.0 * QUARTER, 0.0])
            place[2] = radius + layer * step + (0.5 * length * (2 * layer + 1) if upright else 0.0)
            scene.add_capsule(
                radius, length, position=place, orientation=ds.rotation.from_rpy(rpy), **motion(rng, speed=1.0)
            )


def mixed(scene: ds.Scene, rng: np.random.Generator) -> None:
    """A box, a ball, a capsule and a box again, one above the other, their centres on one line; a wall beside them."""
    scene.add_body(ds.shapes.box((0.2, 2.0, 2.0)), kind="static", position=(-0.6, 0.0, 1.0))
    pushed = {"velocity": (rng.choice([-1.0, 0.0]), 0.0, 0.0)}
    scene.add_body(ds.shapes.box(1.0), position=(0.0, 0.0, 0.5), **motion(rng) | pushed)
    scene.add_sphere(0.25, position=(0.0, 0.0, 1.25), **motion(rng) | pushed)
    lying = ds.rotation.from_rpy(np.array([2.0 * QUARTER, 0.0, 0.0]))
    scene.add_capsule(0.25, 1.0, position=(0.0, 0.0, 1.75), orientation=lying, **motion(rng) | pushed)
    scene.add_body(ds.shapes.box(1.0), position=(0.0, 0.0, 2.5), **motion(rng) | pushed)


def cloth(scene: ds.Scene, rng: np.random.Generator) -> None:
    """A square sheet laid flat on boxes that stand side by side, its edges along theirs or over them."""
    gap = rng.choice(GAPS)
    for i in range(2):
        for j in range(rng.integers(1, 3)):
            scene.add_body(
                ds.shapes.box(0.5), position=(0.5 * i * (1.0 + gap), 0.5 * j * (1.0 + gap), 0.25), **motion(rng)
            )
    nodes, width = int(rng.integers(3, 6)), rng.choice([0.5, 1.0, 1.5])
    scene.add_cloth(
        ds.shapes.sheet(width, nodes),
        ds.ClothMaterial.isotropic(young=1e5, thickness=2e-3, density=300.0, poisson=0.3),
        position=(rng.choice([0.0, 0.25]), rng.choice([0.0, 0.25]), 0.5 + rng.choice([0.005, 0.1])),
        orientation=ds.rotation.from_rpy(np.array([0.0, 0.0, QUARTER * rng.integers(8)])),
        velocity=(0.0, 0.0, rng.choice([0.0, -1.0])),
    )


FAMILIES: list[Callable[[ds.Scene, np.random.Generator], None]] = [
    grid,
    stack,
    wall,
    on_edges,
    spheres,
    capsules,
    mixed,
    cloth,
]
