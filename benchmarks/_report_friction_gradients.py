"""Gradients through Coulomb friction in the work-precision report."""

from __future__ import annotations

import torch
from _mujoco import Settings
from _report_friction import (
    BOWLED,
    CREEPS_LEAST,
    ELLIPTIC,
    GENTLE,
    RADIUS,
    bowled,
    bowling,
    rolling,
    slide_to_rest,
    slope,
)
from _report_gradients import GradientScene, Inputs, by_vector, weighted
from _report_motion import G
from torch import Tensor


def _stopped(values: Tensor, inputs: Inputs) -> Tensor:
    """It goes v² / (2 μ g) further, the way it was going."""
    state, parameters = inputs.placed(values)
    v, mu = state.velocity[:, :2], parameters["friction"][0]
    way = v * v.norm() / (2.0 * mu * G)
    return weighted(inputs.start.replace(position=torch.cat([state.position[:, :2] + way, state.position[:, 2:]], 1)))


def _rolled_on(values: Tensor, inputs: Inputs) -> Tensor:
    """Friction takes the slip it starts with at once: it rolls with 5/7 of its speed and 2/7 of its spin's."""
    state, _ = inputs.placed(values)
    spin, time = state.angular_velocity, inputs.case.duration
    speed = 5.0 / 7.0 * state.velocity[:, :2] + 2.0 / 7.0 * RADIUS * torch.stack([spin[:, 1], -spin[:, 0]], dim=1)
    falls = 5.0 / 14.0 * time**2 * torch.tensor([slope(GENTLE)[:2]], dtype=torch.float64)
    x = state.position[:, :2] + time * speed + falls
    return weighted(inputs.start.replace(position=torch.cat([x, inputs.start.position[:, 2:]], 1)))


def _bowled_to(values: Tensor, inputs: Inputs) -> Tensor:
    state, parameters = inputs.placed(values)
    mu = parameters["friction"][0]
    end = bowled(state.position[0], state.velocity[0], state.angular_velocity[0], mu, inputs.case.duration)
    return weighted(inputs.start.replace(position=end[None]))


_BOTH = ("friction", ([0, 1],))  # the coefficients of body and ground, as one number
_STEPS = (0.02, 0.01, 0.005, 0.0025, 0.00125)
_PEERS = (Settings("Euler"), ELLIPTIC, CREEPS_LEAST)
_MODES = (("exact", {}), ("second_order", {"integrator": "second_order"}))

FRICTION_GRADIENTS = (
    GradientScene(
        "slide",
        "A box slides to rest",
        "v² / (2 μ g)",
        slide_to_rest,
        0.6,
        _STEPS,
        (*by_vector("velocity", 0, (0, 1)), _BOTH),
        weighted,
        _stopped,
        ours=_MODES,
        mujoco=_PEERS,
        note="Why: wide differences through MuJoCo average over the step in which the box stops, and come as near at"
        " one dt; with smaller ones they go away again.",
        quick=True,
    ),
    GradientScene(
        "rolling",
        "A ball rolls down 20°",
        "closed form",
        rolling,
        0.6,
        _STEPS,
        (*by_vector("velocity", 0, (0, 1)), *by_vector("angular_velocity", 0, (0, 1)), _BOTH),
        weighted,
        _rolled_on,
        ours=_MODES,
        mujoco=_PEERS,
    ),
    GradientScene(
        "bowling",
        "A ball is thrown, lands, slides and rolls",
        "closed form",
        bowling,
        BOWLED,
        _STEPS,
        (*by_vector("position", 0), *by_vector("velocity", 0), *by_vector("angular_velocity", 0, (0, 1)), _BOTH),
        weighted,
        _bowled_to,
        ours=_MODES,
        mujoco=_PEERS,
    ),
)
