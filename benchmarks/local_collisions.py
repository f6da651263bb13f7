"""Collisions solved where they are: Table 1 of Qiao et al. 2020.

N cubes of edge 0.1 m in a row, 0.08 m apart, their bases up to 0.4 m above the ground; steps of 0.04 s, one thread.
Two of its steps: the first (as in the paper, where 4 % of the cubes touch the ground), and one with all cubes at rest
on it. Backward of one step with zones of what touches (`local`) and with all cubes forced into one zone (`global`),
for each way to solve a zone: `dense` is what the paper measures local zones with, LU of a zone's KKT matrix; `qr` its
fast differentiation; `exact` ours, whose sparse factorization finds by itself that a global zone falls apart.

One CSV line per N, step and mode: medians over rounds, memory a backward adds at most, and how much faster local
zones are. Beside it the figures the paper prints (LCP is that of de Avila Belbute-Peres et al. 2018), and what its
own code takes on such a machine for a step with all cubes on the ground, measured apart. This machine is about 7
times faster on the LCP baseline than the paper's: no ratio is taken between what it printed and what is measured
here. Then a plot. Needs the extra `bench`.
"""

from __future__ import annotations

import statistics
import sys
from functools import partial
from typing import Any

import torch
from _common import (
    Clock,
    Recorded,
    Table,
    added_memory,
    advance,
    in_fresh_process,
    in_turns,
    make_parser,
    print_header,
    save_plot,
)

import diffsim as ds
from diffsim import scenes

COUNTS = (100, 200, 300)
MODES, ZONES = ("exact", "qr", "dense"), ("local", "global")
DT, SETTLE = 0.04, 50  # [s]; steps until all cubes are at rest
STEPS = {"resting": SETTLE, "first": 0}  # name -> how many steps before it

# Backward of a step [s]: Table 1 as printed, and the paper's own code (2020, on torch 2.15) measured apart.
PUBLISHED = {100: (0.73, 0.56), 200: (2.87, 1.11), 300: (8.42, 1.65)}
PAPER_CODE = {100: 0.019, 200: 0.044, 300: 0.071}

COLUMNS = ("cubes", "step", "contacts", "mode", "local_ms", "global_ms", "global_to_local")
COLUMNS += ("local_memory_mb", "global_memory_mb", "lcp_published_ms", "paper_published_ms", "paper_code_ms")


def measure(count: int, mode: str, zones: str, rounds: int, clock: Clock) -> dict[str, dict[str, Any]]:
    """In a fresh process: the backward of each of STEPS."""
    torch.set_num_threads(1)
    scene = scenes.row_of_cubes(count)
    sim = ds.Simulator(scene, dt=DT, adjoint=mode, zones=zones, num_threads=1, on_failure="raise")
    start = sim.initial_state()
    found: dict[str, dict[str, Any]] = {}
    for step, before in STEPS.items():
        recorded = Recorded(sim, advance(sim, start, before)[-1] if before else start, 1)
        assert sim.info is not None
        found[step] = {"contacts": sim.info.contacts}
        if step == "resting":  # before all else: memory that was used before does not count
            found[step]["memory_mb"] = added_memory(recorded.backward)
        seconds = in_turns({"backward": recorded.backward}, 1, clock)["backward"]
        if seconds[0] < 2.0:
            seconds = in_turns({"backward": recorded.backward}, rounds, clock)["backward"]
        found[step]["ms"] = 1e3 * statistics.median(seconds)
    return found


def row_of(count: int, step: str, mode: str, found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """From what was measured of this step by the two kinds of zones."""
    row: dict[str, Any] = {"cubes": count, "step": step, "mode": mode, "contacts": found["local"]["contacts"]}
    for zones in ZONES:
        row[f"{zones}_ms"] = found[zones]["ms"]
        row[f"{zones}_memory_mb"] = found[zones].get("memory_mb")
    row["global_to_local"] = row["global_ms"] / row["local_ms"]
    if count in PUBLISHED:
        row["lcp_published_ms"], row["paper_published_ms"] = (1e3 * seconds for seconds in PUBLISHED[count])
        row["paper_code_ms"] = 1e3 * PAPER_CODE[count] if step == "resting" else None
    return row


def draw(rows: list[dict[str, Any]], figure: Any) -> None:
    for axes, step in zip(figure.subplots(1, 2, sharey=True), STEPS):
        for color, mode in enumerate(MODES):
            of_mode = [row for row in rows if (row["step"], row["mode"]) == (step, mode)]
            counts = [row["cubes"] for row in of_mode]
            for zones, line in zip(ZONES, ("-", ":")):
                values = [row[f"{zones}_ms"] for row in of_mode]
                axes.plot(counts, values, line, color=f"C{color}", marker="o", ms=4.0, label=f"{mode}, {zones}")
        if step == "resting":
            known = [count for count in counts if count in PAPER_CODE]
            axes.plot(known, [1e3 * PAPER_CODE[n] for n in known], "--", color="0.4", label="paper's code (apart)")
        axes.set(yscale="log", xlabel="cubes", title=f"{step} step")
        axes.grid(True, alpha=0.3)
        axes.legend(fontsize=8)
    figure.axes[0].set_ylabel("backward of a step [ms]")


def main() -> int:
    parser = make_parser(__doc__, rounds=15, plot=True)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="numbers of cubes")
    options = parser.parse_args()
    if options.quick:
        options.counts, options.rounds = [6], 1
    print_header(clock=options.clock)
    table = Table(COLUMNS)
    for count in options.counts:
        for mode in MODES:
            found = {
                zones: in_fresh_process(measure, count, mode, zones, options.rounds, options.clock) for zones in ZONES
            }
            for step in STEPS:
                table.add(row_of(count, step, mode, {zones: found[zones][step] for zones in ZONES}))
    save_plot(options.out / "local_collisions.png", partial(draw, table.rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
