"""Smooth motion in the work-precision report: nothing touches."""

from __future__ import annotations

from typing import Any

import numpy as np
from _report_motion import MUJOCO_SMOOTH, SECOND_ORDER, TENTHS, G, Motion, ValueScene, diffsim, rms

import diffsim as ds


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


def _energy(motion: Motion, _: Motion | None) -> float:
    energy = motion.sim.kinetic_energy(motion.states).detach()
    return float((energy / motion.sim.kinetic_energy(motion.start) - 1.0).abs().max())


# A coin that was tossed: it spins about its axis, and wobbles at almost twice that rate.
_COIN_SPIN = (3.0, 0.0, 12.0)  # [rad/s]


def _coin() -> ds.Scene:
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    angles = 2.0 * np.pi * np.arange(32) / 32
    outline = 0.1 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    scene.add_body(ds.shapes.prism(outline.tolist(), 0.02), density=1000.0, angular_velocity=_COIN_SPIN)
    return scene


def symmetric_attitude(inertia: np.ndarray, spin: np.ndarray, time: float) -> np.ndarray:
    """Rotation matrix, body to world, of a free body with I1 = I2, upright and turning by `spin` at first.

    The spin is L/I1, about a fixed axis, plus (1 - I3/I1) w3 about the body's own.
    """
    across, along = inertia[0, 0], inertia[2, 2]
    fixed, own = inertia @ spin / across, np.array([0.0, 0.0, (1.0 - along / across) * spin[2]])
    first, second = (ds.rotation.to_matrix(ds.rotation.exp(turn * time)) for turn in (fixed, own))
    return np.asarray(first @ second)


def _coin_angle(motion: Motion, _: Motion | None) -> float:
    inertia = motion.sim.inertia[0].detach().numpy()
    found = ds.rotation.to_matrix(motion.states.orientation[-1, 0]).numpy()
    exact = symmetric_attitude(inertia, np.array(_COIN_SPIN), float(motion.times()[-1]))
    return float(np.linalg.norm(found - exact) / np.sqrt(2.0))


# ---- the table -------------------------------------------------------------------------------------------------------

_CALL = (
    "Why: a call of ours from Python takes 0.2 to 0.4 ms whatever it does, of which runs of few steps consist. Its"
    " steps take half as long as MuJoCo's."
)
_ORDER = _CALL + " RK4 is of fourth order, ours of second at best: of smooth motion alone it makes the smallest errors."

FREE = (
    ValueScene(
        "projectile",
        "Projectile",
        "the parabola",
        _projectile,
        1.0,
        TENTHS,
        {"path (rms) [m]": _projectile_error},
        (diffsim(), SECOND_ORDER, *MUJOCO_SMOOTH),
        note=_CALL,
    ),
    ValueScene(
        "brick",
        "Tumbling brick (Dzhanibekov)",
        "Jacobi's elliptic functions",
        _brick,
        4.0,
        TENTHS,
        {"attitude after 4 s [rad]": _brick_angle, "relative error of the energy": _energy},
        (diffsim(), SECOND_ORDER, *MUJOCO_SMOOTH),
        note=_ORDER,
    ),
    ValueScene(
        "coin",
        "A tossed coin wobbles",
        "a free symmetric top",
        _coin,
        2.0,
        TENTHS,
        {"attitude after 2 s [rad]": _coin_angle, "relative error of the energy": _energy},
        (diffsim(), SECOND_ORDER, *MUJOCO_SMOOTH),
        note=_ORDER,
    ),
)
