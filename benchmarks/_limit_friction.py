"""Scenes of the limits suite that friction decides."""

from __future__ import annotations

import math

import numpy as np

import diffsim as ds

G = 9.81  # [m/s²]
SLOPE = math.radians(20.0)


def _down_a_slope() -> tuple[float, float, float]:
    """Gravity in the axes of a slope that falls along x."""
    return (G * math.sin(SLOPE), 0.0, -G * math.cos(SLOPE))


def _leaning(angle: float) -> list[float]:
    """The orientation that takes x to an angle [rad] above it, in the xz plane."""
    return [float(x) for x in ds.rotation.from_rpy(np.array([0.0, -angle, 0.0]))]


def box_on_a_slope(friction: float) -> ds.Scene:
    """It is set on in motion downhill."""
    scene = ds.Scene(gravity=_down_a_slope())
    scene.add_ground(friction=friction)
    box = ds.shapes.box((0.4, 0.4, 0.2))
    scene.add_body(box, density=500.0, position=(0.0, 0.0, 0.101), velocity=(0.5, 0.0, 0.0), friction=friction)
    return scene


def ball_on_a_slope(friction: float) -> ds.Scene:
    """It falls a little, spinning about all axes."""
    scene = ds.Scene(gravity=_down_a_slope())
    scene.add_ground(friction=friction)
    scene.add_sphere(
        0.1, density=500.0, position=(0.0, 0.0, 0.12), angular_velocity=(5.0, -10.0, 3.0), friction=friction
    )
    return scene


def heap(friction: float, count: int = 5) -> ds.Scene:
    """Bricks fall on each other."""
    scene = ds.Scene()
    scene.add_ground(friction=friction)
    for k in range(count):
        turned = ds.rotation.from_rpy(np.array([0.3 * k, 0.2 - 0.1 * k, 0.5 * k]))
        position = (0.03 * (-1) ** k, 0.02 * k, 0.15 + 0.22 * k)
        brick = ds.shapes.box((0.2, 0.16, 0.12))
        scene.add_body(brick, density=500.0, position=position, orientation=turned, friction=friction)
    return scene


# ---- card houses -----------------------------------------------------------------------------------------------------

CARD = (0.5, 0.3, 0.02)  # length, width, thickness [m]
LEAN = math.radians(65.0)


def card_house(levels: int, friction: float) -> ds.Scene:
    """A-frames of two cards that lean on each other, and cards that lie on them for the next level.

    All edges that meet are a card's default thickness apart, so that the house stands from the start.
    """
    scene = ds.Scene()
    scene.add_ground(friction=friction)
    length, _, thick = CARD
    gap = 1e-3 * thick
    across = length * math.cos(LEAN) + thick * math.sin(LEAN)  # extents of a card that leans
    height = length * math.sin(LEAN) + thick * math.cos(LEAN)
    pitch = 2.0 * across + thick  # from one frame to the next
    floor = gap
    for level in range(levels):
        frames = levels - level
        for x in (pitch * (k - 0.5 * (frames - 1)) for k in range(frames)):
            for side in (-1, 1):
                angle = LEAN if side < 0 else math.pi - LEAN
                place = (x + side * 0.5 * (across + gap), 0.0, floor + 0.5 * height)
                scene.add_body(
                    ds.shapes.box(CARD), density=700.0, position=place, orientation=_leaning(angle), friction=friction
                )
        floor += height + gap
        for x in (pitch * (k - 0.5 * (frames - 2)) for k in range(frames - 1)):
            lying = ds.shapes.box((pitch - thick if frames > 2 else pitch + 4.0 * thick, *CARD[1:]))
            scene.add_body(lying, density=700.0, position=(x, 0.0, floor + 0.5 * thick), friction=friction)
        floor += thick + gap
    return scene


# ---- jams ------------------------------------------------------------------------------------------------------------

WALLS_APART = 0.2  # [m], and two thicknesses
CLOSES = 1e-4  # [m/s]: by a quarter of the thickness in half a second


def box_between_walls(friction: float) -> ds.Scene:
    """It hangs there, one wall slowly closing in."""
    scene = ds.Scene()
    wall = (0.2, 0.6, 0.6)
    gap = 1e-3 * WALLS_APART
    scene.add_body(ds.shapes.box(WALLS_APART), density=500.0, position=(0.0, 0.0, 1.0), friction=friction)
    away = 0.5 * (WALLS_APART + wall[0]) + gap
    scene.add_body(ds.shapes.box(wall), kind="static", position=(-away, 0.0, 1.0), friction=friction)
    scene.add_body(
        ds.shapes.box(wall),
        kind="kinematic",
        position=(away, 0.0, 1.0),
        velocity=(-CLOSES, 0.0, 0.0),
        friction=friction,
    )
    return scene


def rod_on_its_tip(friction: float, speed: float, degrees: float = 63.0) -> ds.Scene:
    """Painlevé's: it leans towards +x and its tip slides at `speed` [m/s], against the lean if that is negative."""
    rod = (1.0, 0.04, 0.04)
    angle = math.radians(degrees)
    height = 0.5 * (rod[0] * math.sin(angle) + rod[2] * math.cos(angle)) + 1e-3 * rod[2]
    scene = ds.Scene()
    scene.add_ground(friction=friction)
    scene.add_body(
        ds.shapes.box(rod),
        density=500.0,
        position=(0.0, 0.0, height),
        orientation=_leaning(angle),
        velocity=(speed, 0.0, 0.0),
        friction=friction,
    )
    return scene
