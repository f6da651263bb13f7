"""Cloth without friction in the work-precision report, alone and with what falls on it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from _cloth_scenes import DAMPING, DENSITY, POISSON, THICK, YOUNG
from _contact_scenes import scan
from _report_flex import MUJOCO_SHEETS
from _report_motion import LOOSE, SECOND_ORDER, SPLIT, SPLIT_ONCE, Method, Motion, ValueScene, at_times, diffsim, rms

import diffsim as ds

NODES = 11


def sheet_material(damping: float = DAMPING) -> ds.ClothMaterial:
    return ds.ClothMaterial.isotropic(YOUNG, THICK, DENSITY, POISSON, damping)


def swinging_sheet() -> ds.Scene:
    scene = ds.Scene()
    pinned = [0, NODES - 1]
    scene.add_cloth(ds.shapes.sheet(1.0, NODES), sheet_material(), pinned=pinned, margin=0.5 * THICK)
    return scene


def ball_on_sheet(damping: float = DAMPING) -> ds.Scene:
    """A ball falls on a sheet held at its corners."""
    scene = ds.Scene()
    corners = [0, NODES - 1, NODES * (NODES - 1), NODES**2 - 1]
    scene.add_sphere(0.1, mass=0.3, position=(0.013, 0.007, 0.12), velocity=(0.0, 0.0, -1.0), name="ball")
    scene.add_cloth(ds.shapes.sheet(1.0, NODES), sheet_material(damping), pinned=corners, margin=0.5 * THICK)
    return scene


def ball_on_damped_sheet() -> ds.Scene:
    """Damped so that what is struck does not wrinkle."""
    return ball_on_sheet(40.0 * DAMPING)


def figurine_on_sheet() -> ds.Scene:
    """A lumpy thing of 180 faces, which is not convex, in the ball's place."""
    scene = ds.Scene()
    corners = [0, NODES - 1, NODES * (NODES - 1), NODES**2 - 1]
    scene.add_body(scan(180), mass=0.3, position=(0.013, 0.007, 0.13), velocity=(0.0, 0.0, -1.0), name="figurine")
    scene.add_cloth(ds.shapes.sheet(1.0, NODES), sheet_material(), pinned=corners, margin=0.5 * THICK)
    return scene


BALL = 0.25  # of what a sheet is draped over [m]


def draped(friction: float = 0.0) -> ds.Scene:
    """A sheet is laid over a ball, off its middle: without friction it slides down."""
    scene = ds.Scene()
    scene.add_sphere(BALL, kind="static", friction=friction)
    place = (0.05, 0.03, BALL + THICK)
    sheet = ds.shapes.sheet(1.0, NODES)
    scene.add_cloth(sheet, sheet_material(), position=place, margin=0.5 * THICK, friction=friction)
    return scene


def in_the_ball(motion: Motion, _: Motion | None) -> float:
    """How deep a node is at most [m]."""
    return max(0.0, BALL - float(motion.states.node_position.norm(dim=-1).min()))


def nodes_error(motion: Motion, limit: Motion | None) -> float:
    assert limit is not None
    times = np.linspace(0.5, 1.0, 3) * motion.times()[-1]
    found, exact = (at_times(m, m.states.node_position.numpy(), times) for m in (motion, limit))
    return rms(found - exact)


def body_error(motion: Motion, limit: Motion | None) -> float:
    assert limit is not None
    return rms((motion.states.position[-1] - limit.states.position[-1]).numpy())


# ---- the table -------------------------------------------------------------------------------------------------------

LINEARISED = (
    "Why: MuJoCo's `discrete` takes one linearised step and lets things sink in; ours solves the nonlinear one, with"
    " contacts, to the end: two to twenty times as long, the more the larger the step."
)
CLOTH_DTS, CLOTH_LIMIT_DT = (0.02, 0.01, 0.005, 0.0025, 0.00125), 0.0003125


def _falls_on_a_sheet(what: str, title: str, make: Callable[[], ds.Scene], methods: tuple[Method, ...]) -> ValueScene:
    return ValueScene(
        f"{what}_on_sheet",
        title,
        "each simulator's own limit; ours by second_order",
        make,
        0.2,
        CLOTH_DTS,
        {"nodes (rms) [m]": nodes_error, f"{what} at the end [m]": body_error},
        methods,
        limit_dt=CLOTH_LIMIT_DT,
        limit=SECOND_ORDER,
        note=f"{LINEARISED} Its limit is that of its own soft contacts: how deep things sink in is no error here.",
    )


CLOTH = (
    ValueScene(
        "swing",
        "A sheet held by two corners swings",
        "each simulator's own limit; ours by second_order",
        swinging_sheet,
        0.4,
        CLOTH_DTS,
        {"nodes (rms) [m]": nodes_error},
        (diffsim(), SECOND_ORDER, LOOSE, SPLIT_ONCE, *MUJOCO_SHEETS),
        limit_dt=CLOTH_LIMIT_DT,
        limit=SECOND_ORDER,
        quick=True,
        note=f"{LINEARISED} To errors under 2 mm `second_order` comes first, and a hundred times further down.",
    ),
    _falls_on_a_sheet(
        "ball", "A ball falls on a sheet", ball_on_sheet, (diffsim(), SECOND_ORDER, SPLIT, SPLIT_ONCE, *MUJOCO_SHEETS)
    ),
    _falls_on_a_sheet(
        "figurine",
        "A figurine falls on a sheet (MuJoCo: its convex hull)",
        figurine_on_sheet,
        (diffsim(), SECOND_ORDER, SPLIT, SPLIT_ONCE, MUJOCO_SHEETS[0]),
    ),
    ValueScene(
        "drape",
        "A sheet is draped over a ball",
        "each simulator's own limit, ours by second_order, and no depth",
        draped,
        0.3,
        CLOTH_DTS,
        {"nodes (rms) [m]": nodes_error, "deepest penetration of a node [m]": in_the_ball},
        (diffsim(), SECOND_ORDER, LOOSE, SPLIT, *MUJOCO_SHEETS),
        limit_dt=CLOTH_LIMIT_DT,
        limit=SECOND_ORDER,
        note=LINEARISED,
    ),
)
