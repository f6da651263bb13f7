"""Scenes in which much touches, beside MuJoCo's forward: stacks that collapse, bins, heaps, scans, thin things.

Steps of 0.01 s, one thread, times on the processor. Without friction, but for scenes whose names say so: there its
coefficient is 0.5, as in MuJoCo, whose cones are elliptic. One CSV line per scene: `forward_ms` is a step's mean over
`Simulator.rollout` without gradients, whose loop is C++; `longest_ms` is the longest of the same steps taken by single
calls, with failed steps, contacts (most of a step) and Newton iterations of the zone that took most, mean and most over
the steps. The backward is of a loss on the last state, with respect to the initial state and the masses, over the same
steps. MuJoCo takes the same steps in turns with ours, with default options else, looped over in C by the faster of
`mj_step(nstep=...)` and `mujoco.rollout`; not where meshes are not convex, where there is cloth, nor of bodies it takes
to be massless. `batch` is one call for 64 scenes of 10 boxes that touch two by two, pushed at random in every step by
up to a fifth of their weight: its times are of a step of one of them. `longest_to_resting` is how much longer the
dearest step of a landing takes than one at rest. Scenes called `_rest` begin where they have come to rest, ours and
MuJoCo's each in its own way: how fast they still are is in the line before.

    python benchmarks/contact_rich.py --scene bin_20 stack_100 --steps 40

Should be at most, as forward / MuJoCo: 8 for stacks, 12 and 20 for bins, 35, 35 and 12 for layers, with a log-log slope
of 1.35 from 80 to 500 boxes; 8 s in all for the heaps; 400 ms for the longest step of 20,000 faces, 40 ms on average
and 4 times that at 100,000; 1 s in all for the wire and 50 ms for a step of the specks; 1 / 1.5 for the batch; 8 for
`longest_to_resting`; 0.3 for the backward of stacks, bins, layers and heaps; no failed step. With friction: 6 for the
bin, 3 for it at rest; 1.5 for the two layers at rest, and their backward 0.6 of MuJoCo's forward. Needs the extra
`bench`.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import torch
from _common import (
    Recorded,
    Table,
    advance,
    in_turns,
    make_parser,
    median_ratio,
    print_header,
    save_plot,
    slope,
)
from _contact_scenes import scan_on_scan, specks, wire_under_sheet
from _mujoco import faster, model_of, set_friction, ways_to_step

import diffsim as ds
from diffsim import scenes

DT = 0.01
SETTLE = 200  # steps until what lands is at rest
FRICTION = 0.5
COLUMNS = ("scene", "bodies", "steps", "forward_s", "forward_ms", "longest_ms", "failed_steps", "contacts")
COLUMNS += ("iterations_mean", "iterations_most", "backward_to_forward", "mujoco_ms", "forward_to_mujoco")
COLUMNS += ("backward_to_mujoco", "longest_to_resting")


@dataclass(frozen=True)
class Case:
    """Scenes that are run one after the other and reported together."""

    make: Callable[[Any], list[ds.Scene]]
    size: tuple[float, float]  # what `make` takes: of the run, and of a quick one
    steps: int
    in_mujoco: bool = True
    lands: bool = False  # whether to compare with steps at rest
    friction: float = 0.0
    settle: int = 0  # steps before the first that counts


def heaps(count: int) -> list[ds.Scene]:
    """Masses of every other heap are within three decades, of the rest within a factor of 10."""
    return [scenes.heap_of_boxes_and_balls(heaviest=(1000.0, 10.0)[k % 2], seed=k) for k in range(count)]


def one(make: Callable[[Any], ds.Scene]) -> Callable[[Any], list[ds.Scene]]:
    return lambda size: [make(size)]


def two_layers(count: int) -> ds.Scene:
    """Of `count` cubes, or one fewer: the upper layer has one less than the lower."""
    return scenes.two_layer_stack((count + 1) // 2)


CASES = {
    "stack_100": Case(one(scenes.collapsing_stack), (100, 8), 200),
    "stack_300": Case(one(scenes.collapsing_stack), (300, 12), 200),
    "bin_20": Case(one(scenes.boxes_in_bin), (20, 5), 300),
    "bin_60": Case(one(scenes.boxes_in_bin), (60, 6), 300),
    "layers_4": Case(one(scenes.tumbling_layers), (4, 1), 120),
    "layers_5": Case(one(scenes.tumbling_layers), (5, 1), 120),
    "layers_10": Case(one(scenes.tumbling_layers), (10, 2), 120),
    "heaps": Case(heaps, (12, 1), 80),
    "scan_20000": Case(one(scan_on_scan), (20_000, 80), 80, in_mujoco=False),
    "scan_100000": Case(one(scan_on_scan), (100_000, 180), 80, in_mujoco=False),
    "wire": Case(one(wire_under_sheet), (21, 4), 12, in_mujoco=False),
    "specks": Case(one(specks), (1e-6, 1e-2), 80, in_mujoco=False),
    "landing_100": Case(one(two_layers), (100, 5), 12, lands=True),
    "landing_300": Case(one(two_layers), (300, 7), 12, lands=True),
    "bin_20_friction": Case(one(scenes.boxes_in_bin), (20, 5), 300, friction=FRICTION),
    "bin_20_friction_rest": Case(one(scenes.boxes_in_bin), (20, 5), 100, friction=FRICTION, settle=2 * SETTLE),
    **{
        f"two_layers_{count}_friction_rest": Case(one(two_layers), (count, 7), 10, friction=FRICTION, settle=SETTLE)
        for count in (300, 1000, 3000)
    },
}
BATCH, BATCH_BODIES, BATCH_STEPS = 64, 10, 100


class Run:
    """One scene, ours and MuJoCo's."""

    def __init__(self, scene: ds.Scene, steps: int, case: Case) -> None:
        self.sim = ds.Simulator(scene, dt=DT, num_threads=1)
        with torch.no_grad():
            self.sim.friction.fill_(case.friction)
        self.start = self.sim.initial_state()
        self.steps = steps
        self.mujoco: dict[str, Callable[[], object]] = {}
        if case.in_mujoco:
            model, data = model_of(scene, self.start, dt=DT)
            if case.friction > 0.0:
                set_friction(model, case.friction)
            if case.settle:
                mujoco.mj_step(model, data, nstep=case.settle)
            self.mujoco = ways_to_step(model, data, steps)
        if case.settle:
            self.start = advance(self.sim, self.start, case.settle)[-1]
            speeds = f"{float(self.start.velocity.abs().max()):.1g}"
            speeds += f", MuJoCo's {np.abs(data.qvel.reshape(-1, 6)[:, :3]).max():.1g}" if case.in_mujoco else ""
            print(f"# at rest to {speeds} m/s")
        self.forward = partial(advance, self.sim, self.start, steps)

    def step_by_step(self, clock: Callable[[], float]) -> list[tuple[float, ds.Info]]:
        """Seconds and statistics of every step."""
        found = []
        state = self.start
        with torch.no_grad():
            for _ in range(self.steps):
                begin = clock()
                state = self.sim(state)
                seconds = clock() - begin
                assert self.sim.info is not None
                found.append((seconds, self.sim.info))
        return found

    def backward(self, clock: Callable[[], float]) -> float:
        """Seconds of a backward, apart from the forward that records."""
        recorded = Recorded(self.sim, self.start, self.steps)
        begin = clock()
        recorded.backward()
        return clock() - begin

    def at_rest(self) -> Callable[[], object]:
        """Ten steps of what has landed."""
        return partial(advance, self.sim, advance(self.sim, self.start, SETTLE)[-1], 10)


def all_of(calls: list[Callable[[], object]]) -> None:
    for call in calls:
        call()


def measure(name: str, case: Case, options: argparse.Namespace) -> dict[str, Any]:
    """A line of the table."""
    made = options.make(name, case)
    steps = min(case.steps, options.steps or case.steps)
    runs = [Run(scene, steps, case) for scene in made]
    clock = options.clock
    singles = [one_step for run in runs for one_step in run.step_by_step(clock)]
    seconds = [spent for spent, _ in singles]
    infos = [info for _, info in singles]
    cases: dict[str, Callable[[], object]] = {"forward": partial(all_of, [run.forward for run in runs])}
    for way in runs[0].mujoco:
        cases[f"mujoco {way}"] = partial(all_of, [run.mujoco[way] for run in runs])
        cases[f"mujoco {way}"]()  # once before it is timed, as ours was
    if case.settle and not options.forward_only:
        cases["backward"] = Recorded(runs[0].sim, runs[0].start, steps).backward
        cases["backward"]()
    times = in_turns(cases, options.rounds, clock)
    forward = statistics.median(times["forward"])
    row: dict[str, Any] = {
        "scene": name,
        "bodies": sum(int((run.sim.mass > 0.0).sum()) for run in runs),
        "steps": steps,
        "forward_s": forward,
        "forward_ms": 1e3 * forward / len(singles),
        "longest_ms": 1e3 * max(seconds),
        "failed_steps": sum(info.failed_steps for info in infos),
        "contacts": max(info.contacts for info in infos),
        "iterations_mean": statistics.mean(info.iterations for info in infos),
        "iterations_most": max(info.iterations for info in infos),
    }
    if "backward" in times:
        row["backward_to_forward"] = median_ratio(times["backward"], times["forward"])
    elif not options.forward_only:
        row["backward_to_forward"] = sum(run.backward(clock) for run in runs) / forward
    if case.in_mujoco:
        best = faster(times, "mujoco ")
        row["mujoco_ms"] = 1e3 * statistics.median(best) / len(singles)
        row["forward_to_mujoco"] = median_ratio(times["forward"], best)
        if "backward" in times:
            row["backward_to_mujoco"] = median_ratio(times["backward"], best)
    if case.lands:
        resting = in_turns({"rest": runs[0].at_rest()}, options.rounds, clock)["rest"]
        row["longest_to_resting"] = max(seconds) / (statistics.median(resting) / 10)
    return row


def measure_batch(options: argparse.Namespace) -> dict[str, Any]:
    """Times are of one step of one of the scenes."""
    count, steps = (3, 5) if options.quick else (BATCH, min(BATCH_STEPS, options.steps or BATCH_STEPS))
    scene = scenes.touching_boxes(BATCH_BODIES)
    sim = ds.Simulator(scene, dt=DT, num_threads=1)
    start = sim.initial_state(batch=count)
    most = 0.2 * 9.81 * float(sim.mass.mean())
    force = np.random.default_rng(0).uniform(-most, most, (steps, count, BATCH_BODIES, 3))
    force[..., 2] = 0.0
    controls = ds.Control(force=torch.from_numpy(force))

    def forward() -> None:
        with torch.no_grad():
            sim.rollout(start, controls, steps)

    model, data = model_of(scene, sim.initial_state(), dt=DT)
    initial = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, initial, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    pushed = np.zeros((count, steps, model.nbody, 6))  # body 0 is the world
    pushed[:, :, 1:, :3] = force.transpose(1, 0, 2, 3)
    peer = partial(
        mujoco.rollout.rollout,
        model,
        data,
        np.tile(initial, (count, 1)),
        pushed.reshape(count, steps, -1),
        control_spec=int(mujoco.mjtState.mjSTATE_XFRC_APPLIED),
    )
    cases: dict[str, Callable[[], object]] = {"forward": forward, "mujoco": peer}
    for call in cases.values():
        call()
    times = in_turns(cases, options.rounds, options.clock)
    forward_s, mujoco_s = (statistics.median(times[name]) for name in ("forward", "mujoco"))
    info = sim.info
    assert info is not None
    return {
        "scene": "batch",
        "bodies": count * BATCH_BODIES,
        "steps": steps,
        "forward_s": forward_s,
        "forward_ms": 1e3 * forward_s / (count * steps),
        "failed_steps": info.failed_steps,
        "contacts": info.contacts,
        "mujoco_ms": 1e3 * mujoco_s / (count * steps),
        "forward_to_mujoco": median_ratio(times["forward"], times["mujoco"]),
    }


def draw(rows: list[dict[str, Any]], figure: Any) -> None:
    """Ratios to MuJoCo, and how far the longest step is from the mean."""
    left, right = figure.subplots(1, 2, sharey=True)
    for axes, column, title in (
        (left, "forward_to_mujoco", "forward / MuJoCo's forward"),
        (right, "longest_ms", "step: mean, and the longest [ms]"),
    ):
        shown = [row for row in rows if row.get(column) is not None]
        places = [rows.index(row) for row in shown]
        values = [row[column] for row in shown]
        if column == "longest_ms":
            means = [row["forward_ms"] for row in shown]
            axes.hlines(places, means, values, color="C0", lw=1.0)
            axes.plot(means, places, "o", ms=4.0, color="C0")
            axes.plot(values, places, "|", ms=9.0, color="C0")
        else:
            axes.plot(values, places, "o", ms=4.0, color="C1")
            axes.axvline(1.0, color="0.6", lw=0.8)
        axes.set(xscale="log", xlabel=title)
        axes.grid(True, axis="x", which="major", alpha=0.3)
    left.set_yticks(range(len(rows)), [row["scene"] for row in rows])
    left.invert_yaxis()


def main() -> int:
    parser = make_parser(__doc__, rounds=3, plot=True, cpu_time=False)
    parser.set_defaults(clock=time.process_time)
    parser.add_argument("--scene", nargs="+", choices=[*CASES, "batch"], default=[*CASES, "batch"], help="which to run")
    parser.add_argument("--steps", type=int, help="at most so many of each scene")
    parser.add_argument("--forward-only", action="store_true", help="no backward")
    parser.add_argument("--scan", type=Path, help="a mesh to take for scans in place of the generated one")
    options = parser.parse_args()
    if options.quick:
        options.rounds, options.steps = 1, min(options.steps or 5, 5)

    def make(name: str, case: Case) -> list[ds.Scene]:
        if options.scan is not None and name.startswith("scan"):
            return [scan_on_scan(0, options.scan)]
        return case.make(case.size[options.quick])

    options.make = make
    warnings.simplefilter("ignore", ds.ConvergenceWarning)  # failed steps are in the table
    warnings.simplefilter("ignore", ds.FastImpactWarning)
    torch.set_num_threads(1)
    print_header("mujoco", clock=options.clock)
    table = Table(COLUMNS)
    for name in options.scene:
        table.add(measure_batch(options) if name == "batch" else measure(name, CASES[name], options))
    layers = [row for row in table.rows if row["scene"].startswith("layers")]
    sizes = [row["bodies"] for row in layers]
    if len(set(sizes)) > 1:
        print(f"# log-log slope of layers: {slope(sizes, [row['forward_ms'] for row in layers]):.3f}")
    save_plot(options.out / "contact_rich.png", partial(draw, table.rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
