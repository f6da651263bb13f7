"""What a user can look at in a scene of their own: are gradients right, what system do they solve, what went wrong?"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import median

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from . import _core
from ._arguments import KINDS
from ._check import check_count, check_instance, check_number
from ._dump import Replay, dump, replay
from ._input_table import CONTROL_FIELDS, CONTROLS, INPUTS, OF_CLOTH, PARAMETERS, SCALES, STATE_FIELDS
from ._inputs import Controls, over_time
from .simulator import Simulator
from .state import Control, State

__all__ = [
    "ContactSystem",
    "DirectionCheck",
    "GradcheckReport",
    "Replay",
    "contact_systems",
    "dump",
    "gradcheck",
    "replay",
]

# A control that has the name of a field of the state is called otherwise here.
_CONTROL_NAMES = {name: {"node_velocity": "node_drive"}.get(name, name) for name in CONTROL_FIELDS}

# Parameters other than gravity are moved by this many times eps, relative to their size: their effect on the motion is
# weaker than that of the state, and rounding would be read as an error of 1e-5.
_PARAMETER_STEP = 100.0
# A derivative below this fraction of the typical one is judged as if it were that large: the rest is rounding.
_SMALL = 1e-3


@dataclass(frozen=True)
class DirectionCheck:
    """One direction: the layer's derivative beside central differences."""

    name: str  #: what was moved: "position", "force", "mass", ...
    derivative: float  #: by the layer's gradient
    difference: float  #: by central differences
    error: float  #: |derivative - difference| / max(|derivative|, |difference|, a thousandth of the typical derivative)
    active_set_changed: bool  #: the contacts of some step differ between the two sides: the difference means nothing


@dataclass(frozen=True)
class GradcheckReport:
    """What `gradcheck` found. Print it for a table."""

    directions: tuple[DirectionCheck, ...]  #: as many per name as were asked for
    zero_gradients: tuple[str, ...]  #: names whose gradient is zero: nothing was tested there
    steps: int  #: of the rollout
    eps: float  #: how far to either side
    median_tolerance: float  #: of `median_error`, relative
    max_tolerance: float  #: of `max_error`, relative

    @property
    def stable(self) -> tuple[DirectionCheck, ...]:
        """The directions whose two sides have the same active contacts."""
        return tuple(d for d in self.directions if not d.active_set_changed)

    @property
    def max_error(self) -> float:
        """Largest relative error over the stable directions; nan if there is none."""
        return max((d.error for d in self.stable), default=math.nan)

    @property
    def median_error(self) -> float:
        """Median relative error over the stable directions; nan if there is none."""
        return median(d.error for d in self.stable) if self.stable else math.nan

    @property
    def passed(self) -> bool:
        """Some gradient is not zero, and median and maximum of the error are within their tolerances."""
        tested = any(d.derivative != 0.0 for d in self.stable)
        return tested and self.median_error <= self.median_tolerance and self.max_error <= self.max_tolerance

    def __str__(self) -> str:
        head = f"{'input':<22}{'derivative':>16}{'difference':>16}{'error':>10}  active set"
        rows = [
            f"{d.name:<22}{d.derivative:>16.8e}{d.difference:>16.8e}{d.error:>10.1e}"
            f"  {'changed' if d.active_set_changed else 'same'}"
            for d in self.directions
        ]
        zero = [f"gradient is zero, nothing tested: {', '.join(self.zero_gradients)}"] if self.zero_gradients else []
        verdict = (
            f"{'passed' if self.passed else 'FAILED'}: {self.steps} step(s), eps {self.eps:g}, {len(self.stable)} of"
            f" {len(self.directions)} directions with an unchanged active set; error median {self.median_error:.1e}"
            f" (tolerance {self.median_tolerance:g}), max {self.max_error:.1e} (tolerance {self.max_tolerance:g})"
        )
        return "\n".join([head, *rows, *zero, verdict])


class _Rollout(nn.Module):
    """A rollout as a module's forward, so that functional_call can exchange parameters in it."""

    def __init__(self, sim: Simulator) -> None:
        super().__init__()
        self.sim = sim

    def forward(self, state: State, control: Controls, steps: int) -> tuple[State, NDArray[np.uint64]]:
        trajectory, signature = self.sim._rollout(state, control, steps, want_signature=True)
        assert signature is not None  # it was asked for
        return trajectory[-1], signature


def gradcheck(
    sim: Simulator,
    state: State,
    controls: Controls = None,
    steps: int = 1,
    *,
    wrt: Sequence[str] | None = None,
    directions: int = 4,
    eps: float = 1e-6,
    seed: int = 0,
    loss: Callable[[State], Tensor] | None = None,
    median_tolerance: float = 1e-6,
    max_tolerance: float = 1e-4,
) -> GradcheckReport:
    """Compare the layer's gradient of a scalar of the final state with central differences, along random directions.

    A step with contact is smooth only while the set of active contacts stays: a direction along which it changes
    between the two sides is reported as such and not judged.

    Args:
        sim: The simulator; its parameters are left as they are.
        state: Where to start; copied to float64.
        controls: As for `Simulator.rollout`.
        steps: Number of steps.
        wrt: Names of what to move: fields of the state, of the controls (`node_velocity` of the controls is called
            "node_drive"), or parameters: "mass", "inertia", "gravity", "cloth_stretch", ... Default: all of the state,
            the controls that are given, and the parameters.
        directions: Random directions per name.
        eps: How far to either side: of positions, velocities and quaternions (along the tangent of the unit sphere) in
            their units; forces, torques and gravity as far as changes velocities by eps in a step; all other
            parameters by 100 eps of their value.
        seed: Of the directions and of the default loss.
        loss: Final state -> scalar tensor. Default: a sum over all entries of the final state with random weights.
        median_tolerance: The largest median error with which `GradcheckReport.passed`.
        max_tolerance: The largest error with which it does.
    Returns: The report, one entry per direction.
    Raises: ValueError, TypeError as `Simulator.rollout`, and for a name in `wrt` that there is nothing of; ValueError
        if eps is so large that bodies moved by it penetrate.
    """
    where = "gradcheck"
    check_instance(where, "sim", sim, Simulator, "be a diffsim.Simulator")
    check_instance(where, "state", state, State, "be a diffsim.State")
    directions = check_count(where, "directions", directions)
    eps = check_number(where, "eps", eps, above=0.0)
    generator = torch.Generator("cpu").manual_seed(seed)
    inputs = _inputs(where, sim, state, controls, check_count(where, "steps", steps))
    names = list(inputs) if wrt is None else list(wrt)
    for name in names:
        if name not in inputs:
            raise ValueError(f"{where}: wrt must hold names out of {', '.join(inputs)}, got {name!r}")
    if loss is None:
        weights = {name: _normal(inputs[name].shape, generator) for name in STATE_FIELDS if name in inputs}

        def random_loss(final: State) -> Tensor:
            return torch.stack([(getattr(final, name) * w).sum() for name, w in weights.items()]).sum()

        loss = random_loss
    module = _Rollout(sim)

    def run(values: dict[str, Tensor]) -> tuple[Tensor, NDArray[np.uint64]]:
        moved = {name: values[name] for name in STATE_FIELDS if name in values}
        start = state.to(torch.float64).replace(**moved)
        given = {field: values[name] for field, name in _CONTROL_NAMES.items() if name in values}
        parameters = {f"sim.{name}": values[name] for name in PARAMETERS if name in values}
        driven: Controls = Control(**given) if given else None
        if driven is not None and isinstance(controls, Sequence):
            driven = list(driven)  # one per step: with as many scenes as steps its first axis could be either
        final, signature = torch.func.functional_call(module, parameters, (start, driven, steps))
        return loss(final), signature

    leaves = {name: t.detach().clone().requires_grad_(name in names) for name, t in inputs.items()}
    with torch.enable_grad():
        value, base_signature = run(leaves)
        grads = torch.autograd.grad(value, [leaves[name] for name in names], allow_unused=True, materialize_grads=True)

    rows: list[tuple[str, float, float, bool]] = []
    with torch.no_grad():
        for name, grad in zip(names, grads):
            for _ in range(directions):
                step = eps * _direction(name, inputs, sim, generator)
                try:
                    sides = [run({**inputs, name: inputs[name] + sign * step}) for sign in (1.0, -1.0)]
                except ValueError as refusal:
                    raise ValueError(
                        f"{where}: with {name} moved by eps = {eps:g}: {refusal}; take a smaller eps"
                    ) from None
                changed = any(bool((signature != base_signature).any()) for _, signature in sides)
                difference = float(sides[0][0] - sides[1][0]) / (2 * eps)
                rows.append((name, float((grad * step).sum()) / eps, difference, changed))
    typical = math.sqrt(sum(derivative**2 for _, derivative, _, _ in rows) / len(rows)) if rows else 0.0
    checks = []
    for name, derivative, difference, changed in rows:
        scale = max(abs(derivative), abs(difference), _SMALL * typical)
        error = abs(derivative - difference) / scale if scale > 0.0 else 0.0
        checks.append(DirectionCheck(name, derivative, difference, error, changed))
    zero = tuple(name for name, grad in zip(names, grads) if not grad.any())
    return GradcheckReport(tuple(checks), zero, steps, eps, median_tolerance, max_tolerance)


@dataclass(frozen=True, eq=False)
class ContactSystem:
    """What ``adjoint="dense"`` and ``"qr"`` solve for objects in contact with each other: (A + Jᵀ K J) z = v.

    It is the KKT system of Eq. 9 of Qiao et al. (ICML 2020), [A Jᵀ; J -1/K] [z; λ] = [v; 0], with the compliance of the
    contacts as its lower right block (with 0 in its place the contacts are hard). v is d(loss)/d(motion of the step),
    and A z is what of it reaches the motion without contact; so d(loss)/d(force) is dt² times z of the shift.

    Its n coordinates, in world axes: of each of `bodies` how far it turns [rad] and shifts [m], of each of `nodes` its
    shift [m].
    """

    bodies: NDArray[np.int64]  #: dynamic bodies, indices into the body axis
    nodes: NDArray[np.int64]  #: cloth nodes that are not pinned, indices into the node axis
    inertia: NDArray[np.float64]  #: A (n, n): inertia [kg·m², kg]; of nodes, dt² times elastic stiffness, too [kg]
    jacobian: NDArray[np.float64]  #: J (m, n): d(distance)/d(coordinates) of the m active contacts [m/rad, 1]
    stiffness: NDArray[np.float64]  #: K (m,): of the contacts, times dt² [kg]


def contact_systems(sim: Simulator, state: State, control: Control | None = None) -> tuple[ContactSystem, ...]:
    """The linear systems that ``adjoint="dense"`` and ``"qr"`` solve in the backward of one step, one per zone.

    For looking at what contacts do to a gradient: how many rows of J depend on each other, how badly conditioned the
    system is, how well a solver of one's own does. "exact" adds the contacts' curvature to it.

    Args:
        sim: Any simulator, whatever its `adjoint`. With ``compliance=0`` the stiffness is that of the steps by which
            the hard contacts' reactions are found; with ``coupling="split"`` the systems are those of the contact pass.
        state: Where the step starts, without batch axis.
        control: Of the step, without batch axis.
    Returns: One system per group of bodies and cloths in contact and per cloth that touches nothing, in the order of
        their first objects; none for a body that touches nothing. The matrices are dense: memory grows with the square
        of a group's size.
    Raises: TypeError, ValueError as the step does, and for a batch.
    Gradients: none.
    """
    where = "contact_systems"
    check_instance(where, "sim", sim, Simulator, "be a diffsim.Simulator")
    with torch.no_grad():
        inputs = sim._checked_inputs(where, state, control, None).inputs
        arrays = [None if t is None else t.contiguous().numpy(force=True) for t in inputs]
    if state.leading_shape or any(t is not None and t.ndim > 2 for t in inputs[CONTROLS.start : CONTROLS.stop]):
        raise ValueError(f"{where}: state and control must have no batch axis")
    result = _core.rollout(
        sim._model,
        sim._options,
        arrays,
        steps=1,
        controls_have_time=False,
        keep_time=False,
        record=True,
        num_threads=1,
        first_step=0,
    )
    assert result.tape is not None  # it was recorded
    return tuple(ContactSystem(*system) for system in _core.contact_systems(result.tape, arrays))


def _inputs(where: str, sim: Simulator, state: State, controls: Controls, steps: int) -> dict[str, Tensor]:
    """All that can be moved, in float64 and without history; controls with a time axis if they are a sequence."""
    start = state.detach().to(torch.float64)
    # A parameter of objects that is zero everywhere, friction, is moved in proportion, and is not there.
    absent = {i.name for i in INPUTS if i.axis == "objects" and not bool(getattr(sim, i.name).any())}
    if not sim._node_count:
        absent |= OF_CLOTH
    fields, parameters = ([name for name in names if name not in absent] for names in (STATE_FIELDS, PARAMETERS))
    inputs = {name: getattr(start, name) for name in fields}
    if isinstance(controls, Control):
        given = {name: getattr(controls, name) for name in CONTROL_FIELDS}
    else:
        batch = start.leading_shape[0] if start.leading_shape else None
        counts = len(sim.body_names), sim._node_count
        given = dict(zip(CONTROL_FIELDS, over_time(where, controls, steps, *counts, batch)[0]))
    inputs.update({_CONTROL_NAMES[k]: t.detach().to(torch.float64) for k, t in given.items() if t is not None})
    inputs.update({name: getattr(sim, name).detach().to(torch.float64) for name in parameters})
    return {name: t for name, t in inputs.items() if t.numel()}  # without bodies there is nothing to move of them


def _normal(shape: torch.Size, generator: torch.Generator) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64, device="cpu")


def _mean_inertia(inertia: Tensor) -> Tensor:
    return inertia.diagonal(dim1=-2, dim2=-1).mean(-1)


def _direction(name: str, inputs: dict[str, Tensor], sim: Simulator, generator: torch.Generator) -> Tensor:
    """A random direction of the size that eps is multiplied with."""
    dt = sim.dt
    value = inputs[name]
    direction = _normal(value.shape, generator)
    if name == "orientation":
        unit = torch.nn.functional.normalize(value, dim=-1)
        return direction - (direction * unit).sum(-1, keepdim=True) * unit
    if name == "inertia":
        return _PARAMETER_STEP * _mean_inertia(value)[..., None, None] * 0.5 * (direction + direction.mT)
    if name in SCALES:
        return _PARAMETER_STEP * value * direction
    if name == "gravity":
        return direction / dt
    if name == "force":
        return direction * inputs["mass"].unsqueeze(-1) / dt
    if name == "node_force" and sim._elements is not None:
        return direction * (inputs["cloth_density"].mean() * sim._elements.node_area.mean()) / dt
    if name == "torque":
        return direction * _mean_inertia(inputs["inertia"]).unsqueeze(-1) / dt
    if name in ("body_velocity", "body_angular_velocity"):  # of other bodies it must be zero
        return direction * torch.from_numpy(sim._packed.kind == KINDS.index("kinematic"))[:, None]
    if name == "node_drive":
        return direction * torch.from_numpy(sim._packed.pinned)[:, None]
    return direction
