"""One scene on one thread and on more: falling cubes, forward and forward + backward, threads taking turns.

Prints one CSV line per number of cubes and threads, medians over rounds: a speed-up is the median of the ratios to one
thread within each round. Should be at least 1.6 forward and backward for 1,000 cubes on two threads, and not below 0.98
for 20, which one thread steps alone.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from functools import partial

import torch
from _common import advance, in_turns, make_parser, median_ratio, print_header, print_row, repeated

import diffsim as ds
from diffsim import scenes

COLUMNS = ("cubes", "steps", "threads", "forward_s", "backward_s", "forward_speedup", "backward_speedup")
DT = 0.01


class Case:
    """A rollout, recorded or not, and the backward of a recorded one."""

    def __init__(self, count: int, threads: int, steps: int) -> None:
        self.sim = ds.Simulator(scenes.falling_cubes(count), dt=DT, num_threads=threads, on_failure="raise")
        self.sim.mass.requires_grad_()
        self.start, self.steps = self.sim.initial_state(), steps
        final = self.sim.rollout(self.start, None, steps)[-1]
        self.loss = final.position.square().sum() + final.velocity.square().sum()
        self.backward()

    def forward(self) -> None:
        advance(self.sim, self.start, self.steps)

    def backward(self) -> None:
        torch.autograd.grad(self.loss, self.sim.mass, retain_graph=True)


def main() -> int:
    parser = make_parser(__doc__, rounds=11, cpu_time=False)
    parser.add_argument("--counts", type=int, nargs="+", default=(20, 100, 300, 1000, 3000), help="numbers of cubes")
    parser.add_argument("--threads", type=int, nargs="+", default=(1, 2), help="beside 1")
    parser.add_argument("--steps", type=int, default=200)
    options = parser.parse_args()
    if options.quick:
        options.counts, options.rounds, options.steps = (20, 400), 1, 20
    torch.set_num_threads(1)
    print_header(clock=options.clock)
    print_row(COLUMNS)
    for count in options.counts:
        cases = {threads: Case(count, threads, options.steps) for threads in sorted({1, *options.threads})}
        calls: dict[str, Callable[[], object]] = {}
        for threads, case in cases.items():
            calls |= {f"forward {threads}": case.forward, f"backward {threads}": case.backward}
        repeats = max(1, 1000 // count)  # a round of few cubes would be over too soon to be timed
        seconds = in_turns({name: partial(repeated, call, repeats) for name, call in calls.items()}, options.rounds)
        for threads in cases:
            times = [seconds[f"{way} {threads}"] for way in ("forward", "backward")]
            speedups = [
                median_ratio(seconds[f"{way} 1"], seconds[f"{way} {threads}"]) for way in ("forward", "backward")
            ]
            medians = [statistics.median(values) / repeats for values in times]
            print_row([count, options.steps, threads, *medians, *speedups])
    return 0


if __name__ == "__main__":
    sys.exit(main())
