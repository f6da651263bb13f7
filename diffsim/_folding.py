"""The axis that torch.func.vmap maps, and the core's own batch axis: the first becomes part of the second."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from ._core_calls import OptionalTensors
from ._input_table import BASE_NDIM, CONTROLS, INPUT_COUNT

Dims = Sequence[int | None]


class Axes(Protocol):
    """What a call says about time axes: whether controls have one, and outputs."""

    @property
    def controls_have_time(self) -> bool: ...
    @property
    def keep_time(self) -> bool: ...


def map_forward(
    axes: Axes, size: int, dims: Dims, inputs: Sequence[Tensor | None], apply: Callable[[list[Tensor | None]], Any]
) -> tuple[OptionalTensors, tuple[int | None, ...]]:
    """The rule of vmap for a forward: its outputs, and where the mapped axis, of this size, is in each. `apply` runs it
    on inputs in which that axis is part of the batch axis.
    """
    folded, batch = _fold_inputs(axes, size, dims, inputs)
    time = int(axes.keep_time)
    outputs = tuple(None if t is None else _unfold(t, size, batch, time) for t in apply(folded))
    return outputs, tuple(None if t is None else time for t in outputs)


def map_backward(
    axes: Axes, size: int, dims: Dims, tensors: Sequence[Tensor | None], apply: Callable[[list[Tensor | None]], Any]
) -> tuple[OptionalTensors, tuple[int | None, ...]]:
    """The same for a backward: (inputs, gradients of the outputs) -> gradients of the inputs."""
    if all(dim is None for dim in dims[:INPUT_COUNT]):
        # One forward, many upstream gradients (jacrev, is_grads_batched): one tape, used once per gradient.
        rows = [
            apply([t if t is None or d is None else t.select(d, i) for t, d in zip(tensors, dims)]) for i in range(size)
        ]
        outputs = tuple(None if column[0] is None else torch.stack(column) for column in zip(*rows))
        return outputs, tuple(None if t is None else 0 for t in outputs)
    folded, batch = _fold_inputs(axes, size, dims[:INPUT_COUNT], tensors[:INPUT_COUNT])
    upstream = zip(tensors[INPUT_COUNT:], dims[INPUT_COUNT:])
    folded_grads = [_fold(t, d, size, batch, 2, int(axes.keep_time)) for t, d in upstream]
    grads = apply([*folded, *folded_grads])
    outputs = tuple(
        None if grad is None or t is None else _unfold_like(t, dim, grad, size, batch, base, time)
        for t, dim, grad, base, time in zip(tensors, dims, grads, BASE_NDIM, _times(axes))
    )
    return outputs, tuple(None if t is None else 0 for t in outputs)


def _times(axes: Axes) -> list[int]:
    """How many time axes each input has."""
    return [int(i in CONTROLS and axes.controls_have_time) for i in range(INPUT_COUNT)]


def _fold_inputs(
    axes: Axes, size: int, dims: Dims, inputs: Sequence[Tensor | None]
) -> tuple[list[Tensor | None], int | None]:
    """The axis of vmap, in front of the core's batch axis, becomes one with it. Also returns the batch size there was.

    Inputs that are not mapped are repeated, so that the backward can give each mapped element its own gradient.
    """
    times = _times(axes)
    batch = None
    for t, dim, base, time in zip(inputs, dims, BASE_NDIM, times):
        if t is not None and t.ndim - (dim is not None) > base + time:
            native = list(t.shape)
            if dim is not None:
                del native[dim]
            batch = native[time]
    folded = [_fold(t, d, size, batch, base, time) for t, d, base, time in zip(inputs, dims, BASE_NDIM, times)]
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
