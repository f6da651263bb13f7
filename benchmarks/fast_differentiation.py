"""What it costs to differentiate one large zone, by three ways: Table 2 of Qiao et al. 2020, and ten times as far.

Two layers of cubes of edge 0.1 m, the upper shifted by half a cube, so that all are one zone; N counts both layers.
Steps of 0.01 s, one thread. `dense` is LU of the whole KKT matrix (the paper's Eq. 9), `qr` the paper's fast
differentiation (Eq. 13-15), `exact` ours. One CSV line per N and mode: what the backward of one step of the stack at
rest takes and adds to memory at most; error, of `dense` and `qr` the distance of their gradients to those of the same
linear system in long double, so their rounding (positions' or velocities', whichever is larger), of `exact` that to
central differences (median over random directions); how often faster than `dense`, beside the paper's figure for `qr`.
Lines of `exact` also have the forward of that step; forward and backward of the dearest of the steps in which
the stack lands; and the forward of MuJoCo's step of the same stack at rest (the faster of its cones), measured in
turns.

Modes that would take too long or too much memory are left out, with a line that says so. Then the log-log slopes, and
a plot. The paper's figures: 1.43 / 7.76 / 21.88 s without and 0.41 / 0.86 / 1.30 s with fast differentiation at 100,
200, 300 cubes, printed in 2020; this machine is about 7 times faster on the baseline both know, so no time of ours
stands beside them. Needs the extra `bench`.
"""

from __future__ import annotations

import statistics
import sys
from functools import partial
from typing import Any

import numpy as np
import torch
from _common import (
    STATE_FIELDS,
    Clock,
    Recorded,
    Table,
    added_memory,
    advance,
    draw_curves,
    in_fresh_process,
    in_turns,
    make_parser,
    median_ratio,
    print_header,
    print_slopes,
    save_plot,
)
from _long_double import rounding
from _mujoco import CONES, boxes, faster, ways_to_step

import diffsim as ds
from diffsim import scenes

COUNTS = (100, 200, 300, 1000, 3000)
MODES = ("exact", "qr", "dense")
DT, SETTLE = 0.01, 200  # [s]; steps until the stack is at rest
EDGE = 0.1
REPEATS = 10  # resting steps per measurement
LANDING = 12  # first steps, within which the stack lands
PAPER_SPEEDUP = {100: 3.49, 200: 9.02, 300: 16.83}  # Table 2: 1.43 / 0.41, 7.76 / 0.86, 21.88 / 1.30
COLUMNS = ("cubes", "contacts", "mode", "backward_ms", "memory_mb", "error", "dense_to_this", "paper_dense_to_qr")
COLUMNS += ("forward_ms", "landing_forward_ms", "landing_backward_ms", "landing_to_resting")
COLUMNS += ("mujoco_forward_ms", "forward_to_mujoco", "backward_to_mujoco")


def simulator(count: int, mode: str) -> ds.Simulator:
    """Of `count` cubes, or one fewer: the upper layer has one less than the lower."""
    return ds.Simulator(
        scenes.two_layer_stack((count + 1) // 2, edge=EDGE), dt=DT, adjoint=mode, num_threads=1, on_failure="raise"
    )


def settle(count: int) -> tuple[list[np.ndarray], int]:
    """The stack at rest, as arrays for `at_rest`, and its contacts."""
    torch.set_num_threads(1)
    sim = simulator(count, "exact")
    state = advance(sim, sim.initial_state(), SETTLE)[-1]
    info = sim.info
    assert info is not None
    cubes = len(sim.body_names)
    assert (info.zones, info.largest_zone) == (1, cubes), f"the stack is not one zone: {info}"
    # Without friction the cubes creep on: landing leaves them 0.2 mm/s sideways.
    assert float(state.velocity.abs().max()) < 1e-3, "the stack is not at rest"
    return [getattr(state, name).numpy().copy() for name in STATE_FIELDS], info.contacts


def at_rest(arrays: list[np.ndarray]) -> ds.State:
    return ds.State(**{name: torch.from_numpy(array) for name, array in zip(STATE_FIELDS, arrays)})


def central_differences(sim: ds.Simulator, state: ds.State) -> float:
    """Relative error of the gradient of one step; median over random directions."""
    report = ds.diagnostics.gradcheck(
        sim, state, steps=1, wrt=("position", "velocity", "angular_velocity", "gravity"), directions=2
    )
    return report.median_error


def measure_mode(count: int, mode: str, arrays: list[np.ndarray], rounds: int, clock: Clock) -> dict[str, Any]:
    """In a fresh process: a backward through one resting step."""
    torch.set_num_threads(1)
    sim, state = simulator(count, mode), at_rest(arrays)
    recorded = Recorded(sim, state, 1)
    row: dict[str, Any] = {"memory_mb": added_memory(recorded.backward)}
    seconds = in_turns({mode: recorded.backward}, rounds, clock)[mode]
    row["backward_ms"] = 1e3 * statistics.median(seconds)
    if mode != "exact":
        row["error"] = rounding(sim, state)
    return row


def measure_steps(count: int, arrays: list[np.ndarray], rounds: int, clock: Clock) -> dict[str, Any]:
    """In a fresh process: steps at rest and at landing, and MuJoCo's, in turns."""
    torch.set_num_threads(1)
    sim, state = simulator(count, "exact"), at_rest(arrays)
    start = sim.initial_state()
    trajectory = [start, *advance(sim, start, LANDING)]
    landing = {str(k): partial(advance, sim, trajectory[k], 1) for k in range(LANDING)}
    seconds = in_turns(landing, 2, clock)
    dearest = max(landing, key=lambda k: min(seconds[k]))
    cases: dict[str, Any] = {
        "forward": partial(advance, sim, state, REPEATS),
        "backward": Recorded(sim, state, REPEATS).backward,
        "landing": landing[dearest],
        "landing backward": Recorded(sim, trajectory[int(dearest)], 1).backward,
    }
    for cone in CONES:
        model, data = boxes(start.position.numpy(), EDGE, dt=DT, gravity=9.8, cone=cone)
        ways_to_step(model, data, SETTLE)["mj_step"]()
        for way, call in ways_to_step(model, data, REPEATS).items():
            cases[f"mujoco {cone} {way}"] = call
    for call in cases.values():
        call()
    seconds = in_turns(cases, rounds, clock)
    mujoco = faster(seconds, "mujoco ")
    row = {
        "forward_ms": 1e3 * statistics.median(seconds["forward"]) / REPEATS,
        "backward_ms": 1e3 * statistics.median(seconds["backward"]) / REPEATS,
        "landing_forward_ms": 1e3 * statistics.median(seconds["landing"]),
        "landing_backward_ms": 1e3 * statistics.median(seconds["landing backward"]),
        "landing_to_resting": REPEATS * median_ratio(seconds["landing"], seconds["forward"]),
        "mujoco_forward_ms": 1e3 * statistics.median(mujoco) / REPEATS,
        "forward_to_mujoco": median_ratio(seconds["forward"], mujoco),
        "backward_to_mujoco": median_ratio(seconds["backward"], mujoco),
    }
    return row | {"error": central_differences(sim, state)}


def cost(mode: str, cubes: int, contacts: int) -> tuple[float, float]:
    """About how long and how much memory a backward takes [s], [MB]."""
    n, m = 6 * cubes, contacts
    if mode == "dense":  # LU, twice the matrix
        return (2.0 / 3.0) * (n + m) ** 3 / 3e9, 16e-6 * (n + m) ** 2
    if mode == "qr":  # Householder by columns
        short, long = sorted((n, m))
        return 2.0 * short**2 * (long - short / 3.0) / 1e9, 24e-6 * n * m
    return 0.0, 0.0


def draw(table: Table, figure: Any) -> None:
    columns = {"backward_ms": "backward of a step [ms]", "memory_mb": "peak of memory it adds [MB]"}
    for axes, (column, label) in zip(figure.subplots(1, 2), columns.items()):
        curves = {mode: table.curve("cubes", column, mode=mode) for mode in MODES}
        if column == "backward_ms":
            curves["MuJoCo, forward"] = table.curve("cubes", "mujoco_forward_ms", mode="exact")
        draw_curves(axes, curves, "cubes", label)


def main() -> int:
    parser = make_parser(__doc__, rounds=7, plot=True)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="numbers of cubes")
    parser.add_argument("--seconds", type=float, default=60.0, help="a backward may take (default: %(default)s)")
    parser.add_argument("--megabytes", type=float, default=4096.0, help="it may add (default: %(default)s)")
    options = parser.parse_args()
    if options.quick:
        options.counts, options.rounds = [8], 1
    print_header("mujoco", clock=options.clock)
    table = Table(COLUMNS)
    for count in options.counts:
        arrays, contacts = in_fresh_process(settle, count)
        cubes = len(arrays[0])
        found = {}
        for mode in MODES:
            seconds, megabytes = cost(mode, cubes, contacts)
            if seconds > options.seconds or megabytes > options.megabytes:
                print(f"# {mode} at {cubes} cubes left out: about {seconds:.0f} s and {megabytes:.0f} MB")
                continue
            rounds = 1 if seconds > 5.0 else options.rounds
            found[mode] = in_fresh_process(measure_mode, count, mode, arrays, rounds, options.clock)
        steps = in_fresh_process(measure_steps, count, arrays, options.rounds, options.clock)
        found["exact"].update(steps)
        for mode, row in found.items():
            row.update(cubes=cubes, contacts=contacts, mode=mode)
            if "dense" in found:
                row["dense_to_this"] = found["dense"]["backward_ms"] / row["backward_ms"]
            if mode == "qr":
                row["paper_dense_to_qr"] = PAPER_SPEEDUP.get(count)
            table.add(row)
    curves = {f"{mode} backward": table.curve("cubes", "backward_ms", mode=mode) for mode in MODES}
    curves["forward"] = table.curve("cubes", "forward_ms", mode="exact")
    curves["MuJoCo forward"] = table.curve("cubes", "mujoco_forward_ms", mode="exact")
    print_slopes(curves)
    save_plot(options.out / "fast_differentiation.png", partial(draw, table))
    return 0


if __name__ == "__main__":
    sys.exit(main())
