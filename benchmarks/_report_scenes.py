"""Scenes of the work-precision report whose errors are of motions. One entry of `SCENES` is one scene."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from _cloth_scenes import DAMPING, DENSITY, POISSON, THICK, YOUNG
from _report_flex import mujoco_sheet
from _report_motion import (
    Method,
    Motion,
    at_times,
    diffsim,
    energy_made,
    mujoco_all,
    penetration,
    rms,
)

import diffsim as ds
from diffsim import scenes

G = 9.81
Error = Callable[[Motion, "Motion | None"], float]  # the motion, and the one it is held against where there is one


@dataclass(frozen=True)
class ValueScene:
    name: str
    title: str
    reference: str  # what errors are from, in words
    build: Callable[[], ds.Scene]
    duration: float  # [s]
    steps: Sequence[float]  # dt, large to small [s]
    errors: Mapping[str, Error]  # by the label of their axis
    methods: Sequence[Method]
    limit_dt: float | None = None  # of the run errors are from, without closed form [s]
    quick: bool = False  # part of quick runs


# ---- smooth motion ---------------------------------------------------------------------------------------------------


def _projectile() -> ds.Scene:
    scene = ds.Scene()
    scene.add_sphere(0.1, mass=0.5, position=(0.0, 0.0, 1.0), velocity=(3.0, 0.0, 5.0))
    return scene


def _projectile_error(motion: Motion, _: Motion | None) -> float:
    t = motion.times()[:, None]
    exact = np.array([0.0, 0.0, 1.0]) + t * [3.0, 0.0, 5.0] - 0.5 * t**2 * [0.0, 0.0, G]
    return rms(motion.states.position[:, 0].numpy() - exact)


_BRICK, _SPIN = (1.0, 0.6, 0.3), (0.0, 3.0, 0.05)


def _brick() -> ds.Scene:
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    inertia = np.sort(_brick_inertia())
    scene.add_body(ds.shapes.box(_BRICK), mass=90.0, inertia=np.diag(inertia), angular_velocity=_SPIN)
    return scene


def _brick_inertia() -> np.ndarray:
    a, b, c = np.square(_BRICK)
    return 90.0 / 12.0 * np.array([b + c, a + c, a + b])


def tumbling_attitude(time: float) -> np.ndarray:
    """The brick's rotation matrix, body to world: Jacobi's elliptic functions, and one quadrature for the precession.

    Landau and Lifshitz, Mechanics, §37, for I1 < I2 < I3, M² > 2 E I2, and a start with ω1 = 0: τ = K + rate·t.
    """
    from scipy.special import ellipj, ellipk

    i1, i2, i3 = np.sort(_brick_inertia())
    momentum_sq = (i2 * _SPIN[1]) ** 2 + (i3 * _SPIN[2]) ** 2
    energy2 = i2 * _SPIN[1] ** 2 + i3 * _SPIN[2] ** 2
    low, high = momentum_sq - energy2 * i1, energy2 * i3 - momentum_sq
    rate = np.sqrt((i3 - i2) * low / (i1 * i2 * i3))
    modulus = (i2 - i1) * high / ((i3 - i2) * low)

    def spin(t: Any) -> np.ndarray:
        sn, cn, dn, _ = ellipj(ellipk(modulus) + rate * np.asarray(t), modulus)
        w1 = np.sqrt(high / (i1 * (i3 - i1))) * cn
        w2 = np.sqrt(high / (i2 * (i3 - i2))) * sn
        return np.stack([w1, w2, np.sqrt(low / (i3 * (i3 - i1))) * dn])

    def from_momentum_frame(t: float, precession: float) -> np.ndarray:
        """Body to a frame whose z axis is the angular momentum."""
        m1, m2, m3 = np.array([i1, i2, i3]) * spin(t)
        size = np.hypot(m1, m2)
        c, s = m3 / np.sqrt(momentum_sq), size / np.sqrt(momentum_sq)
        nutation = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
        own = np.array([[m2, -m1, 0.0], [m1, m2, 0.0], [0.0, 0.0, size]]) / size
        c, s = np.cos(precession), np.sin(precession)
        return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ nutation @ own

    nodes, weights = np.polynomial.legendre.leggauss(16)
    pieces = np.linspace(0.0, time, 400)
    half = 0.5 * np.diff(pieces)[:, None]
    w1, w2, _ = spin(pieces[:-1, None] + half * (1.0 + nodes))
    turning = np.sqrt(momentum_sq) * (i1 * w1**2 + i2 * w2**2) / ((i1 * w1) ** 2 + (i2 * w2) ** 2)
    precession = float((half * weights * turning).sum())
    return from_momentum_frame(0.0, 0.0).T @ from_momentum_frame(time, precession)


def _brick_angle(motion: Motion, _: Motion | None) -> float:
    found = ds.rotation.to_matrix(motion.states.orientation[-1, 0]).numpy()
    return float(np.linalg.norm(found - tumbling_attitude(motion.times()[-1])) / np.sqrt(2.0))


def _brick_energy(motion: Motion, _: Motion | None) -> float:
    energy = motion.sim.kinetic_energy(motion.states).detach()
    return float((energy / motion.sim.kinetic_energy(motion.start) - 1.0).abs().max())


# ---- impacts and rest ------------------------------------------------------------------------------------------------


def landing() -> ds.Scene:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_sphere(0.2, density=500.0, position=(0.0, 0.0, 0.7), velocity=(1.0, 0.0, 0.0))
    return scene


def _landing_height(motion: Motion, _: Motion | None) -> float:
    rest = 0.2 + 0.5 * motion.gap
    exact = np.maximum(0.7 - 0.5 * G * motion.times() ** 2, rest)
    return float(np.sqrt(np.square(motion.states.position[:, 0, 2].numpy() - exact).mean()))


def _landing_depth(motion: Motion, _: Motion | None) -> float:
    return max(0.0, 0.2 - float(motion.states.position[:, 0, 2].min()))


# The gap is no multiple of any step: balls that touch just at the end of one have a kink there.
PUSH_GAP, PUSH_SPEED = 0.2137, 1.0


def push() -> ds.Scene:
    """A ball of 1 kg runs into one of 2 kg at rest; no gravity."""
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_sphere(0.1, mass=1.0, velocity=(PUSH_SPEED, 0.0, 0.0), name="first")
    scene.add_sphere(0.1, mass=2.0, position=(0.2 + PUSH_GAP, 0.0, 0.0), name="second")
    return scene


def oblique() -> ds.Scene:
    """The same off the line of centres."""
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_sphere(0.1, mass=1.0, velocity=(PUSH_SPEED, 0.0, 0.0), name="first")
    scene.add_sphere(0.1, mass=2.0, position=(0.2 + PUSH_GAP, 0.1, 0.0), name="second")
    return scene


def two_balls(position: torch.Tensor, velocity: torch.Tensor, mass: torch.Tensor, time: float) -> Any:
    """Centres after the inelastic, frictionless impact of two balls of radius 0.1 m, shape (2, 3); differentiable."""
    apart, closing = position[1] - position[0], velocity[1] - velocity[0]
    a, b, c = closing @ closing, apart @ closing, apart @ apart - 0.2**2
    impact = -(b + torch.sqrt(b * b - a * c)) / a
    normal = (apart + impact * closing) / 0.2
    impulse = (closing @ normal) / (1.0 / mass).sum()
    after = velocity + torch.stack([impulse / mass[0] * normal, -impulse / mass[1] * normal])
    return position + impact * velocity + (time - impact) * after


def _balls_error(motion: Motion, _: Motion | None) -> float:
    s, m = motion.start, motion.sim.mass.detach()
    exact = two_balls(s.position, s.velocity, m, float(motion.times()[-1]))
    return rms((motion.states.position[-1] - exact).numpy())


def stack() -> ds.Scene:
    """Five boxes on each other, each turned a little, touching."""
    scene = ds.Scene()
    scene.add_ground()
    for k in range(5):
        turned = (np.cos(0.1 * k), 0.0, 0.0, np.sin(0.1 * k))
        scene.add_body(ds.shapes.box(0.2), density=1000.0, position=(0.01 * k, 0.0, 0.1 + 0.2 * k), orientation=turned)
    return scene


def _creep(motion: Motion, _: Motion | None) -> float:
    settled = len(motion.states.position) // 4
    moved = motion.states.position[settled:] - motion.states.position[settled]
    return float(moved[..., :2].norm(dim=-1).max())


def _stack_depth(motion: Motion, _: Motion | None) -> float:
    return penetration(stack(), motion)


def _bin() -> ds.Scene:
    return scenes.boxes_in_bin(20)


def _bin_depth(motion: Motion, _: Motion | None) -> float:
    return penetration(_bin(), motion)


def _made(motion: Motion, _: Motion | None) -> float:
    return energy_made(motion)


# ---- cloth -----------------------------------------------------------------------------------------------------------

NODES = 11


def sheet_material() -> ds.ClothMaterial:
    return ds.ClothMaterial.isotropic(YOUNG, THICK, DENSITY, POISSON, DAMPING)


def swinging_sheet() -> ds.Scene:
    scene = ds.Scene()
    pinned = [0, NODES - 1]
    scene.add_cloth(ds.shapes.sheet(1.0, NODES), sheet_material(), pinned=pinned, margin=0.5 * THICK)
    return scene


def ball_on_sheet() -> ds.Scene:
    """A ball falls on a sheet held at its corners."""
    scene = ds.Scene()
    corners = [0, NODES - 1, NODES * (NODES - 1), NODES**2 - 1]
    scene.add_sphere(0.1, mass=0.3, position=(0.013, 0.007, 0.12), velocity=(0.0, 0.0, -1.0), name="ball")
    scene.add_cloth(ds.shapes.sheet(1.0, NODES), sheet_material(), pinned=corners, margin=0.5 * THICK)
    return scene


def _nodes_error(motion: Motion, limit: Motion | None) -> float:
    assert limit is not None
    times = np.linspace(0.5, 1.0, 3) * motion.times()[-1]
    found, exact = (at_times(m, m.states.node_position.numpy(), times) for m in (motion, limit))
    return rms(found - exact)


def _ball_error(motion: Motion, limit: Motion | None) -> float:
    assert limit is not None
    return rms((motion.states.position[-1] - limit.states.position[-1]).numpy())


_SPLIT = (
    diffsim("diffsim split", coupling="split"),
    diffsim("diffsim split 1 Newton", coupling="split", newton_iterations=1),
)

# ---- the table -------------------------------------------------------------------------------------------------------

_HARD = diffsim("diffsim compliance=0", compliance=0.0)
_LOOSE = diffsim("diffsim tolerance=1e-4", tolerance=1e-4)
_TRAPEZOIDAL = diffsim("diffsim trapezoidal", integrator="trapezoidal")
_TENTHS = (0.04, 0.02, 0.01, 0.005, 0.0025, 0.00125)

SCENES = (
    ValueScene(
        "projectile",
        "Projectile",
        "the parabola",
        _projectile,
        1.0,
        _TENTHS,
        {"path (rms) [m]": _projectile_error},
        (diffsim(), _TRAPEZOIDAL, *mujoco_all()[:3]),
    ),
    ValueScene(
        "brick",
        "Tumbling brick (Dzhanibekov)",
        "Jacobi's elliptic functions",
        _brick,
        4.0,
        _TENTHS,
        {"attitude after 4 s [rad]": _brick_angle, "relative error of the energy": _brick_energy},
        (diffsim(), _TRAPEZOIDAL, *mujoco_all()[:3]),
        quick=True,
    ),
    ValueScene(
        "landing",
        "A ball lands and stays",
        "free fall, then rest",
        landing,
        0.8,
        _TENTHS,
        {"height (rms over time) [m]": _landing_height, "deepest penetration [m]": _landing_depth},
        (diffsim(), _TRAPEZOIDAL, _HARD, *mujoco_all()),
        quick=True,
    ),
    ValueScene(
        "push",
        "A ball runs into another",
        "conservation of momentum, e = 0",
        push,
        0.8,
        _TENTHS,
        {"centres at the end (rms) [m]": _balls_error},
        (diffsim(), _TRAPEZOIDAL, _HARD, *mujoco_all()),
    ),
    ValueScene(
        "oblique",
        "Oblique impact without friction",
        "impulse along the normal, e = 0",
        oblique,
        0.8,
        _TENTHS,
        {"centres at the end (rms) [m]": _balls_error},
        (diffsim(), _TRAPEZOIDAL, _HARD, *mujoco_all()),
    ),
    ValueScene(
        "stack",
        "Five boxes at rest for 60 s",
        "rest",
        stack,
        60.0,
        (0.02, 0.01, 0.005),
        {"creep sideways [m]": _creep, "deepest penetration [m]": _stack_depth},
        (diffsim(), _TRAPEZOIDAL, _LOOSE, *mujoco_all()),
    ),
    ValueScene(
        "bin",
        "Twenty boxes fall into a bin",
        "no depth, no energy made",
        _bin,
        1.5,
        (0.02, 0.01, 0.005, 0.0025),
        {"deepest penetration [m]": _bin_depth, "energy made / energy lost": _made},
        (diffsim(), _TRAPEZOIDAL, _LOOSE, *mujoco_all()),
    ),
    ValueScene(
        "swing",
        "A sheet held by two corners swings",
        "each simulator's own limit",
        swinging_sheet,
        0.4,
        (0.02, 0.01, 0.005, 0.0025, 0.00125),
        {"nodes (rms) [m]": _nodes_error},
        (diffsim(), _LOOSE, *_SPLIT[1:], mujoco_sheet("discrete"), mujoco_sheet("Euler"), mujoco_sheet("RK4")),
        limit_dt=0.0003125,
        quick=True,
    ),
    ValueScene(
        "ball_on_sheet",
        "A ball falls on a sheet",
        "each simulator's own limit; splits': the monolithic one's",
        ball_on_sheet,
        0.2,
        (0.02, 0.01, 0.005, 0.0025, 0.00125),
        {"nodes (rms) [m]": _nodes_error, "ball at the end [m]": _ball_error},
        (diffsim(), *_SPLIT, mujoco_sheet("discrete"), mujoco_sheet("Euler"), mujoco_sheet("RK4")),
        limit_dt=0.0003125,
    ),
)
