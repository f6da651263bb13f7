"""What happens at the limits: one line for each case and decade, judged by what was expected of it beforehand.

Of every case in `_limit_cases.py`, forward and backward: whether steps converged; the energy that contact made, as a
part of what was lost; the smallest distance of surfaces as a part of the thickness they should keep; the most Newton
iterations; the median time of a step and the longest one's ratio to it; and the median error of directional derivatives
of one step in contact, against central differences. A case is

- green if it does what was expected: no step longer than 100 times the median (and 20 ms);
- yellow if steps that did not converge said so, or a number is past what was expected, and nothing worse happened;
- red if a number is not finite, surfaces cross, ten times as much energy was made as expected, an error was raised that
  no documentation names, or a step took more than 100 times the median.

Prints one CSV line per case and writes limits.md into --out.
"""

from __future__ import annotations

import itertools
import math
import statistics
import sys
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _common import Table, make_parser, print_header
from _limit_cases import CASES, Case
from _report_page import cell, machine
from torch import Tensor

import diffsim as ds

COLUMNS = ("case", "name", "state", "what", "energy_made", "distance", "iterations", "step_ms", "longest", "error")
COLUMNS += ("failed_steps",)
LONGEST, LEAST = 100.0, 20.0  # a step may take that many medians, and that many milliseconds
FIELDS = ("position", "orientation", "velocity", "angular_velocity", "node_position", "node_velocity")
COLOURS = {"green": "🟢", "yellow": "🟡", "red": "🔴"}


def run(case: Case) -> dict[str, Any]:
    """The numbers of a case, and under "wrong" and "told" what should not have happened, in words."""
    row: dict[str, Any] = {"case": case.family, "name": case.value, "failed_steps": 0}
    row["wrong"], row["told"] = [], []
    try:
        sim = ds.Simulator(case.build(), case.dt, num_threads=1, **case.options)
        start = sim.initial_state()
    except ValueError as error:
        if case.refusal and case.refusal in str(error):
            return row
        row["wrong"].append(f"refused: {error}")
        return row
    try:
        states = _forward(case, sim, start, row)
        _backward(case, sim, start, row)
        _derivatives(case, sim, states, row)
    except (ValueError, ds.SolverError, ds.GradientError) as error:
        row["wrong"].append(f"{type(error).__name__}: {error}")
    return row


def _forward(case: Case, sim: ds.Simulator, start: ds.State, row: dict[str, Any]) -> list[tuple[int, ds.State]]:
    """The states from which steps with contact were taken, each with the number of its contacts; of long runs some."""
    state, in_contact, times, iterations = start, [], [], 0
    longest = 0.0, start
    with torch.no_grad():
        energies = [float(sim.kinetic_energy(start) + sim.potential_energy(start))]
        distance = math.inf
        for step in range(case.steps):
            began = time.process_time()
            end = sim(state)
            times.append(1e3 * (time.process_time() - began))
            longest = max(longest, (times[-1], state), key=lambda pair: pair[0])
            info = sim.info
            assert info is not None
            row["failed_steps"] += info.failed_steps
            iterations = max(iterations, info.iterations)
            looked_at = step % max(1, case.steps // 100) == 0
            if looked_at and info.contacts and info.converged:
                in_contact.append((info.contacts, state))
            state = end
            if case.stop is not None and bool((state.position[sim.mass > 0.0, 0] > case.stop).any()):
                row["wrong"].append(f"a body is behind the wall after step {step}")
                break
            if not all(bool(getattr(state, name).isfinite().all()) for name in FIELDS):
                row["wrong"].append(f"step {step} is not finite")
                break
            if looked_at:
                energies.append(float(sim.kinetic_energy(state) + sim.potential_energy(state)))
                distance = min(distance, float(sim.min_distance(state)))
    row["iterations"], row["step_ms"] = iterations, statistics.median(times)
    milliseconds, there = longest
    for _ in range(2):  # a step is a function of its state: what else took time the first time is not its own
        began = time.process_time()
        with torch.no_grad():
            sim(there)
        milliseconds = min(milliseconds, 1e3 * (time.process_time() - began))
    row["longest"] = max(milliseconds / row["step_ms"], 1.0)
    if row["longest"] > LONGEST and milliseconds > LEAST:
        row["wrong"].append(f"a step took {milliseconds:.0f} ms, {row['longest']:.0f} times the median")
    lowest = np.minimum.accumulate(energies)
    scale = max(energies[0] - float(lowest[-1]), 1e-9 * max(map(abs, energies)), 1e-300)
    row["energy_made"] = max(0.0, float((np.array(energies) - lowest).max())) / scale
    if row["energy_made"] > case.energy:
        much = "wrong" if row["energy_made"] > 10.0 * case.energy else "told"
        row[much].append(f"energy is made: {row['energy_made']:.2g} of what is lost")
    if math.isfinite(distance):
        # Collision surfaces are half a thickness outside of meshes: at -1 meshes would touch.
        row["distance"] = 1.0 + distance / sim.thickness
        if row["distance"] < 0.0:
            row["wrong"].append("surfaces cross")
            row["distance"] = 0.0
    if row["failed_steps"]:
        row["told"].append(f"{row['failed_steps']} of {case.steps} steps did not converge, and said so")
    if case.still is not None:
        moved = max(float((state.position - start.position).abs().max()), 0.0) if state.position.numel() else 0.0
        if moved > case.still:
            row["told"].append(f"moves by {moved:.2g} m")
    return in_contact


def _backward(case: Case, sim: ds.Simulator, start: ds.State, row: dict[str, Any]) -> None:
    """Of the whole, or its first 200 steps: finite, and not zero."""
    leaves = [getattr(start, name).clone().requires_grad_() for name in FIELDS]
    state = ds.State(**dict(zip(FIELDS, leaves)))
    end = sim.rollout(state, None, min(case.steps, 200))[-1]
    loss = torch.stack([getattr(end, name).sum() for name in FIELDS]).sum()
    gradients: Sequence[Tensor] = torch.autograd.grad(loss, [leaf for leaf in leaves if leaf.numel()])
    if not all(bool(g.isfinite().all()) for g in gradients):
        row["wrong"].append("a gradient is not finite")
    elif not any(bool(g.any()) for g in gradients):
        row["wrong"].append("the gradient is zero")


def _derivatives(case: Case, sim: ds.Simulator, states: list[tuple[int, ds.State]], row: dict[str, Any]) -> None:
    """At the end of the first and of the last third of the steps in contact; the better of two sizes of differences."""
    errors = []
    for where in (len(states) // 3, len(states) - 1):
        if where >= len(states) or where < 0:
            continue
        found = []
        for eps in (1e-2 * sim.thickness, 1e-4 * sim.thickness):
            try:
                report = ds.diagnostics.gradcheck(
                    sim, states[where][1], steps=1, wrt=("position", "velocity"), directions=3, eps=eps
                )
            except ValueError:  # a contact under load has less room than that
                continue
            if not math.isnan(report.median_error):
                found.append(report.median_error)
        errors += [min(found)] if found else []
    if errors:
        row["error"] = max(errors)
        if row["error"] > case.gradient:
            row["told"].append(f"derivatives differ from differences by {row['error']:.2g}")


def judge(case: Case, row: dict[str, Any]) -> None:
    """Adds the colour and what is to be said."""
    row["state"] = "red" if row["wrong"] else "yellow" if row["told"] else "green"
    words = [*row["wrong"], *row["told"]]
    if words and case.reason:
        words.append(case.reason)
    row["what"] = "; ".join(words).replace(",", "").replace("\n", " ") or "as expected"


def write_page(path: Path, cases: Sequence[Case], rows: Sequence[dict[str, Any]], note: str) -> None:
    counts = {colour: sum(row["state"] == colour for row in rows) for colour in COLOURS}
    lines = ["# Limits", ""]
    lines += [*itertools.chain.from_iterable((text, "") for text in machine(note, ("mesh-diffsim", "torch", "numpy")))]
    lines += [
        "What happens in extreme scenes, forward and backward: written by `benchmarks/limits.py`, which says what the"
        " columns mean. *Distance* is that of the nearest surfaces as a part of the thickness: 1 is what they should"
        " keep, at 0 they would touch. *Longest* is the longest step in medians. *Gradient* is the median error of"
        " directional derivatives of a step in contact, against central differences.",
        "",
        f"{counts['green']} green: as expected. {counts['yellow']} yellow: it said so, or a number is past what was"
        f" expected. {counts['red']} red.",
        "",
    ]
    for family, group in itertools.groupby(zip(cases, rows), lambda pair: pair[0].family):
        lines += [f"## {family[0].upper()}{family[1:]}", ""]
        lines += [
            "| | value | expected | energy made | distance | iterations | step [ms] | longest | gradient | found |"
        ]
        lines += ["|" + "---|" * 10]
        for case, row in group:
            numbers = [
                row.get(name) for name in ("energy_made", "distance", "iterations", "step_ms", "longest", "error")
            ]
            shown = [COLOURS[row["state"]], case.value, case.expect, *numbers, row["what"].replace("|", "/")]
            lines.append("| " + " | ".join(cell(value) for value in shown) + " |")
        lines.append("")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines), encoding="utf-8")
    print(f"# page: {path}")


def main() -> int:
    parser = make_parser(__doc__, plot=True)
    parser.set_defaults(clock=time.process_time)
    families = list(dict.fromkeys(case.family for case in CASES))
    parser.add_argument("--family", nargs="+", choices=families, default=families, help="which to run")
    options = parser.parse_args()
    cases = [case for case in CASES if case.family in options.family and (case.quick or not options.quick)]
    warnings.simplefilter("ignore")  # what they say is in the table
    torch.set_num_threads(1)
    print_header(clock=options.clock)
    table = Table(COLUMNS)
    for case in cases:
        row = run(case)
        judge(case, row)
        table.add(row)
    note = "**A quick run**, of a few cases." if options.quick else ""
    write_page(options.out / "limits.md", cases, table.rows, note)
    return 0


if __name__ == "__main__":
    sys.exit(main())
