"""What a step costs beside its physics: one free body, one step, called from Python.

Timed beside a do-nothing autograd.Function of the same arity (all inputs, those of cloth None, and the state out), in
turns, in the same process: forward through `Simulator.__call__` with gradients recorded, and backward to the state.
Prints one CSV line per run; the ratios should be at most 2.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from _common import in_turns, make_parser, print_header, print_row, repeated
from torch import Tensor

import diffsim as ds
from diffsim._input_table import INPUT_COUNT, STATE_COUNT

COLUMNS = ("run", "nothing_forward_us", "step_forward_us", "forward_ratio")
COLUMNS += ("nothing_backward_us", "step_backward_us", "backward_ratio")


class Nothing(torch.autograd.Function):
    """As `diffsim.ops` has it: an object and tensors (or None) in, tensors (or None) out."""

    @staticmethod
    def forward(call: object, *inputs: Tensor | None) -> tuple[Tensor | None, ...]:
        return tuple(None if t is None else t.clone() for t in inputs[:STATE_COUNT])

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Any) -> None:
        ctx.save_for_backward(*inputs[1:])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return (None, *grads, *(None,) * (INPUT_COUNT - STATE_COUNT))


def cases() -> dict[str, Callable[[], object]]:
    """Name -> the call to be timed."""
    scene = ds.Scene()
    scene.add_sphere(0.5, density=1000.0, angular_velocity=(1.0, 2.0, 3.0))
    sim = ds.Simulator(scene, dt=0.01)
    start = sim.initial_state()
    inputs = [t.requires_grad_() for t in (start.position, start.orientation, start.velocity, start.angular_velocity)]
    arguments = (object(), *sim._checked_inputs("overhead", start, None, None).inputs)
    end = sim(start)
    stepped = (end.position, end.orientation, end.velocity, end.angular_velocity)
    unchanged = Nothing.apply(*arguments)[:4]
    upstream = [torch.ones_like(t) for t in stepped]
    return {
        "nothing_forward": lambda: Nothing.apply(*arguments),
        "step_forward": lambda: sim(start),
        "nothing_backward": lambda: torch.autograd.grad(unchanged, inputs, upstream, retain_graph=True),
        "step_backward": lambda: torch.autograd.grad(stepped, inputs, upstream, retain_graph=True),
    }


def main() -> int:
    parser = make_parser(__doc__, rounds=21)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--repeats", type=int, default=500, help="calls per round")
    options = parser.parse_args()
    if options.quick:
        options.runs, options.rounds, options.repeats = 1, 3, 20
    torch.set_num_threads(1)
    timed = {name: partial(repeated, call, options.repeats) for name, call in cases().items()}
    print_header(clock=options.clock)
    print_row(COLUMNS)
    for run in range(1, options.runs + 1):
        seconds = in_turns(timed, options.rounds, options.clock)
        us = {name: 1e6 * statistics.median(values) / options.repeats for name, values in seconds.items()}
        values: list[float] = []
        for direction in ("forward", "backward"):
            nothing, step = us[f"nothing_{direction}"], us[f"step_{direction}"]
            values += [nothing, step, step / nothing]
        print_row([run, *values])
    return 0


if __name__ == "__main__":
    sys.exit(main())
