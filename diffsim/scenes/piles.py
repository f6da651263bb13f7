"""Scenes of many equal cubes, for benchmarks and scaling."""

from __future__ import annotations

import math

from ..scene import Scene
from ..shapes import box


def falling_cubes(count: int = 20, *, drop: float = 0.5, stride: float = 2.0, density: float = 1000.0) -> Scene:
    """Unit cubes in a square grid, `drop` [m] above the ground, their centres `stride` [m] apart: they never meet."""
    scene = Scene()
    scene.add_ground()
    side = math.isqrt(count - 1) + 1
    mesh = box(1.0)
    for index in range(count):
        row, column = divmod(index, side)
        position = (stride * column, stride * row, drop + 0.5)
        scene.add_body(mesh, density=density, position=position, name=f"cube_{index}")
    return scene


def row_of_cubes(count: int = 20, *, edge: float = 0.1, spacing: float = 0.18, height: float = 0.2) -> Scene:
    """Cubes in a row above the ground, as in Table 1 of Qiao et al. 2020, their bases between 0 and twice `height` [m].

    Bases are spread by the golden ratio instead of at random, so that the scene is always the same.
    """
    scene = Scene(gravity=(0.0, 0.0, -9.8))
    scene.add_ground()
    mesh = box(edge)
    for index in range(count):
        base = 2.0 * height * (((index + 0.5) * 0.6180339887498949) % 1.0)
        scene.add_body(mesh, density=1000.0, position=(spacing * index, 0.0, base + 0.5 * edge), name=f"cube_{index}")
    return scene


def two_layer_stack(count: int = 20, *, edge: float = 0.1, gap: float = 0.001) -> Scene:
    """`count` cubes in a row with `count - 1` on top, each across two, as in Table 2 of Qiao et al. 2020.

    One connected stack, with `gap` [m] below, between and beside the cubes.
    """
    scene = Scene(gravity=(0.0, 0.0, -9.8))
    scene.add_ground()
    mesh, pitch = box(edge), edge + gap
    for index in range(count):
        position = (pitch * index, 0.0, gap + 0.5 * edge)
        scene.add_body(mesh, density=1000.0, position=position, name=f"bottom_{index}")
    for index in range(count - 1):
        position = (pitch * (index + 0.5), 0.0, gap + edge + gap + 0.5 * edge)
        scene.add_body(mesh, density=1000.0, position=position, name=f"top_{index}")
    return scene
