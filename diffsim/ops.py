"""The operators under the layer: each one autograd.Function (with its rule for vmap) and one documented wrapper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from . import _core
from ._check import CLOTH_PARAMETERS, CONTROL_FIELDS, PARAMETERS, STATE_FIELDS, message

__all__ = [
    "ConvergenceWarning",
    "Failure",
    "FastImpactWarning",
    "GradientError",
    "Info",
    "RolloutCall",
    "SolverError",
    "rollout",
]

# Whether torch.func transforms (vmap, grad, ...) are running. They dispatch through Function.apply; without them two
# shortcuts are open that halve the cost of a call.
_transforms_active = torch._C._are_functorch_transforms_active

# Input axes without time and batch, in the order of the operator: state, controls, then mass, inertia, gravity and
# the five of cloth.
_BASE_NDIM = (*(2,) * 6, *(2,) * 6, 1, 3, 1, *(1,) * 5)
_INPUT_COUNT = len(_BASE_NDIM)
_CONTROLS = range(6, 12)

_LARGEST, _LARGEST_SINGLE = torch.finfo(torch.float64).max, torch.finfo(torch.float32).max

OptionalTensors = tuple[Tensor | None, ...]


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
    #: in one word: "max_iterations", "no_descent", "spinning", "blocked", "penetrating" or "overflow"
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
    #: in all steps of the call, pairs of bodies that met while moving about as far in a step as the smaller is large
    #: (1.5 times its radius): such bodies can come around each other within a few steps
    fast_impacts: int
    contacts: int  #: contacts in the zones' optimizations
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


def _gradient_error(model: _core.Model, fault: _core.GradientFault) -> GradientError:
    scene, step, gradients, objects, nodes = fault.args
    bodies = tuple(model.names[i] for i in objects)
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


class RolloutCall:
    """What one call of `rollout` needs beside tensors, and what it leaves behind. Use an instance once.

    Args:
        model: What moves.
        options: How steps are taken.
        steps: Number of them.
        num_threads: How many threads may be used; no result depends on it.
        controls_have_time: Whether the controls have a time axis.
        keep_time: Whether the outputs have one, or are those of the last step.
        keep_tape: Whether the backward finds a record; without, it runs the forward again (checkpointing).
        want_signature: Whether `signature` is to be filled in.
        first_step: How many steps other calls made before, for error messages.
        single: Whether gradients must fit into single precision, where a float32 input will have them.

    Attributes:
        info: Statistics, after the call.
        tape: What the backward needs, where something requires grad.
        signature: Hash of each step's active contacts, uint64, shape (steps[, B]).
    """

    __slots__ = (
        "controls_have_time",
        "first_step",
        "info",
        "keep_tape",
        "keep_time",
        "model",
        "num_threads",
        "options",
        "record",
        "signature",
        "single",
        "steps",
        "tape",
        "want_signature",
    )

    def __init__(
        self,
        model: _core.Model,
        options: _core.Options,
        steps: int,
        num_threads: int,
        controls_have_time: bool = False,
        keep_time: bool = False,
        keep_tape: bool = True,
        want_signature: bool = False,
        first_step: int = 0,
        single: bool = False,
    ) -> None:
        self.model = model
        self.options = options
        self.steps = steps
        self.num_threads = num_threads
        self.controls_have_time = controls_have_time
        self.keep_time = keep_time
        self.keep_tape = keep_tape  # False: the backward runs the forward again instead (checkpointing)
        self.want_signature = want_signature
        self.first_step = first_step  # how many steps other calls made before
        self.single = single
        self.record = False
        self.tape: _core.Tape | None = None
        self.info: _core.Info | None = None
        self.signature: np.ndarray | None = None  # uint64 hash of the active contacts, shape (steps[, B])


def _array(tensor: Tensor) -> Any:  # a float64 array, as the core wants it
    if not tensor.is_contiguous():
        tensor = tensor.contiguous()
    return tensor.numpy(force=True)  # force: also where it requires grad; no copy on the cpu


def _arrays(tensors: Sequence[Tensor | None]) -> list[Any]:
    return [None if t is None else _array(t) for t in tensors]


def _refuse_sparse(inputs: Sequence[Tensor | None]) -> None:
    """Looked for once something has gone wrong: to ask every tensor of every call would take too long."""
    for name, t in zip(_INPUT_NAMES, inputs):
        if t is not None and t.layout is not torch.strided:
            raise TypeError(message("Simulator", name, "be a dense tensor (use .to_dense())", t.layout))


def _run(call: RolloutCall, arrays: list[Any], record: bool) -> _core.Rollout:
    return _core.rollout(
        call.model,
        call.options,
        arrays,
        steps=call.steps,
        controls_have_time=call.controls_have_time,
        keep_time=call.keep_time,
        record=record,
        num_threads=call.num_threads,
        first_step=call.first_step,
    )


class _Rollout(torch.autograd.Function):
    # Not `once_differentiable`: that lets some second derivatives through as silent zeros. Here the backward is an
    # operator of its own (for vmap over the backward, as in jacrev), and its backward says no.
    @staticmethod
    def forward(call: RolloutCall, *inputs: Tensor | None) -> OptionalTensors:
        try:
            arrays = _arrays(inputs)
        except RuntimeError:
            _refuse_sparse(inputs)
            raise
        result = _run(call, arrays, call.record)
        call.tape = result.tape
        call.info = result.info
        if call.want_signature:
            call.signature = result.signature
        return tuple([None if a is None else torch.from_numpy(a) for a in result.trajectory])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.call = inputs[0]  # its tape is read-only, so that backward may run twice
        ctx.save_for_backward(*inputs[1:])
        ctx.set_materialize_grads(False)  # no upstream gradient, no work: the core gets None

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        if ctx.call.options.newton_iterations is not None:
            raise NotImplementedError(
                "diffsim: there are no gradients through newton_iterations: where Newton's method is cut short they"
                " take third derivatives of the elastic energy; leave it at None, or step under torch.no_grad()"
            )
        call = _BackwardCall(ctx.call, ctx.needs_input_grad[1:])
        if torch.is_grad_enabled() or _transforms_active():
            return None, *_RolloutBackward.apply(call, *ctx.saved_tensors, *grads)
        return None, *_RolloutBackward.forward(call, *ctx.saved_tensors, *grads)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:  # of a gradient: other tangents show in the inputs, and are refused there
        raise NotImplementedError(_FIRST_ORDER_ONLY)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], call: RolloutCall, *inputs: Tensor | None) -> Any:
        folded, batch = _fold_inputs(call, info.batch_size, in_dims[1:], inputs)
        # A tensor hides from the outside of vmap whether it requires grad; here, one level further down, it shows.
        call.record = call.record or (call.keep_tape and _any_requires_grad(folded))
        time = int(call.keep_time)
        outputs = _Rollout.apply(call, *folded)
        unfolded = tuple(None if t is None else _unfold(t, info.batch_size, batch, time) for t in outputs)
        return unfolded, tuple(None if t is None else time for t in unfolded)


_FIRST_ORDER_ONLY = (
    "diffsim: gradients are first order only; a second derivative through a step was asked for (create_graph=True,"
    " hessian, or a gradient of a gradient)"
)


class _BackwardCall:
    __slots__ = ("call", "needs")

    def __init__(self, call: RolloutCall, needs: tuple[bool, ...]) -> None:
        self.call = call
        self.needs = needs


class _RolloutBackward(torch.autograd.Function):
    """(inputs, gradients of the outputs) -> gradients of the inputs."""

    @staticmethod
    def forward(backward_call: _BackwardCall, *tensors: Tensor | None) -> OptionalTensors:
        call = backward_call.call
        try:
            arrays = _arrays(tensors)
        except RuntimeError:  # no plain tensors
            if any(t is not None and _is_legacy_batched(t) for t in tensors):
                return _legacy_rows(backward_call, tensors)
            arrays = _arrays([t if t is None else t.to_dense() for t in tensors])
        # Without a tape, checkpointing: the same bits again, recorded this time, and dropped after use.
        inputs, upstream = arrays[:_INPUT_COUNT], arrays[_INPUT_COUNT:]
        tape = call.tape or _run(call, inputs, record=True).tape
        assert tape is not None  # it was recorded
        limit = _LARGEST_SINGLE if call.single else _LARGEST
        try:
            grads = _core.rollout_backward(
                tape, inputs, upstream, needs=backward_call.needs, num_threads=call.num_threads, limit=limit
            )
        except _core.GradientFault as fault:
            raise _gradient_error(call.model, fault) from None
        return tuple(None if g is None else torch.from_numpy(g) for g in grads)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> OptionalTensors:
        raise NotImplementedError(_FIRST_ORDER_ONLY)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise NotImplementedError(_FIRST_ORDER_ONLY)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], backward_call: _BackwardCall, *tensors: Tensor | None) -> Any:
        size, dims = info.batch_size, in_dims[1:]
        if all(dim is None for dim in dims[:_INPUT_COUNT]):
            # One forward, many upstream gradients (jacrev, is_grads_batched): one tape, used once per gradient.
            rows = [
                _RolloutBackward.apply(
                    backward_call, *(t if t is None or d is None else t.select(d, i) for t, d in zip(tensors, dims))
                )
                for i in range(size)
            ]
            outputs = tuple(None if column[0] is None else torch.stack(column) for column in zip(*rows))
            return outputs, tuple(None if t is None else 0 for t in outputs)
        call = backward_call.call
        folded, batch = _fold_inputs(call, size, dims[:_INPUT_COUNT], tensors[:_INPUT_COUNT])
        upstream = zip(tensors[_INPUT_COUNT:], dims[_INPUT_COUNT:])
        folded_grads = [_fold(t, d, size, batch, 2, int(call.keep_time)) for t, d in upstream]
        grads = _RolloutBackward.apply(backward_call, *folded, *folded_grads)
        outputs = tuple(
            None if grad is None or t is None else _unfold_like(t, dim, grad, size, batch, base, time)
            for t, dim, grad, base, time in zip(tensors, dims, grads, _BASE_NDIM, _times(call))
        )
        return outputs, tuple(None if t is None else 0 for t in outputs)


_is_legacy_batched = torch._C._functorch.is_legacy_batchedtensor


def _legacy_rows(backward_call: _BackwardCall, tensors: tuple[Tensor | None, ...]) -> OptionalTensors:
    """Under the vmap of `is_grads_batched` and `autograd.functional`, which knows no rules of Functions: it hands over
    upstream gradients with an axis that is hidden from all but its own two functions.
    """
    level = torch._C._vmapmode_increment_nesting() - 1
    torch._C._vmapmode_decrement_nesting()
    hidden = [t is not None and _is_legacy_batched(t) for t in tensors]
    shown = [torch._remove_batch_dim(t, level, 1, 0) if t is not None and h else t for t, h in zip(tensors, hidden)]
    if any(t is not None and _is_legacy_batched(t) for t in shown):
        raise NotImplementedError(
            "diffsim: there is no is_grads_batched within is_grads_batched; use torch.func.jacrev"
        )
    size = next(len(t) for t, h in zip(shown, hidden) if t is not None and h)
    rows = [
        _RolloutBackward.forward(backward_call, *(t[i] if t is not None and h else t for t, h in zip(shown, hidden)))
        for i in range(size)
    ]
    columns = (None if column[0] is None else torch.stack(column) for column in zip(*rows))
    return tuple(None if t is None else torch._add_batch_dim(t, 0, level) for t in columns)


def _any_requires_grad(tensors: Any) -> bool:
    return any(t is not None and t.requires_grad for t in tensors)


def _times(call: RolloutCall) -> list[int]:
    """How many time axes each input has."""
    return [int(i in _CONTROLS and call.controls_have_time) for i in range(_INPUT_COUNT)]


def _fold_inputs(
    call: RolloutCall, size: int, dims: tuple[int | None, ...], inputs: tuple[Tensor | None, ...]
) -> tuple[list[Tensor | None], int | None]:
    """The axis of vmap, in front of the core's batch axis, becomes one with it. Also returns the batch size there was.

    Inputs that are not mapped are repeated, so that the backward can give each mapped element its own gradient.
    """
    times = _times(call)
    batch = None
    for t, dim, base, time in zip(inputs, dims, _BASE_NDIM, times):
        if t is not None and t.ndim - (dim is not None) > base + time:
            native = list(t.shape)
            if dim is not None:
                del native[dim]
            batch = native[time]
    folded = [_fold(t, d, size, batch, base, time) for t, d, base, time in zip(inputs, dims, _BASE_NDIM, times)]
    return folded, batch


def _fold(t: Tensor | None, dim: int | None, size: int, batch: int | None, base: int, time: int) -> Tensor | None:
    """([time,] [batch,] *base) with vmap's axis at `dim` -> ([time,] size or size * batch, *base)."""
    if t is None:
        return None
    t = t.unsqueeze(time) if dim is None else t.movedim(dim, time)
    if batch is None:
        return t.expand(*t.shape[:time], size, *t.shape[time + 1 :])
    if t.ndim == time + 1 + base:
        t = t.unsqueeze(time + 1)
    return t.expand(*t.shape[:time], size, batch, *t.shape[time + 2 :]).flatten(time, time + 1)


def _unfold(t: Tensor, size: int, batch: int | None, time: int) -> Tensor:
    """([time,] size * batch, ...) -> ([time,] size, batch, ...)"""
    return t if batch is None else t.unflatten(time, (size, batch))


def _unfold_like(
    t: Tensor, dim: int | None, grad: Tensor, size: int, batch: int | None, base: int, time: int
) -> Tensor:
    """The gradient of folded `t` -> (size, *shape of one mapped element of t)."""
    grad = _unfold(grad, size, batch, time).movedim(time, 0)
    shared = t.ndim - (dim is not None) == base + time  # by all scenes of the batch
    return grad if batch is None or not shared else grad.sum(1 + time)


_INPUT_NAMES = (
    *(f"state.{name}" for name in STATE_FIELDS),
    *(f"control.{name}" for name in CONTROL_FIELDS),
    *PARAMETERS,
    *CLOTH_PARAMETERS,
)


def _refuse_tangents(inputs: tuple[Tensor | None, ...]) -> None:
    """Inside a dual level of forward-mode AD. The shortcuts past autograd would drop tangents silently."""
    for name, t in zip(_INPUT_NAMES, inputs):
        if t is not None and forward_ad.unpack_dual(t).tangent is not None:
            raise NotImplementedError(
                f"diffsim: {name} carries a tangent, but there is no forward-mode AD through a step; use reverse mode"
                " (backward, torch.func.vjp, jacrev)"
            )


_plain_apply = super(torch.autograd.Function, _Rollout).apply  # without inspect.signature, three quarters of the cost


def rollout(
    call: RolloutCall,
    position: Tensor,
    orientation: Tensor,
    velocity: Tensor,
    angular_velocity: Tensor,
    node_position: Tensor | None,
    node_velocity: Tensor | None,
    force: Tensor | None,
    torque: Tensor | None,
    node_force: Tensor | None,
    body_velocity: Tensor | None,
    body_angular_velocity: Tensor | None,
    node_drive: Tensor | None,
    mass: Tensor,
    inertia: Tensor,
    gravity: Tensor,
    cloth_density: Tensor | None,
    cloth_stretch: Tensor | None,
    cloth_shear: Tensor | None,
    cloth_bend: Tensor | None,
    cloth_damping: Tensor | None,
) -> OptionalTensors:
    """Advance everything by ``call.steps`` steps, each Eqs. 2 and 6 of Qiao et al. (ICML 2020) as one optimization.

    All tensors are float64 on the cpu. Any may have a batch axis of size B in front of its shape below; if one has,
    the outputs have. With ``call.controls_have_time`` every control has a time axis of length steps in front of that.

    Args:
        call: Model, options, number of steps and threads; receives `info` and the tape.
        position: Centres of mass, world [m], shape (n, 3).
        orientation: Unit quaternions w, x, y, z, body to world, shape (n, 4).
        velocity: Of the centres of mass, world [m/s], shape (n, 3).
        angular_velocity: World [rad/s], shape (n, 3).
        node_position: Of cloth, world [m], shape (n_nodes, 3). This and all else of cloth is None in a scene without.
        node_velocity: World [m/s], shape (n_nodes, 3).
        force: At the centre of mass, world [N], shape (n, 3), or None for zero.
        torque: About the centre of mass, world [N·m], shape (n, 3), or None for zero.
        node_force: World [N], shape (n_nodes, 3), or None for zero.
        body_velocity: Of kinematic bodies, world [m/s], shape (n, 3), or None: as in the state.
        body_angular_velocity: Of kinematic bodies, world [rad/s], shape (n, 3), or None: as in the state.
        node_drive: Velocity of pinned nodes, world [m/s], shape (n_nodes, 3), or None for zero.
        mass: [kg], shape (n,).
        inertia: Body frame [kg·m²], shape (n, 3, 3).
        gravity: [m/s²], shape (3,).
        cloth_density: [kg/m²], shape (n_cloths,).
        cloth_stretch: [N/m], shape (n_cloths,).
        cloth_shear: [N/m], shape (n_cloths,).
        cloth_bend: [N·m], shape (n_cloths,).
        cloth_damping: [s], shape (n_cloths,).
    Returns: position, orientation, velocity, angular_velocity, node_position, node_velocity after the last step, or,
        with ``call.keep_time``, after every step with a leading time axis.
    Raises: ValueError for what only the core can judge: not finite, not positive, in penetration.
    Gradients: with respect to all inputs, first order only; the set of active contacts is held fixed.
    """
    inputs = (
        position,
        orientation,
        velocity,
        angular_velocity,
        node_position,
        node_velocity,
        force,
        torque,
        node_force,
        body_velocity,
        body_angular_velocity,
        node_drive,
        mass,
        inertia,
        gravity,
        cloth_density,
        cloth_stretch,
        cloth_shear,
        cloth_bend,
        cloth_damping,
    )
    if forward_ad._current_level >= 0:
        _refuse_tangents(inputs)
    if not torch.is_grad_enabled():
        call.keep_tape = False
    outputs: OptionalTensors
    if _transforms_active():
        call.record = call.keep_tape and _any_requires_grad(inputs)
        outputs = _Rollout.apply(call, *inputs)
    elif torch.is_grad_enabled() and _any_requires_grad(inputs):
        call.record = call.keep_tape
        outputs = _plain_apply(call, *inputs)
    else:
        outputs = _Rollout.forward(call, *inputs)
    return outputs
