"""The operator under the layer: an autograd.Function (with its rule for vmap) and one documented wrapper."""

from __future__ import annotations

from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from ._core_calls import INPUT_NAMES, OptionalTensors, RolloutCall, as_arrays, run_backward, run_forward
from ._folding import map_backward, map_forward

__all__ = ["RolloutCall", "rollout"]

# Whether torch.func transforms (vmap, grad, ...) are running. They dispatch through Function.apply; without them two
# shortcuts are open that halve the cost of a call.
_transforms_active = torch._C._are_functorch_transforms_active

FIRST_ORDER_ONLY = (
    "diffsim: gradients are first order only; a second derivative through a step was asked for (create_graph=True,"
    " hessian, or a gradient of a gradient)"
)


class _Rollout(torch.autograd.Function):
    # Not `once_differentiable`: that lets some second derivatives through as silent zeros. Here the backward is an
    # operator of its own (for vmap over the backward, as in jacrev), and its backward says no.
    @staticmethod
    def forward(call: RolloutCall, *inputs: Tensor | None) -> OptionalTensors:
        return run_forward(call, inputs)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.call = inputs[0]  # its tape is read-only, so that backward may run twice
        ctx.save_for_backward(*inputs[1:])
        ctx.set_materialize_grads(False)  # no upstream gradient, no work: the core gets None

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        call = _BackwardCall(ctx.call, ctx.needs_input_grad[1:])
        if torch.is_grad_enabled() or _transforms_active():
            return None, *_RolloutBackward.apply(call, *ctx.saved_tensors, *grads)
        return None, *_RolloutBackward.forward(call, *ctx.saved_tensors, *grads)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:  # of a gradient: other tangents show in the inputs, and are refused there
        raise NotImplementedError(FIRST_ORDER_ONLY)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], call: RolloutCall, *inputs: Tensor | None) -> Any:
        def apply(folded: list[Tensor | None]) -> Any:
            # A tensor hides from the outside of vmap whether it requires grad; here, one level further down, it shows.
            call.record = call.record or (call.keep_tape and _any_requires_grad(folded))
            return _Rollout.apply(call, *folded)

        return map_forward(call, info.batch_size, in_dims[1:], inputs, apply)


class _BackwardCall:
    __slots__ = ("call", "needs")

    def __init__(self, call: RolloutCall, needs: tuple[bool, ...]) -> None:
        self.call = call
        self.needs = needs


class _RolloutBackward(torch.autograd.Function):
    """(inputs, gradients of the outputs) -> gradients of the inputs."""

    @staticmethod
    def forward(backward_call: _BackwardCall, *tensors: Tensor | None) -> OptionalTensors:
        try:
            arrays = as_arrays(tensors)
        except RuntimeError:  # no plain tensors
            if any(t is not None and _is_legacy_batched(t) for t in tensors):
                return _legacy_rows(backward_call, tensors)
            arrays = as_arrays([t if t is None else t.to_dense() for t in tensors])
        return run_backward(backward_call.call, backward_call.needs, arrays)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.set_materialize_grads(False)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> OptionalTensors:
        raise NotImplementedError(FIRST_ORDER_ONLY)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise NotImplementedError(FIRST_ORDER_ONLY)

    @staticmethod
    def vmap(info: Any, in_dims: tuple[int | None, ...], backward_call: _BackwardCall, *tensors: Tensor | None) -> Any:
        return map_backward(
            backward_call.call,
            info.batch_size,
            in_dims[1:],
            tensors,
            lambda folded: _RolloutBackward.apply(backward_call, *folded),
        )


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


def _refuse_tangents(inputs: tuple[Tensor | None, ...]) -> None:
    """Inside a dual level of forward-mode AD. The shortcuts past autograd would drop tangents silently."""
    for name, t in zip(INPUT_NAMES, inputs):
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
    friction: Tensor,
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
        friction: Coulomb's coefficients of bodies, cloths and the ground [1], shape (n_objects,).
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
        friction,
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
