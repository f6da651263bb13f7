"""One call of the core: tensors in, tensors out. What autograd, torch.func and torch.compile make of it is above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from . import _core
from ._check import message
from ._input_table import LABELS
from ._outcome import gradient_error

OptionalTensors = tuple[Tensor | None, ...]

_LARGEST, _LARGEST_SINGLE = torch.finfo(torch.float64).max, torch.finfo(torch.float32).max


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
        want_contacts: Whether `contacts` is.
        first_step: How many steps other calls made before, for error messages.
        single: Whether gradients must fit into single precision, where a float32 input will have them.

    Attributes:
        info: Statistics, after the call.
        tape: What the backward needs, where something requires grad.
        arrays: The inputs, as the core was given them, where there is a tape: to ask tensors again takes as long as a
            small backward.
        contacts: What pushed in the last step, arrays by name.
        signature: Hash of each step's active contacts, uint64, shape (steps[, B]).
    """

    __slots__ = (
        "arrays",
        "contacts",
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
        "want_contacts",
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
        want_contacts: bool = False,
        first_step: int = 0,
        single: bool = False,
    ) -> None:
        self.model = model
        self.options = options
        self.steps = steps
        self.num_threads = num_threads
        self.controls_have_time = controls_have_time
        self.keep_time = keep_time
        self.keep_tape = keep_tape
        self.want_signature = want_signature
        self.want_contacts = want_contacts
        self.first_step = first_step
        self.single = single
        self.record = False
        self.tape: _core.Tape | None = None
        self.arrays: list[Any] | None = None
        self.info: _core.Info | None = None
        self.signature: np.ndarray | None = None  # uint64 hash of the active contacts, shape (steps[, B])
        self.contacts: dict[str, np.ndarray] | None = None  # of the last step, see ContactReadout of the core


def run_forward(call: RolloutCall, inputs: Sequence[Tensor | None]) -> OptionalTensors:
    """State after the last step, or after each; what the call leaves behind is then in `call`."""
    try:
        arrays = as_arrays(inputs)
    except RuntimeError:
        _refuse_sparse(inputs)
        raise
    result = _run(call, arrays, call.record or call.want_contacts)
    if call.want_contacts:
        assert result.tape is not None  # it was recorded
        call.contacts = _core.contacts(result.tape, arrays)
    if call.record:
        call.tape, call.arrays = result.tape, arrays
    call.info = result.info
    if call.want_signature:
        call.signature = result.signature
    return tuple([None if a is None else torch.from_numpy(a) for a in result.trajectory])


def run_backward(call: RolloutCall, needs: Sequence[bool], inputs: list[Any], upstream: list[Any]) -> OptionalTensors:
    """Gradients with respect to the inputs that need one.

    Args:
        call: That of the forward. Without a tape, for checkpointing: the same bits again, recorded this time, and
            dropped after use.
        needs: Of each input.
        inputs: Arrays.
        upstream: Arrays of the gradients of the outputs.
    """
    if call.options.newton_iterations is not None:
        raise NotImplementedError(
            "diffsim: there are no gradients through newton_iterations: where Newton's method is cut short they"
            " take third derivatives of the elastic energy; leave it at None, or step under torch.no_grad()"
        )
    tape = call.tape or _run(call, inputs, record=True).tape
    assert tape is not None  # it was recorded
    limit = _LARGEST_SINGLE if call.single else _LARGEST
    try:
        grads = _core.rollout_backward(tape, inputs, upstream, needs=needs, num_threads=call.num_threads, limit=limit)
    except _core.GradientFault as fault:
        raise gradient_error(call.model, fault) from None
    return tuple(None if g is None else torch.from_numpy(g) for g in grads)


def _array(tensor: Tensor) -> Any:  # a float64 array, as the core wants it
    if not tensor.is_contiguous():
        tensor = tensor.contiguous()
    return tensor.numpy(force=True)  # force: also where it requires grad; no copy on the cpu


def as_arrays(tensors: Sequence[Tensor | None]) -> list[Any]:
    return [None if t is None else _array(t) for t in tensors]


def _refuse_sparse(inputs: Sequence[Tensor | None]) -> None:
    """Looked for once something has gone wrong: to ask every tensor of every call would take too long."""
    for name, t in zip(LABELS, inputs):
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
