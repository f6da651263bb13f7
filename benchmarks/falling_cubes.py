"""Falling cubes: N unit cubes, 2 m apart, dropped 0.5 m on a plane; 2 s in steps of 0.01 s, one thread.

Beside MuJoCo's forward in the same run, in turns, with default options and both kinds of friction cones; its steps are
looped over in C, by the faster of `mj_step(nstep=...)` and `mujoco.rollout`. Ours goes through `Simulator.rollout`:
forward alone (no gradients recorded), and forward + backward (gradient of a loss on the final state with respect to the
initial state and the masses). Prints one CSV line per N, medians over rounds, and the log-log slopes; should be at most
1.0 (forward / MuJoCo), 2.0 (forward + backward / MuJoCo), 1.05 (slopes), 2000 bytes of tape per cube and step.

Also: the peak of memory added by building and forward + backward, and by building and forward in MuJoCo; the gap that
cubes at rest keep from the plane. MuJoCo's cubes have friction and soft contacts; ours are stiff, and frictionless
unless --friction gives all of them, and MuJoCo's, a coefficient: they take turns with frictionless ones then, and
should take at most 1.5 times as long forward. Needs the extra `bench`.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from functools import partial
from typing import Any, ClassVar

import torch
from _common import (
    Clock,
    Table,
    added_memory,
    advance,
    differentiate,
    fresh_processes,
    in_turns,
    make_parser,
    median_ratio,
    print_header,
    print_slopes,
    tape_bytes,
)
from _mujoco import CONES, boxes, faster, set_friction, ways_to_step

import diffsim as ds
from diffsim import scenes

COUNTS = (20, 100, 200, 300, 1000)
DT, STEPS = 0.01, 200
DROP, STRIDE, DENSITY = 0.5, 2.0, 1000.0
TIMES = ("forward_s", "forward_backward_s", "mujoco_pyramidal_s", "mujoco_elliptic_s")
RATIOS = tuple(f"{ours}_to_{cone}" for ours in ("forward", "forward_backward") for cone in CONES)
TO_FRICTIONLESS = ("forward_to_frictionless", "forward_backward_to_frictionless")  # with --friction
COLUMNS = ("cubes", "steps", *TIMES, *RATIOS)
FACTS = ("tape_bytes_per_cube_step", "memory_mb", "mujoco_memory_mb", "rest_gap_m")


class Worker:
    """One number of cubes, in a process of its own."""

    cases: ClassVar[dict[str, Callable[[], object]]] = {}

    @classmethod
    def prepare(cls, count: int, friction: float) -> dict[str, float]:
        """Build all scenes and run each once. Returns the columns that are not times."""
        torch.set_num_threads(1)
        made: dict[str, Any] = {}

        def make(friction: float) -> ds.Simulator:
            scene = scenes.falling_cubes(count, drop=DROP, stride=STRIDE, density=DENSITY)
            sim = ds.Simulator(scene, dt=DT, num_threads=1, on_failure="raise")
            with torch.no_grad():
                sim.friction.fill_(friction)
            return sim

        def make_and_differentiate() -> None:
            made["sim"] = make(friction)
            made["start"] = made["sim"].initial_state()
            differentiate(made["sim"], made["start"], STEPS)

        facts = {"memory_mb": added_memory(make_and_differentiate)}
        sim, start = made["sim"], made["start"]

        def mujoco_runs(cone: str) -> dict[str, Callable[[], object]]:
            model, data = boxes(start.position.numpy(), 1.0, dt=DT, density=DENSITY, cone=cone)
            if friction > 0.0:
                set_friction(model, friction, cone)
            return ways_to_step(model, data, STEPS)

        facts["mujoco_memory_mb"] = added_memory(lambda: mujoco_runs(CONES[0])["mj_step"]())
        facts["rest_gap_m"] = float((advance(sim, start, STEPS).position[-1, :, 2] - 0.5).abs().max())
        facts["tape_bytes_per_cube_step"] = tape_bytes(sim, start, STEPS) / (count * STEPS)
        cls.cases = {
            "forward": partial(advance, sim, start, STEPS),
            "forward_backward": partial(differentiate, sim, start, STEPS),
        }
        if friction > 0.0:
            without = make(0.0)
            cls.cases["frictionless_forward"] = partial(advance, without, start, STEPS)
            cls.cases["frictionless_forward_backward"] = partial(differentiate, without, start, STEPS)
        for cone in CONES:
            for name, run in mujoco_runs(cone).items():
                cls.cases[f"mujoco_{cone} {name}"] = run
        for call in cls.cases.values():
            call()
        return facts

    @classmethod
    def measure(cls, clock: Clock) -> dict[str, float]:
        """Seconds each case takes, the second time: the first finds a processor that did something else meanwhile."""
        return {name: values[1] for name, values in in_turns(cls.cases, 2, clock).items()}


def row_of(count: int, facts: dict[str, float], rounds: list[dict[str, float]]) -> dict[str, float]:
    seconds = {name: [measured[name] for measured in rounds] for name in rounds[0]}
    for cone in CONES:
        seconds[f"mujoco_{cone}"] = faster(seconds, f"mujoco_{cone} ")
    row = {"cubes": count, "steps": STEPS, **facts}
    row.update({f"{name}_s": statistics.median(values) for name, values in seconds.items()})
    for ours in ("forward", "forward_backward"):
        row.update({f"{ours}_to_{cone}": median_ratio(seconds[ours], seconds[f"mujoco_{cone}"]) for cone in CONES})
        if without := seconds.get(f"frictionless_{ours}"):
            row[f"{ours}_to_frictionless"] = median_ratio(seconds[ours], without)
    return row


def main() -> int:
    parser = make_parser(__doc__, rounds=11)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="numbers of cubes")
    parser.add_argument("--friction", type=float, default=0.0, help="coefficient of all cubes and the plane")
    options = parser.parse_args()
    if options.quick:
        options.counts, options.rounds = [4], 1
    print_header("mujoco", clock=options.clock)
    table = Table((*COLUMNS, *(TO_FRICTIONLESS if options.friction > 0.0 else ()), *FACTS))
    rounds: dict[int, list[dict[str, float]]] = {count: [] for count in options.counts}
    with ExitStack() as stack:
        processes = fresh_processes()
        workers = {count: stack.enter_context(ProcessPoolExecutor(1, processes)) for count in options.counts}
        facts = {
            count: worker.submit(Worker.prepare, count, options.friction).result() for count, worker in workers.items()
        }
        for _ in range(options.rounds):  # the numbers of cubes take turns, too, for the sake of the slopes
            for count, worker in workers.items():
                rounds[count].append(worker.submit(Worker.measure, options.clock).result())
    for count in options.counts:
        table.add(row_of(count, facts[count], rounds[count]))
    print_slopes({name: table.curve("cubes", name) for name in TIMES})
    return 0


if __name__ == "__main__":
    sys.exit(main())
