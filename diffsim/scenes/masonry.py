"""What friction holds together."""

from __future__ import annotations

import math

import numpy as np

from .. import rotation
from ..scene import Scene
from ..shapes import box, prism


def arch(
    stones: int = 10,
    *,
    friction: float = 0.7,
    radius: float = 1.0,
    ring: float = 0.25,
    depth: float = 0.4,
    gap: float = 1e-4,
    abutments: bool = False,
) -> Scene:
    """A semicircular arch of wedge-shaped stones in the xz plane, on the ground or on two fixed abutments.

    Args:
        stones: How many, all alike.
        friction: Coulomb's coefficient of all that is in it.
        radius: Of its inner side [m].
        ring: Of the stones, across the arch [m].
        depth: Of the stones, along y [m].
        gap: Between the parallel faces that meet [m]. With `Simulator(thickness=gap)` it stands from the start.
        abutments: Two static blocks in place of the ground.
    """
    scene = Scene()
    half = 0.5 * math.pi / stones
    corners = [  # of the upper side of a stone whose middle is along x: half a gap below the joint
        (r * math.cos(half), r * math.sin(half) - 0.5 * gap / math.cos(half)) for r in (radius, radius + ring)
    ]
    stone = prism([(x, -y) for x, y in corners] + [(x, y) for x, y in reversed(corners)], depth)
    for index in range(stones):
        turned = _quaternion(0.5 * math.pi, -(2 * index + 1) * half)
        scene.add_body(
            stone,
            density=2000.0,
            position=(0.0, 0.0, 0.5 * gap),
            orientation=turned,
            friction=friction,
            name=f"stone_{index}",
        )
    if not abutments:
        scene.add_ground(friction=friction)
        return scene
    for side in (-1, 1):
        place = (side * (radius + 0.5 * ring), 0.0, -0.5 * ring)
        block = box((2.0 * ring, 2.0 * depth, ring))
        scene.add_body(block, kind="static", position=place, friction=friction, name=f"abutment_{side:+d}")
    return scene


def _quaternion(roll: float, pitch: float) -> list[float]:
    return [float(x) for x in rotation.from_rpy(np.array([roll, pitch, 0.0]))]
