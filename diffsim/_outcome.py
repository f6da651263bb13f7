"""What a call of the simulator leaves behind: statistics, and words for what went wrong."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from .ops import ConvergenceWarning, Failure, FastImpactWarning, Info

_MAX_FAILURES = 256  # the core lists no more of a segment

# What to try, by why the core says a step failed.
MENDS = {
    "max_iterations reached": "try a larger max_iterations or a smaller dt",
    "no step lowers the energy": "try a smaller dt or a larger tolerance",
    "a body spins too fast": "check angular velocities and torques; a smaller dt allows for faster ones",
    "a driven body is blocked: something is squeezed": (
        "check what the kinematic bodies squeeze and how far they are driven, or try a smaller dt"
    ),
    "objects penetrate at the start": "move them apart, for instance with sim.separate(state)",
    "a motion is too large for numbers to hold": "check states, controls and parameters for values out of proportion",
}
_USUAL_MEND = "try a smaller dt or a larger max_iterations"


def combined(segments: list[Any], names: Sequence[str]) -> Info:
    """The statistics of a call from those of its segments; `names` are those of the bodies, then of the cloths."""
    last = segments[-1]
    failures = [
        Failure(scene, step, tuple(names[i] for i in objects), *why)
        for segment in segments
        for scene, step, objects, *why in segment.failures
    ]
    scenes_converged = np.logical_and.reduce([segment.scenes_converged for segment in segments])
    return Info(
        converged=all(segment.converged for segment in segments),
        scenes_converged=torch.from_numpy(np.asarray(scenes_converged)),
        failed_steps=sum(segment.failed_steps for segment in segments),
        fast_impacts=sum(segment.fast_impacts for segment in segments),
        failure=failures[0].reason if failures else "",
        failures=failures[:_MAX_FAILURES],
        contacts=last.contacts,
        zones=last.zones,
        largest_zone=last.largest_zone,
        iterations=last.iterations,
        residual=last.residual,
        max_compression=last.max_compression,
        milliseconds=dict(last.milliseconds),
    )


def failure_text(info: Info, tolerance: float) -> str:
    """What to say about a call some of whose steps did not converge."""
    first = info.failures[0]
    scene = f" of scene {first.scene}" if info.scenes_converged.ndim else ""
    bodies = ", ".join(map(repr, first.bodies))
    cut = f", of which the first {_MAX_FAILURES} are listed" if info.failed_steps > len(info.failures) else ""
    return (
        f"Simulator: {info.failed_steps} step(s) did not converge, the first because: {first.reason}. It is step"
        f" {first.step}{scene}: {bodies}; {first.iterations} iterations to a relative residual of {first.residual:.3g}"
        f" (tolerance {tolerance:g}). The last penetration-free state is returned;"
        f" {MENDS.get(first.reason, _USUAL_MEND)}; see also sim.info.failures{cut}"
    )


def warn_of_failure(text: str) -> None:
    warnings.warn(text, ConvergenceWarning, stacklevel=_frames_to_user())


def warn_of_fast_impacts() -> None:
    warnings.warn(
        "Simulator: bodies met that move about as far in a step as the smaller of them is large; within a few"
        " steps they can come around each other. Use a smaller dt; see also sim.info.fast_impacts",
        FastImpactWarning,
        stacklevel=_frames_to_user(),
    )


def _frames_to_user() -> int:
    """How far up the stack, seen from the caller, the first frame outside of diffsim and torch is."""
    level, frame = 1, sys._getframe(1)
    while frame.f_back is not None and frame.f_globals.get("__name__", "").split(".")[0] in ("diffsim", "torch"):
        level, frame = level + 1, frame.f_back
    return level
