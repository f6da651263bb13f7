"""Scenes of many bodies that touch: heaps, bins and stacks that give way. Each is the same whenever it is made."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..scene import Scene
from ..shapes import box, icosphere


def collapsing_stack(count: int = 20, *, gap: float = 2e-3) -> Scene:
    """Two square layers of `count` unit cubes together, the upper shifted by half a cube both ways.

    The rim of the upper layer has no support: it topples and falls. `gap` [m] lies below, between and beside the cubes.
    """
    scene = Scene()
    scene.add_ground()
    mesh, pitch, lower = box(1.0), 1.0 + gap, count // 2
    side = math.isqrt(max(lower, 1) - 1) + 1
    for layer, cubes in enumerate((lower, count - lower)):
        for index in range(cubes):
            row, column = divmod(index, side)
            position = (pitch * (column + 0.5 * layer), pitch * (row + 0.5 * layer), 0.5 + gap + pitch * layer)
            scene.add_body(mesh, density=1000.0, position=position, name=f"cube_{layer}_{index}")
    return scene


def boxes_in_bin(count: int = 20, *, edge: float = 0.15, side: int = 3, seed: int = 0) -> Scene:
    """`count` cubes of `edge` [m], tilted at random, fall in layers of `side` x `side` into a bin of four walls."""
    scene = Scene()
    scene.add_ground()
    rng = np.random.default_rng(seed)
    pitch = 1.85 * edge  # more than a cube's diagonal: at the start they do not touch, however they are turned
    half, height = 0.5 * pitch * side, 1.2 * pitch * math.ceil(count / side**2) + pitch
    wall = 0.5 * edge
    for axis in (0, 1):
        for sign in (-1.0, 1.0):
            extents, position = [2.0 * (half + wall), 2.0 * (half + wall), height], [0.0, 0.0, 0.5 * height]
            extents[axis], position[axis] = wall, sign * (half + 0.5 * wall)
            scene.add_body(box(extents), kind="static", position=position, name=f"wall_{'xy'[axis]}{sign:+.0f}")
    for index in range(count):
        layer, place = divmod(index, side**2)
        row, column = divmod(place, side)
        centre = pitch * (np.array([column, row, layer]) - [0.5 * (side - 1), 0.5 * (side - 1), 0.0])
        scene.add_body(
            box(edge),
            density=1000.0,
            position=(*centre[:2], centre[2] + pitch),
            orientation=_random_quaternion(rng),
            name=f"box_{index}",
        )
    return scene


def tumbling_layers(side: int = 2, *, layers: int = 5, edge: float = 0.2, seed: int = 0) -> Scene:
    """`layers` of `side` x `side` boxes, turned at random and spinning, fall onto the ground and onto each other."""
    scene = Scene()
    scene.add_ground()
    rng = np.random.default_rng(seed)
    extents = (edge, 0.8 * edge, 0.6 * edge)
    pitch = 1.5 * edge  # more than their diagonal of 1.41
    for index in range(layers * side**2):
        layer, place = divmod(index, side**2)
        row, column = divmod(place, side)
        scene.add_body(
            box(extents),
            density=1000.0,
            position=(pitch * column, pitch * row, pitch * (layer + 1)),
            orientation=_random_quaternion(rng),
            angular_velocity=rng.normal(size=3),
            name=f"box_{index}",
        )
    return scene


def heap_of_boxes_and_balls(count: int = 32, *, heaviest: float = 1000.0, seed: int = 0) -> Scene:
    """`count` boxes and faceted balls of 1 to `heaviest` kg fall on each other in four columns.

    Where `heaviest` is large, light ones are squeezed between heavy ones and spun.
    """
    scene = Scene()
    scene.add_ground()
    rng = np.random.default_rng(seed)
    brick, ball = box((0.2, 0.16, 0.12)), icosphere(0.09, subdivisions=1)
    for index in range(count):
        corner = 0.28 * np.array([index % 2, index // 2 % 2]) - 0.14 + rng.uniform(-0.01, 0.01, 2)
        scene.add_body(
            brick if index % 2 else ball,
            mass=heaviest ** rng.uniform(),
            position=(*corner, 0.2 + 0.3 * (index // 4)),
            orientation=_random_quaternion(rng),
            name=f"{'box' if index % 2 else 'ball'}_{index}",
        )
    return scene


def touching_boxes(count: int = 10, *, edge: float = 0.2, gap: float = 1e-3) -> Scene:
    """`count` cubes of `edge` [m] on the ground two by two, side against side, `gap` [m] apart; pairs stand apart."""
    scene = Scene()
    scene.add_ground()
    for index in range(count):
        column, row = divmod(index, 2)
        position = (2.0 * edge * column, (edge + gap) * row, 0.5 * edge + gap)
        scene.add_body(box(edge), density=1000.0, position=position, name=f"box_{index}")
    return scene


def _random_quaternion(rng: np.random.Generator) -> NDArray[np.float64]:
    q = rng.normal(size=4)
    return np.asarray(q / np.linalg.norm(q))
