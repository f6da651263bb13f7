"""The operator under torch.compile: two custom ops the compiler does not look into, with their shapes, their derivative
and their rules for vmap.

Eager calls do not come here: an op of torch.library takes several times as long to call as `diffsim.ops.rollout`. An op
takes tensors and numbers only, so that a simulator goes by a number, and the record a backward needs by a tensor that
keeps it alive. The record is a matter of speed: a backward that does not find it, because a compiler copied the tensor,
runs the forward again, to the same bits.

Imported when a simulator is first traced: to register the ops takes a good part of what `import diffsim` may take.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple
from weakref import WeakValueDictionary

import numpy as np
import torch
from torch import Tensor
from torch._functorch.utils import enable_single_level_autograd_function
from torch.autograd.function import _SingleLevelFunction

from . import _core
from ._core_calls import OptionalTensors, RolloutCall, as_arrays, run_backward, run_forward
from ._folding import map_backward, map_forward
from ._input_table import BASE_NDIM, CONTROLS, INPUT_COUNT, LABELS, STATE_COUNT
from ._owners import owner_of
from .ops import FIRST_ORDER_ONLY


class _Settings(NamedTuple):
    """The arguments of both ops in front of the tensors."""

    owner: int
    steps: int
    controls_have_time: bool
    keep_time: bool
    record: bool
    single: bool
    first_step: int


class _Record(np.ndarray[Any, Any]):
    """One int64, the number of a tape, which it keeps alive: a tensor made from this array holds on to it."""

    tape: _core.Tape


_numbers = itertools.count()
_records: WeakValueDictionary[int, _Record] = WeakValueDictionary()

_SETTINGS = "int owner, int steps, bool controls_have_time, bool keep_time, bool record, bool single, int first_step"
_INPUTS = ", ".join(f"Tensor? {label.replace('.', '_')}" for label in LABELS)
_GRADS = ", ".join(f"Tensor? grad{i}" for i in range(STATE_COUNT))
_HEAD = len(_Settings._fields)


def rollout(
    owner: int,
    inputs: Sequence[Tensor | None],
    values: Mapping[str, Tensor],
    steps: int,
    *,
    controls_have_time: bool = False,
    keep_time: bool = False,
    keep_tape: bool = True,
    single: bool = False,
    first_step: int = 0,
) -> OptionalTensors:
    """As `diffsim.ops.rollout`, for code that is traced. `values`: the parameters of the call, also those not read."""
    record = keep_tape and torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in inputs)
    settings = (owner, steps, controls_have_time, keep_time, record, single, first_step)
    outputs = torch.ops.diffsim.rollout(*settings, *inputs, values["restitution"])
    return tuple(None if given is None else t for given, t in zip(inputs[:STATE_COUNT], outputs))


# ---- the forward -----------------------------------------------------------------------------------------------------

# By hand and not by torch.library.custom_op: what that makes of a derivative cannot be called inside torch.func.
_library = torch.library.Library("diffsim", "DEF")
_library.define(f"rollout({_SETTINGS}, {_INPUTS}, Tensor restitution) -> ({', '.join(['Tensor'] * (STATE_COUNT + 1))})")
_library.define(f"rollout_backward({_SETTINGS}, bool[] needs, Tensor tape, {_INPUTS}, {_GRADS}) -> Tensor[]")


def _forward(*args: Any) -> tuple[Tensor, ...]:
    settings, inputs = _Settings(*args[:_HEAD]), args[_HEAD : _HEAD + INPUT_COUNT]
    owner = owner_of(settings.owner)
    owner._check_unread(*args[_HEAD + INPUT_COUNT :])
    call = _call_of(settings)
    call.record = settings.record
    outputs = run_forward(call, inputs)
    owner._finish_traced(call.info, settings.first_step, outputs)
    filled = [_no_nodes(outputs[0]) if t is None else t for t in outputs]  # type: ignore[arg-type]
    return (*filled, torch.from_numpy(_recorded(call.tape)))


def _call_of(settings: _Settings) -> RolloutCall:
    return owner_of(settings.owner)._make_call(
        settings.steps,
        controls_have_time=settings.controls_have_time,
        keep_time=settings.keep_time,
        first_step=settings.first_step,
        single=settings.single,
    )


def _recorded(tape: _core.Tape | None) -> np.ndarray:
    number = next(_numbers)
    record = np.array([number], dtype=np.int64).view(_Record)
    if tape is not None:
        record.tape = tape
        _records[number] = record
    return record


def _no_nodes(position: Tensor) -> Tensor:
    return position.new_empty(*position.shape[:-2], 0, 3)


def _forward_shapes(*args: Any) -> tuple[Tensor, ...]:
    settings, inputs = _Settings(*args[:_HEAD]), args[_HEAD : _HEAD + INPUT_COUNT]
    leading = [settings.steps] if settings.keep_time else []
    for t, base, i in zip(inputs, BASE_NDIM, range(INPUT_COUNT)):
        time = int(settings.controls_have_time and i in CONTROLS)
        if t is not None and t.ndim > base + time:
            leading.append(t.shape[time])
            break
    outputs = [
        inputs[0].new_empty(*leading, 0, 3) if t is None else t.new_empty(*leading, *t.shape[-2:])
        for t in inputs[:STATE_COUNT]
    ]
    return (*outputs, inputs[0].new_empty(1, dtype=torch.int64))


def _next_level(op: Any, grad_enabled: bool, args: tuple[Any, ...]) -> Any:
    """Past this level's autograd, to that of an outer level of torch.func, which a Function's forward switches off."""
    with torch.set_grad_enabled(grad_enabled), torch._C._AutoDispatchBelowAutograd():
        return op(*args)


class _Differentiated(_SingleLevelFunction):
    @staticmethod
    def forward(ctx: Any, grad_enabled: bool, *args: Any) -> tuple[Tensor, ...]:
        outputs: tuple[Tensor, ...] = _next_level(torch.ops.diffsim.rollout, grad_enabled, args)
        ctx.settings = _Settings(*args[:_HEAD])
        ctx.save_for_backward(outputs[-1], *args[_HEAD : _HEAD + INPUT_COUNT])
        ctx.mark_non_differentiable(outputs[-1])
        ctx.set_materialize_grads(False)
        return outputs

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Any, ...]:
        needs = list(ctx.needs_input_grad[1 + _HEAD : 1 + _HEAD + INPUT_COUNT])
        upstream = grads[:STATE_COUNT]
        found = iter(torch.ops.diffsim.rollout_backward(*ctx.settings, needs, *ctx.saved_tensors, *upstream))
        return (*(None,) * (1 + _HEAD), *(next(found) if needed else None for needed in needs), None)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise NotImplementedError(
            "diffsim: there is no forward-mode AD through a step; use reverse mode (backward, torch.func.vjp, jacrev)"
        )


def _forward_vmap(info: Any, in_dims: tuple[int | None, ...], *args: Any) -> Any:
    head, last = args[:_HEAD], slice(_HEAD, _HEAD + INPUT_COUNT)
    unread = [t if d is None else t.select(d, 0) for t, d in zip(args[last.stop :], in_dims[last.stop :])]
    record: list[Tensor] = []

    def apply(folded: list[Tensor | None]) -> Any:
        *outputs, tape = torch.ops.diffsim.rollout(*head, *folded, *unread)
        record.append(tape)
        return outputs

    outputs, dims = map_forward(_Settings(*head), info.batch_size, in_dims[last], args[last], apply)
    return (*outputs, *record), (*dims, None)


# ---- the backward ----------------------------------------------------------------------------------------------------


def _backward(*args: Any) -> list[Tensor]:
    """Gradients of the inputs that need one."""
    needs, record, tensors = args[_HEAD], args[_HEAD + 1], args[_HEAD + 2 :]
    call = _call_of(_Settings(*args[:_HEAD]))
    kept = _records.get(int(record))
    call.tape = None if kept is None else kept.tape
    arrays = as_arrays(tensors)
    grads = run_backward(call, needs, arrays[:INPUT_COUNT], arrays[INPUT_COUNT:])
    wanted = [(t, g) for t, g, needed in zip(tensors, grads, needs) if needed]
    return [torch.zeros(t.shape, dtype=t.dtype) if g is None else g for t, g in wanted]


def _backward_shapes(*args: Any) -> list[Tensor]:
    return [t.new_empty(t.shape) for t, needed in zip(args[_HEAD + 2 :], args[_HEAD]) if needed]


class _Once(_SingleLevelFunction):
    @staticmethod
    def forward(ctx: Any, grad_enabled: bool, *args: Any) -> tuple[Tensor, ...]:
        return tuple(_next_level(torch.ops.diffsim.rollout_backward, grad_enabled, args))

    @staticmethod
    def backward(ctx: Any, *grads: Any) -> Any:
        raise NotImplementedError(FIRST_ORDER_ONLY)

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Any:
        raise NotImplementedError(FIRST_ORDER_ONLY)


def _backward_vmap(info: Any, in_dims: tuple[Any, ...], *args: Any) -> Any:
    head, needs, tensors = args[: _HEAD + 2], args[_HEAD], slice(_HEAD + 2, None)

    def apply(folded: list[Tensor | None]) -> list[Tensor | None]:
        found = iter(torch.ops.diffsim.rollout_backward(*head, *folded))
        return [next(found) if needed else None for needed in needs]

    outputs, _ = map_backward(_Settings(*args[:_HEAD]), info.batch_size, in_dims[tensors], args[tensors], apply)
    kept = [t for t in outputs if t is not None]
    return kept, [0] * len(kept)


def _autograd_kernel(function: Any, kind: type) -> Any:
    def kernel(*args: Any) -> Any:
        # Not Function.apply: it would start torch.func's levels again, of which the dispatcher is in the middle here.
        with enable_single_level_autograd_function():
            return kind(function.apply(torch.is_grad_enabled(), *args))

    return kernel


for _name, _kernel, _shapes, _function, _kind, _vmap in (
    ("rollout", _forward, _forward_shapes, _Differentiated, tuple, _forward_vmap),
    ("rollout_backward", _backward, _backward_shapes, _Once, list, _backward_vmap),
):
    _library.impl(_name, _kernel, "CPU")
    _library.impl(_name, _autograd_kernel(_function, _kind), "Autograd")
    torch.library.register_fake(f"diffsim::{_name}", _shapes, lib=_library)
    torch.library.register_vmap(f"diffsim::{_name}", _vmap, lib=_library)
