"""Coulomb friction in the work-precision report."""

from __future__ import annotations

import math

import numpy as np
import torch
from _mujoco import Settings
from _report_cloth import CLOTH_DTS, CLOTH_LIMIT_DT, LINEARISED, draped, in_the_ball, nodes_error
from _report_flex import MUJOCO_SHEETS
from _report_impacts import creep
from _report_motion import LOOSE, SECOND_ORDER, TENTHS, G, Motion, ValueScene, diffsim, mujoco_bodies, penetration, rms
from torch import Tensor

import diffsim as ds

ROUGH, SLIPPERY = 0.5, 0.1
THIN = 1e-5  # margins of what is held against a closed form [m]
ELLIPTIC = Settings("implicitfast", cone="elliptic")
CREEPS_LEAST = Settings("implicitfast", cone="elliptic", impratio=100.0)
PEERS = (
    Settings("Euler"),
    Settings("implicitfast"),
    ELLIPTIC,
    CREEPS_LEAST,
    Settings("implicitfast", cone="elliptic", impratio=100.0, stiff=True),
)
MUJOCO = tuple(map(mujoco_bodies, PEERS))


def slope(degrees: float) -> tuple[float, float, float]:
    """Gravity in the axes of a slope that falls along x."""
    angle = math.radians(degrees)
    return G * math.sin(angle), 0.0, -G * math.cos(angle)


def _box(degrees: float, mu: float, speed: float = 0.0) -> ds.Scene:
    scene = ds.Scene(gravity=slope(degrees))
    scene.add_ground(friction=mu, margin=THIN)
    scene.add_body(
        ds.shapes.box((1.0, 1.0, 0.4)),
        density=1000.0,
        position=(0.0, 0.0, 0.2 + 2.0 * THIN),
        velocity=(speed, 0.0, 0.0),
        friction=mu,
        margin=THIN,
    )
    return scene


def _along(motion: Motion, exact: np.ndarray) -> float:
    """Of the way along x, over time."""
    return float(np.sqrt(np.square(motion.states.position[:, 0, 0].numpy() - exact).mean()))


# ---- sliding, and coming to rest -------------------------------------------------------------------------------------

SPEED = 2.0  # [m/s]; it stops after 0.41 s


def slide_to_rest() -> ds.Scene:
    return _box(0.0, ROUGH, SPEED)


def _stopping(motion: Motion, _: Motion | None) -> float:
    t = np.minimum(motion.times(), SPEED / (ROUGH * G))
    return _along(motion, SPEED * t - 0.5 * ROUGH * G * t**2)


def _moves_at_rest(motion: Motion, _: Motion | None) -> float:
    """Over the last half second [m]."""
    last = motion.states.position[-round(0.5 / motion.dt) - 1 :, 0, :2]
    return float((last[-1] - last[0]).norm())


STEEP = 30.0  # [°]


def _incline() -> ds.Scene:
    return _box(STEEP, SLIPPERY)


def _incline_error(motion: Motion, _: Motion | None) -> float:
    down, _, into = slope(STEEP)
    return _along(motion, 0.5 * (down + SLIPPERY * into) * motion.times() ** 2)


def _speed_error(motion: Motion, _: Motion | None) -> float:
    """Of the acceleration over the second half, relative."""
    down, _, into = slope(STEEP)
    speed, half = motion.states.velocity[:, 0, 0], len(motion.states.velocity) // 2
    found = float(speed[-1] - speed[half - 1]) / (motion.dt * (len(speed) - half))
    return abs(found / (down + SLIPPERY * into) - 1.0)


RADIUS, GENTLE = 0.1, 20.0  # [m], [°]


def rolling() -> ds.Scene:
    scene = ds.Scene(gravity=slope(GENTLE))
    scene.add_ground(friction=ROUGH, margin=THIN)
    scene.add_sphere(RADIUS, density=1000.0, position=(0.0, 0.0, RADIUS + THIN), friction=ROUGH)
    return scene


def _rolling_error(motion: Motion, _: Motion | None) -> float:
    return _along(motion, 5.0 / 14.0 * slope(GENTLE)[0] * motion.times() ** 2)


def _slip(motion: Motion, _: Motion | None) -> float:
    """How fast the ball's lowest point moves at most, after a tenth of a second [m/s]."""
    states = motion.states
    slip = states.velocity[:, 0, 0] - RADIUS * states.angular_velocity[:, 0, 1]
    return float(slip[round(0.1 / motion.dt) :].abs().max())


def leaning_stack() -> ds.Scene:
    """Five boxes on each other, on a slope of 10°."""
    scene = ds.Scene(gravity=slope(10.0))
    scene.add_ground(friction=ROUGH)
    for k in range(5):
        turned = (np.cos(0.1 * k), 0.0, 0.0, np.sin(0.1 * k))
        scene.add_body(
            ds.shapes.box(0.2),
            density=1000.0,
            position=(-0.02 * k, 0.0, 0.1 + 0.2 * k),
            orientation=turned,
            friction=ROUGH,
        )
    return scene


def _stack_depth(motion: Motion, _: Motion | None) -> float:
    return penetration(leaning_stack(), motion)


# ---- a ball is thrown: it lands, slides, and rolls -------------------------------------------------------------------

BOWLED = 1.0  # [s]


def bowling() -> ds.Scene:
    scene = ds.Scene()
    scene.add_ground(friction=SLIPPERY, margin=THIN)
    scene.add_sphere(
        RADIUS,
        density=1000.0,
        position=(0.0, 0.0, 0.5137),  # lands at the end of no step
        velocity=(2.5, 0.0, 0.0),
        angular_velocity=(3.0, 2.0, 0.0),
        friction=SLIPPERY,
    )
    return scene


def bowled(position: Tensor, velocity: Tensor, spin: Tensor, mu: Tensor | float, time: float) -> Tensor:
    """Where the ball is in the end, shape (3,), from vectors (3,); differentiable. It lands, e = 0, slides and rolls.

    While it slips its velocity changes along the slip, whose direction stays, and the slip 7/2 times as fast.
    """
    down = torch.sqrt(velocity[2] ** 2 + 2.0 * G * (position[2] - RADIUS))
    lands = (velocity[2] + down) / G
    slip = velocity[:2] + RADIUS * torch.stack([-spin[1], spin[0]])
    speed = slip.norm()
    against = -slip / speed
    landed = velocity[:2] + mu * down * against
    slides = (speed - 3.5 * mu * down) / (3.5 * mu * G)
    rolls = landed + mu * G * slides * against
    x = position[:2] + lands * velocity[:2] + slides * 0.5 * (landed + rolls) + (time - lands - slides) * rolls
    return torch.cat([x, torch.full((1,), RADIUS, dtype=torch.float64)])


def _bowled_error(motion: Motion, _: Motion | None) -> float:
    s = motion.start
    exact = bowled(s.position[0], s.velocity[0], s.angular_velocity[0], SLIPPERY, float(motion.times()[-1]))
    return rms((motion.states.position[-1, 0] - exact)[:2].numpy())


# ---- a top on its tip ------------------------------------------------------------------------------------------------

TOP_HEIGHT, TOP_RADIUS, TOP_TILT, TOP_SPIN = 0.05, 0.1, 0.3, 40.0  # [m], [m], [rad], [rad/s]


def _top() -> ds.Scene:
    """A cone that stands on its tip, which friction holds: the heavy symmetric top."""
    scene = ds.Scene()
    scene.add_ground(friction=1.0, margin=0.1 * THIN)
    sides = 24
    angles = 2.0 * np.pi * np.arange(sides) / sides
    rim = np.stack([TOP_RADIUS * np.cos(angles), TOP_RADIUS * np.sin(angles), np.full(sides, TOP_HEIGHT)], axis=1)
    following = np.roll(np.arange(sides), -1)
    tip, middle = np.full(sides, sides), np.full(sides, sides + 1)
    faces = np.concatenate(
        [np.stack([following, np.arange(sides), tip], 1), np.stack([np.arange(sides), following, middle], 1)]
    )
    mesh = (np.concatenate([rim, [[0.0, 0.0, 0.0], [0.0, 0.0, TOP_HEIGHT]]]), faces)
    axis = np.array([np.sin(TOP_TILT), 0.0, np.cos(TOP_TILT)])
    scene.add_body(
        mesh,
        density=1000.0,
        position=(0.0, 0.0, 0.2 * THIN),
        orientation=(np.cos(0.5 * TOP_TILT), 0.0, np.sin(0.5 * TOP_TILT), 0.0),
        angular_velocity=TOP_SPIN * axis,
        friction=1.0,
        margin=0.1 * THIN,
    )
    return scene


def top_axis(start: np.ndarray, spin: float, inertia: tuple[float, float], moment: float, time: float) -> np.ndarray:
    """Where the axis of a symmetric top points whose tip is held, by DOP853 to 1e-12.

    `inertia`: across, about the tip, and along; `moment`: of its weight about the tip were it lying down [N·m].
    """
    from scipy.integrate import solve_ivp

    def rate(_: float, y: np.ndarray) -> np.ndarray:
        axis, momentum = y[:3], y[3:]
        return np.concatenate([np.cross(momentum, axis) / inertia[0], moment * np.cross([0.0, 0.0, 1.0], axis)])

    begin = np.concatenate([start, inertia[1] * spin * start])
    return np.asarray(solve_ivp(rate, (0.0, time), begin, method="DOP853", rtol=1e-12, atol=1e-13).y[:3, -1])


def _top_error(motion: Motion, _: Motion | None) -> float:
    start = ds.rotation.to_matrix(motion.start.orientation[0]).numpy()[:, 2]
    found = ds.rotation.to_matrix(motion.states.orientation[-1, 0]).numpy()[:, 2]
    mass, inertia = float(motion.sim.mass[0]), motion.sim.inertia[0].detach().numpy()
    height = 0.75 * TOP_HEIGHT
    tensor = inertia[0, 0] + mass * height**2, inertia[2, 2]
    exact = top_axis(start, TOP_SPIN, tensor, mass * G * height, float(motion.times()[-1]))
    return float(np.linalg.norm(found - exact))


# ---- a sheet that friction holds -------------------------------------------------------------------------------------


def draped_with_friction() -> ds.Scene:
    return draped(ROUGH)


# ---- the table -------------------------------------------------------------------------------------------------------

_OURS = (diffsim(), SECOND_ORDER)
_FIRST_ORDER = (
    "Why: to errors of first-order steps peers come sooner, since a step of ours with friction takes two to nine times"
    " as long, and a call from Python has its price. To errors that are smaller a hundred times and more `second_order`"
    " takes about twice as long as implicit Euler to its large ones; no peer comes there."
)

FRICTION = (
    ValueScene(
        "slide",
        "A box slides to rest",
        "v t - μ g t² / 2, then rest",
        slide_to_rest,
        1.0,
        TENTHS,
        {"way (rms over time) [m]": _stopping, "moves in the last half second [m]": _moves_at_rest},
        (*_OURS, *MUJOCO),
        note=_FIRST_ORDER,
        quick=True,
    ),
    ValueScene(
        "incline",
        "A box slides down 30°, μ 0.1",
        "a = g (sin 30° - μ cos 30°)",
        _incline,
        1.0,
        TENTHS,
        {"way (rms over time) [m]": _incline_error, "relative error of the acceleration": _speed_error},
        (*_OURS, *MUJOCO),
        note=_FIRST_ORDER,
    ),
    ValueScene(
        "rolling",
        "A ball rolls down 20°",
        "a = 5/7 g sin 20°, and no slip",
        rolling,
        1.0,
        TENTHS,
        {"way (rms over time) [m]": _rolling_error, "slip of the lowest point [m/s]": _slip},
        (*_OURS, *MUJOCO),
        note=_FIRST_ORDER + " A ball that rolls slips by what its turn curves in a step, of second order in all.",
    ),
    ValueScene(
        "bowling",
        "A ball is thrown, lands, slides and rolls",
        "Coulomb's impulse and force, e = 0",
        bowling,
        BOWLED,
        TENTHS,
        {"place at the end [m]": _bowled_error},
        (*_OURS, *MUJOCO),
        note=_FIRST_ORDER,
    ),
    ValueScene(
        "top",
        "A top stands on its tip, which friction holds",
        "the heavy symmetric top, integrated to 1e-12",
        _top,
        1.0,
        TENTHS,
        {"direction of the axis after 1 s [rad]": _top_error},
        (*_OURS, *MUJOCO, mujoco_bodies(Settings("RK4", cone="elliptic"))),
        note="What touches turns by implicit Euler in either of our integrators, which takes from the spin: of first"
        " order, with a large constant. This is a scene for MuJoCo.",
    ),
    ValueScene(
        "leaning_stack",
        "Five boxes at rest on 10° for 20 s",
        "rest",
        leaning_stack,
        20.0,
        (0.02, 0.01, 0.005),
        {"creep down the slope [m]": creep, "deepest penetration [m]": _stack_depth},
        (*_OURS, LOOSE, *MUJOCO),
    ),
    ValueScene(
        "drape_friction",
        "A sheet is laid over a ball, and friction holds it",
        "each simulator's own limit, ours by second_order, and no depth",
        draped_with_friction,
        0.3,
        CLOTH_DTS,
        {"nodes (rms) [m]": nodes_error, "deepest penetration of a node [m]": in_the_ball},
        (diffsim(), SECOND_ORDER, LOOSE, *MUJOCO_SHEETS),
        limit_dt=CLOTH_LIMIT_DT,
        limit=SECOND_ORDER,
        note=LINEARISED,
    ),
)
