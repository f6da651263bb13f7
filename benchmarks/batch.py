"""Many copies of a small scene in one call, beside a loop of single calls: 64 scenes of 10 bodies.

`even`: every copy has the same contacts. `ragged`: the copies start from different heights, so that at any time some
fall, some land and some rest. Either is compared to its own loop over the same copies, and so if ragged numbers of
contacts cost nothing the two ratios are alike.

Prints one CSV line per case, medians over rounds: scene-steps per second of batch and loop, forward and forward +
backward, and their ratio. Should be at least 1.7 on two cores.
"""

from __future__ import annotations

import os
import statistics
import sys
from collections.abc import Callable
from functools import partial

import torch
from _common import advance, in_turns, make_parser, median_ratio, print_header, print_row

import diffsim as ds

COLUMNS = ("case", "scenes", "bodies", "steps", "threads", "loop_forward_per_s", "batch_forward_per_s")
COLUMNS += ("forward_ratio", "loop_gradient_per_s", "batch_gradient_per_s", "gradient_ratio")
DT = 0.01
FIELDS = ("position", "orientation", "velocity", "angular_velocity")


def scene_of(bodies: int) -> ds.Scene:
    """Tilted boxes that land on the ground and on each other, two by two."""
    scene = ds.Scene()
    scene.add_ground()
    for k in range(bodies):
        scene.add_body(
            ds.shapes.box((0.4, 0.3, 0.2)),
            density=800.0,
            position=(k // 2, 0.02 * k, 0.3 + 0.5 * (k % 2)),
            orientation=(1.0, 0.05 * k, 0.1, 0.0),
        )
    return scene


def batch_of(sim: ds.Simulator, count: int, ragged: bool) -> ds.State:
    state = sim.initial_state(batch=count)
    lift = torch.linspace(0.0, 1.0, count, dtype=torch.float64) if ragged else torch.zeros(count, dtype=torch.float64)
    return state.replace(position=state.position + lift[:, None, None] * torch.tensor([0.0, 0.0, 1.0]).double())


def gradient(sim: ds.Simulator, state: ds.State, steps: int) -> None:
    inputs = {name: getattr(state, name).detach().clone().requires_grad_() for name in FIELDS}
    final = sim.rollout(state.replace(**inputs), None, steps)[-1]
    torch.autograd.grad(final.position.square().sum() + final.velocity.square().sum(), list(inputs.values()))


def one_by_one(
    call: Callable[[ds.Simulator, ds.State, int], object], sim: ds.Simulator, scenes: list[ds.State], steps: int
) -> None:
    for state in scenes:
        call(sim, state, steps)


def main() -> int:
    parser = make_parser(__doc__, rounds=11, cpu_time=False)
    parser.add_argument("--scenes", type=int, default=64)
    parser.add_argument("--bodies", type=int, default=10)
    parser.add_argument("--steps", type=int, nargs="+", default=(1, 100), help="per call")
    parser.add_argument("--threads", type=int, default=os.cpu_count())
    options = parser.parse_args()
    if options.quick:
        options.rounds, options.steps = 3, (20,)
    torch.set_num_threads(1)
    sim = ds.Simulator(scene_of(options.bodies), dt=DT, num_threads=options.threads)
    print_header(clock=options.clock)
    print_row(COLUMNS)
    for steps in options.steps:
        for case in ("even", "ragged"):
            batch = batch_of(sim, options.scenes, case == "ragged")
            if steps == 1:  # from states with contact, or none of the copies would have any
                batch = advance(sim, batch, 30)[-1]
            scenes = [batch[k] for k in range(options.scenes)]
            calls: dict[str, Callable[[], object]] = {}
            for name, call in (("forward", advance), ("gradient", gradient)):
                calls[f"loop {name}"] = partial(one_by_one, call, sim, scenes, steps)
                calls[f"batch {name}"] = partial(call, sim, batch, steps)
            for warm in calls.values():
                warm()
            seconds = in_turns(calls, options.rounds)
            row: list[object] = [case, options.scenes, options.bodies, steps, options.threads]
            for name in ("forward", "gradient"):
                loop, batched = seconds[f"loop {name}"], seconds[f"batch {name}"]
                row += [options.scenes * steps / statistics.median(times) for times in (loop, batched)]
                row.append(median_ratio(loop, batched))
            print_row(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
