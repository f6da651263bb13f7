"""What a call of the simulator leaves behind: statistics, and words for what went wrong."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import _core


class FastImpactWarning(UserWarning):
    """Bodies met that move as far in a step as they are large; see `Info.fast_impacts`. Warned once per simulator."""


class ConvergenceWarning(UserWarning):
    """A step did not converge; the last penetration-free state was returned. Warned once per simulator."""


@dataclass(frozen=True)
class Failure:
    """One step of one scene that did not converge."""

    scene: int  #: index along the batch axis; 0 without one
    step: int  #: index of the step in the rollout: the state it was taken from is that after `step` steps
    #: names of the bodies and cloths it is about: what is squeezed and what squeezes it; the pair that penetrates; of a
    #: group that was not solved all, but of a large one only the 8 whose forces balance least
    bodies: tuple[str, ...]
    #: in one word: "max_iterations", "crawls", "no_descent", "spinning", "blocked", "penetrating" or "overflow"
    status: str
    reason: str  #: in a sentence
    iterations: int  #: Newton iterations of the zone that took most
    residual: float  #: KKT residual where iteration stopped, relative


@dataclass(frozen=True)
class Info:
    """Statistics of the last call of a simulator: of its last step, where nothing else is said.

    Over a batch, counts are sums and the rest is the largest.
    """

    converged: bool  #: every step of every scene of the call
    #: every step of each scene of the call, bool, shape (B,), or () where states have no batch axis: a mask for a loss
    scenes_converged: Tensor = field(compare=False)
    failed_steps: int  #: steps of the call that did not converge, all scenes
    failure: str  #: why the first of them did not; "" if all converged
    #: the failed steps, by step, then scene; the first 256, if `failed_steps` is more than that
    failures: list[Failure]
    #: steps of the call that were not found at once and were taken in 2 to 8 shorter ones
    refined_steps: int
    #: in all steps of the call, pairs of bodies that met while moving about as far in a step as the smaller is large
    #: (1.5 times its radius): such bodies can come around each other within a few steps
    fast_impacts: int
    contacts: int  #: contacts in the zones' optimizations
    sticking: int  #: those of them with friction that do not slip
    slipping: int  #: and those that do
    zones: int  #: independent groups of bodies and cloths in contact
    largest_zone: int  #: bodies and cloths in the largest of them
    iterations: int  #: Newton iterations of the zone that took most
    residual: float  #: KKT residual where iteration stopped, relative
    max_compression: float  #: how far the most compressed contact is below its rest distance [m]
    milliseconds: dict[str, float]  #: time per stage [ms]


class SolverError(RuntimeError):
    """A step did not converge, and the simulator was asked for ``on_failure="raise"``.

    Attributes:
        info: Statistics of the call; `iterations` and `residual` are those of its last step.
        failures: Those of `info`: which steps of which scenes failed, over which bodies, and why.
        state: What the call would have returned: every configuration in it is free of penetration.
    """

    def __init__(self, text: str, info: Info, state: Any = None) -> None:
        super().__init__(text)
        self.info = info
        self.iterations = info.iterations
        self.residual = info.residual
        self.failures = info.failures
        self.state = state

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.args[0], self.info, self.state)


class GradientError(RuntimeError):
    """A backward gave numbers that are not finite (or, with a float32 input, too large for that) from finite ones.

    Attributes:
        scene: Index along the batch axis, 0 without one; -1 if only the sum over steps and scenes is not finite.
        step: Index of the step in the rollout, or -1 likewise.
        gradients: With respect to what: "state.velocity" (where that step starts), "control.force", "mass", ...
        bodies: Names of the bodies and cloths whose gradients they are.
        nodes: Of the cloths' nodes among them, indices into the node axis.
    """

    def __init__(
        self,
        text: str,
        scene: int,
        step: int,
        gradients: tuple[str, ...],
        bodies: tuple[str, ...],
        nodes: tuple[int, ...],
    ) -> None:
        super().__init__(text)
        self.scene = scene
        self.step = step
        self.gradients = gradients
        self.bodies = bodies
        self.nodes = nodes

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.args[0], self.scene, self.step, self.gradients, self.bodies, self.nodes)


def gradient_error(model: _core.Model, fault: _core.GradientFault) -> GradientError:
    scene, step, gradients, objects, nodes = fault.args
    names = (*model.names, "ground")  # which is -1
    bodies = tuple(names[i] for i in objects)
    where = "in the sum over steps and scenes" if step < 0 else f"in step {step} of the rollout, scene {scene}"
    whose = f", of {_listed(list(map(repr, bodies)))}" if bodies else ""
    if nodes:
        whose += f" (nodes {_listed(list(map(str, nodes)))} of the node axis)"
    return GradientError(
        f"diffsim: the gradient with respect to {', '.join(gradients)} is not finite {where}{whose}, though upstream"
        " gradients are. Gradients that grow from step to step overflow in the end: use fewer steps, detach states on"
        " the way, or scale the loss down. Where they do not grow, keep the step by ds.diagnostics.dump and report it",
        scene,
        step,
        tuple(gradients),
        bodies,
        tuple(nodes),
    )


def _listed(entries: list[str], most: int = 8) -> str:
    return ", ".join(entries[:most]) + (f" and {len(entries) - most} more" if len(entries) > most else "")


_MAX_FAILURES = 256  # the core lists no more of a segment

# What to try, by why the core says a step failed.
MENDS = {
    "max_iterations reached": "try a larger max_iterations or a smaller dt",
    "no balance of friction was found in thousands of factorizations": (
        "check what jams something, try a smaller dt or smaller coefficients of friction"
    ),
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
        refined_steps=sum(segment.refined_steps for segment in segments),
        fast_impacts=sum(segment.fast_impacts for segment in segments),
        failure=failures[0].reason if failures else "",
        failures=failures[:_MAX_FAILURES],
        contacts=last.contacts,
        sticking=last.sticking,
        slipping=last.slipping,
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
