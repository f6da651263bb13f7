"""Impacts and rest without friction in the work-precision report."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from _report_motion import (
    HARD,
    LOOSE,
    MUJOCO,
    SECOND_ORDER,
    TENTHS,
    G,
    Motion,
    ValueScene,
    diffsim,
    energy_made,
    penetration,
    rms,
)

import diffsim as ds
from diffsim import scenes


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


def creep(motion: Motion, _: Motion | None) -> float:
    settled = len(motion.states.position) // 4
    moved = motion.states.position[settled:] - motion.states.position[settled]
    return float(moved[..., :2].norm(dim=-1).max())


def _stack_depth(motion: Motion, _: Motion | None) -> float:
    return penetration(stack(), motion)


def _bin() -> ds.Scene:
    return scenes.boxes_in_bin(20)


def _bin_depth(motion: Motion, _: Motion | None) -> float:
    return penetration(_bin(), motion)


def _pile() -> ds.Scene:
    return scenes.tumbling_layers(2)


def _pile_depth(motion: Motion, _: Motion | None) -> float:
    return penetration(_pile(), motion)


# ---- the table -------------------------------------------------------------------------------------------------------

_HEAPS = (
    "Why: in a heap a step of ours takes 8 to 30 times as long as one of MuJoCo. Each near pair of vertex and face, or"
    " of two edges, is a contact, and a step is solved until none is violated. MuJoCo has at most eight contacts for"
    " two boxes, which give way by millimetres and take energy as dampers do. That it makes none with large steps is"
    " chance: with smaller ones it makes some."
)

IMPACTS = (
    ValueScene(
        "landing",
        "A ball lands and stays",
        "free fall, then rest",
        landing,
        0.8,
        TENTHS,
        {"height (rms over time) [m]": _landing_height, "deepest penetration [m]": _landing_depth},
        (diffsim(), SECOND_ORDER, HARD, *MUJOCO),
    ),
    ValueScene(
        "push",
        "A ball runs into another",
        "conservation of momentum, e = 0",
        push,
        0.8,
        TENTHS,
        {"centres at the end (rms) [m]": _balls_error},
        (diffsim(), SECOND_ORDER, HARD, *MUJOCO),
    ),
    ValueScene(
        "oblique",
        "Oblique impact without friction",
        "impulse along the normal, e = 0",
        oblique,
        0.8,
        TENTHS,
        {"centres at the end (rms) [m]": _balls_error},
        (diffsim(), SECOND_ORDER, HARD, *MUJOCO),
    ),
    ValueScene(
        "stack",
        "Five boxes at rest for 60 s",
        "rest",
        stack,
        60.0,
        (0.02, 0.01, 0.005),
        {"creep sideways [m]": creep, "deepest penetration [m]": _stack_depth},
        (diffsim(), SECOND_ORDER, HARD, LOOSE, *MUJOCO),
        note="Without friction nothing holds a stack sideways: boxes that stand off their middles tilt by what contacts"
        " give way, and slide. Hard contacts (`compliance=0`) give nothing.",
    ),
    ValueScene(
        "bin",
        "Twenty boxes fall into a bin",
        "no depth, no energy made",
        _bin,
        1.5,
        (0.02, 0.01, 0.005, 0.0025),
        {"deepest penetration [m]": _bin_depth, "energy made / energy lost": energy_made},
        (diffsim(), SECOND_ORDER, LOOSE, *MUJOCO),
        note=_HEAPS,
    ),
    ValueScene(
        "pile",
        "Twenty spinning boxes pile up",
        "no depth, no energy made",
        _pile,
        1.0,
        (0.02, 0.01, 0.005, 0.0025),
        {"deepest penetration [m]": _pile_depth, "energy made / energy lost": energy_made},
        (diffsim(), SECOND_ORDER, LOOSE, *MUJOCO),
        note=_HEAPS,
    ),
)
