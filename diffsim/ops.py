"""The operator under the layer: an autograd.Function (with its rule for vmap) and one documented wrapper."""

from __future__ import annotations

from typing import Any

import torch
import torch.autograd.forward_ad as forward_ad
from torch import Tensor

from ._core_calls import OptionalTensors, RolloutCall, as_arrays, run_backward, run_forward
from ._folding import map_backward, map_forward
from ._input_table import INPUT_COUNT, LABELS

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
        call, needs = ctx.call, ctx.needs_input_grad[1:]
        saved = ctx.saved_tensors  # read in any case: that refuses what has been changed in place since
        if torch.is_grad_enabled() or _transforms_active():
            return None, *_RolloutBackward.apply(_BackwardCall(call, needs), *saved, *grads)
        if call.arrays is not None:
            try:
                upstream = as_arrays(grads)
            except RuntimeError:  # no plain tensors
                pass
            else:
                return None, *run_backward(call, needs, call.arrays, upstream)
        return None, *_RolloutBackward.forward(_BackwardCall(call, needs), *saved, *grads)

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
        return run_backward(backward_call.call, backward_call.needs, arrays[:INPUT_COUNT], arrays[INPUT_COUNT:])

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
    for t in tensors:  # noqa: SIM110, twice as fast as any() over a generator
        if t is not None and t.requires_grad:
            return True
    return False


def _refuse_tangents(inputs: tuple[Tensor | None, ...]) -> None:
    """Inside a dual level of forward-mode AD. The shortcuts past autograd would drop tangents silently."""
    for name, t in zip(LABELS, inputs):
        if t is not None and forward_ad.unpack_dual(t).tangent is not None:
            raise NotImplementedError(
                f"diffsim: {name} carries a tangent, but there is no forward-mode AD through a step; use reverse mode"
                " (backward, torch.func.vjp, jacrev)"
            )


_plain_apply = super(torch.autograd.Function, _Rollout).apply  # without inspect.signature, three quarters of the cost


def rollout(call: RolloutCall, *inputs: Tensor | None) -> OptionalTensors:
    """Advance everything by ``call.steps`` steps, each Eqs. 2 and 6 of Qiao et al. (ICML 2020) as one optimization.

    Args:
        call: Model, options, number of steps and threads; receives `info` and the tape.
        inputs: State, controls and parameters, as `diffsim._input_table.INPUTS` lists them, float64 on the cpu. Any may
            have a batch axis of size B in front of its shape; if one has, the outputs have. With
            ``call.controls_have_time`` every control has a time axis of length steps in front of that. A control that
            is None is zero, the velocity of kinematic bodies as it is in the state. All of cloth is None in a scene
            without.
    Returns: The state after the last step, or, with ``call.keep_time``, after every step with a leading time axis.
    Raises: ValueError for what only the core can judge: not finite, not positive, in penetration.
    Gradients: with respect to all inputs, first order only; the set of active contacts is held fixed.
    """
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
