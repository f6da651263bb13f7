"""Error against run time: motions, gradients, and the useful gradient, beside MuJoCo in the same run.

Each scene is run by all its methods with all its steps; errors are from a closed form where there is one, else from the
limit dt -> 0. Times are those of the steps alone, on the processor, one thread, medians. Writes a page in Markdown and
in HTML, its plots and its CSV into --out; prints the CSV. With --scene only those are run, and the page keeps of the
others what the CSV there says of them.

To add a scene, a method or a peer, add one entry to a table: `FREE`, `IMPACTS`, `FRICTION` and `CLOTH` of motions,
`CONTACT_GRADIENTS` and `FRICTION_GRADIENTS` of gradients, each at the end of the file of its name.
"""

from __future__ import annotations

import csv
import datetime
import itertools
import os
import sys
import time
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco
import torch
from _common import Table, make_parser, print_header
from _report_cloth import CLOTH
from _report_free import FREE
from _report_friction import FRICTION
from _report_friction_gradients import FRICTION_GRADIENTS
from _report_gradients import (
    CONTACT_GRADIENTS,
    DIFFERENCES,
    SHARP,
    WIDE,
    GradientScene,
    Inputs,
    continuous,
    mujoco_differences,
    relative,
)
from _report_impacts import IMPACTS
from _report_motion import Unstable, ValueScene, timed
from _report_page import Panel, Section, machine, verdict, write
from _report_peers import GRADIENTS as PEER_GRADIENTS
from _report_peers import TIMES as PEER_TIMES

SCENES = (*FREE, *IMPACTS, *FRICTION, *CLOTH)
GRADIENTS = (*CONTACT_GRADIENTS, *FRICTION_GRADIENTS)
COLUMNS = ("scene", "what", "name", "run", "failure", "dt_s", "time_ms", "error")
TIME = "time on the processor [ms]"
PACKAGES = ("mesh-diffsim", "torch", "numpy", "scipy", "mujoco")


class Report(Table):
    """The rows, each with what its run was; of those that have no end, why."""

    def __init__(self, run: str) -> None:
        super().__init__(COLUMNS)
        self._run = run

    def add(self, row: dict[str, Any]) -> None:
        super().add({"run": self._run, "failure": "", "time_ms": None, "error": None, **row})

    def of(self, scene: str, labels: Iterable[str]) -> list[dict[str, Any]]:
        return [row for row in self.rows if row["scene"] == scene and row["what"] in labels]

    def keep(self, path: Path, but: Iterable[str]) -> None:
        """Rows of scenes that another run wrote."""
        if path.is_file():
            with path.open(encoding="utf-8", newline="") as file:
                self.rows += [_read(row) for row in csv.DictReader(file) if row["scene"] not in but]

    def write(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, self.columns)
            writer.writeheader()
            writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in r.items()} for r in self.rows)


def _read(row: dict[str, str]) -> dict[str, Any]:
    return {k: v if k not in ("dt_s", "time_ms", "error") else float(v) if v else None for k, v in row.items()}


def curves(rows: list[dict[str, Any]], x: str, what: str) -> dict[str, tuple[list[float], list[float]]]:
    """By name, in the order of the rows."""
    found: dict[str, tuple[list[float], list[float]]] = {}
    for row in rows:
        if row["what"] == what and row["error"] is not None:
            points = found.setdefault(row["name"], ([], []))
            points[0].append(row[x])
            points[1].append(row["error"])
    return found


def run_of(rows: list[dict[str, Any]]) -> str:
    """When, and with which steps."""
    steps = ", ".join(f"{dt:g}" for dt in sorted({row["dt_s"] for row in rows}, reverse=True))
    return f"Run {' and '.join(dict.fromkeys(row['run'] for row in rows))}; dt = {steps} s."


def measure_values(case: ValueScene, report: Report, steps: tuple[float, ...], duration: float, quick: bool) -> None:
    limits: dict[str, Any] = {}
    limit_dt = 0.5 * steps[-1] if quick and case.limit_dt else case.limit_dt
    for method, dt in itertools.product(case.methods, steps):
        run = method.prepare(case.build(), dt, duration)
        row = {"scene": case.name, "name": method.name, "dt_s": dt}
        try:
            motion = run.motion()
            limit = None
            if limit_dt is not None:
                which = method if method.own_limit else case.limit or case.methods[0]
                if which.name not in limits:
                    limits[which.name] = which.prepare(case.build(), limit_dt, duration).motion()
                limit = limits[which.name]
            errors = {label: error(motion, limit) for label, error in case.errors.items()}
        except Unstable as reason:
            report.add({**row, "what": next(iter(case.errors)), "failure": str(reason).replace(",", ";")})
            continue
        _, milliseconds = timed(run.timed, quick)
        for label, error in errors.items():
            report.add({**row, "what": label, "time_ms": milliseconds, "error": error})


def section_of_values(case: ValueScene, report: Report) -> Section | None:
    rows = report.of(case.name, case.errors)
    if not rows:
        return None
    ours = frozenset(method.name for method in case.methods if method.ours)
    panels = [Panel(TIME, label, curves(rows, "time_ms", label), ours) for label in case.errors]
    failed: dict[tuple[str, str], list[str]] = {}
    for row in rows:
        if row["failure"]:
            failed.setdefault((row["name"], row["failure"]), []).append(f"{row['dt_s']:g}")
    text = [f"Errors from: {case.reference}. {run_of(rows)}", *map(verdict, panels)]
    text += [case.note] if case.note else []
    text += [f"No end at dt = {', '.join(steps)} s: {name} ({why})." for (name, why), steps in failed.items()]
    return Section(f"value_{case.name}", case.title, text, panels)


DISCRETE, CONTINUOUS = (
    "relative error from the gradient of the same steps",
    "relative error from the continuous gradient",
)


def measure_gradients(case: GradientScene, report: Report, steps: tuple[float, ...], quick: bool) -> None:
    right, sizes = continuous(case), Inputs(case, case.steps[0]).sizes

    def add(name: str, dt: float, gradient: Any, milliseconds: float, discrete: Any = None) -> None:
        row = {"scene": case.name, "name": name, "dt_s": dt, "time_ms": milliseconds}
        if discrete is not None:
            report.add({**row, "what": DISCRETE, "error": relative(gradient, discrete, sizes)})
        report.add({**row, "what": CONTINUOUS, "error": relative(gradient, right, sizes)})

    for dt in steps:
        discrete: dict[str, Any] = {}  # by integrator
        for name, options in case.ours:
            integrator = options.get("integrator", "implicit_euler")
            if integrator not in discrete:
                discrete[integrator] = Inputs(case, dt, tolerance=SHARP, integrator=integrator).discrete()
            add(f"diffsim {name}", dt, *timed(Inputs(case, dt, **options).adjoint, quick), discrete[integrator])
        add("diffsim differences", dt, *timed(Inputs(case, dt).differences, quick), discrete["implicit_euler"])
        for settings, eps in itertools.product(case.mujoco, (DIFFERENCES, WIDE)):
            differences = mujoco_differences(case, dt, settings, eps)
            add(f"{settings.name} differences of {eps:g}", dt, *timed(differences, quick))


def section_of_gradients(case: GradientScene, report: Report) -> Section | None:
    rows = report.of(case.name, (DISCRETE, CONTINUOUS))
    if not rows:
        return None
    ours = frozenset(row["name"] for row in rows if row["name"].startswith("diffsim"))
    useful = Panel(TIME, CONTINUOUS, curves(rows, "time_ms", CONTINUOUS), ours)
    over_steps = Panel("dt [s]", CONTINUOUS, curves(rows, "dt_s", CONTINUOUS), ours)
    panels = [Panel(TIME, DISCRETE, curves(rows, "time_ms", DISCRETE), ours), useful, over_steps]
    x, y = over_steps.curves["diffsim exact"]
    falls = " to ".join(f"{value:.2g}" for value in (y[0], y[-1]))
    inputs = ", ".join(dict.fromkeys(name for name, _ in case.inputs))
    text = [
        f"A loss on the last state, by {inputs}: {len(case.inputs)} numbers. Continuous gradient: {case.reference}."
        f" {run_of(rows)}",
        f"As dt falls from {x[0]:g} to {x[-1]:g} s, the exact adjoint's error from it goes from {falls}.",
        verdict(useful),
        *([case.note] if case.note else []),
    ]
    return Section(f"gradient_{case.name}", case.title, text, panels)


INTRODUCTION = (
    "A reader looks at the plots: left is faster, below is more exact. In each, the same scene is run with ever smaller"
    " steps. MuJoCo runs with the scene's friction, without where there is none, and with its default contacts and"
    " pyramidal cones, unless a name says otherwise. Ours keeps surfaces apart by the scene's thickness, which closed"
    " forms take into account; errors of exactly 0 are drawn at the bottom.",
    "*Smooth motion*: our default steps are implicit Euler, of first order; `second_order` is of second order there,"
    " keeps what free motion keeps, and pays for contact with a second solve, for cloth with a stage. MuJoCo's RK4 is"
    " of fourth order.",
    "*Why implicit Euler is the default*: where things meet, the errors of `second_order` are the same (push, oblique"
    " impact), in heaps a step takes up to 4 times as long and makes up to 3e-4 of the energy that is lost where"
    " implicit Euler makes none (pile). Where things fly, slide and roll, and where cloth swings, `second_order` is"
    " more exact by orders in the same time: use it there.",
    "*Friction*: a stack that leans, a box that has stopped and a ball that rolls should not creep or slip at all."
    " MuJoCo's friction gives way with a speed that impratio divides; ours is exact, and slips by rounding.",
)
REDUCED = "**A reduced run**: some steps of each sweep, which each scene names, and scenes of 10 s at most."
GRADIENT_INTRODUCTION = (
    "`exact` keeps the curvature of contacts, `qr` and `dense` leave it out as the paper does and have no friction;"
    " `second_order` is `exact` with the other integrator. Differences are central; MuJoCo's are taken with two"
    " widths, of which the larger averages over what jumps from step to step. A gradient can be that of the steps"
    " that were run, and still not be useful: an impact falls into some step, and where in the step it falls changes"
    " with the inputs. The third plot of a scene shows whether that fades as dt falls; where it does not, a gradient"
    " averaged over many starts is right and a single one is not."
)


def main() -> int:
    parser = make_parser(__doc__, plot=True)
    parser.set_defaults(clock=time.process_time, out=Path("out/report"))
    names = [case.name for case in (*SCENES, *GRADIENTS)]
    parser.add_argument("--scene", nargs="*", choices=names, default=names, help="which to run; none: draw")
    parser.add_argument("--reduced", action="store_true", help="for busy machines: three steps of a sweep, short stack")
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # steps that fail are named on the page
    torch.set_num_threads(1)
    mujoco.set_mju_user_warning(lambda message: None)  # a run that blows up is named on the page, too
    print_header("scipy", "mujoco", clock=options.clock)
    load = f"{os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else "unknown"
    report = Report(f"{datetime.date.today().isoformat()} at load {load}")
    file = options.out / "work_precision.csv"
    report.keep(file, options.scene)
    for case in SCENES:
        if case.name not in options.scene or (options.quick and not case.quick):
            continue
        steps = tuple(case.steps[1:2] if options.quick else case.steps[:3] if options.reduced else case.steps)
        duration = case.duration
        if options.quick or options.reduced:
            duration = min(duration, 0.2 if options.quick else 10.0)
        measure_values(case, report, steps, duration, options.quick)
        report.write(file)
    for scene in GRADIENTS:
        if scene.name not in options.scene or (options.quick and not scene.quick):
            continue
        steps = tuple(scene.steps[:1] if options.quick else scene.steps[:3] if options.reduced else scene.steps)
        measure_gradients(scene, report, steps, options.quick)
        report.write(file)
    note = REDUCED if options.reduced else ""
    if options.quick:
        note = "**A smoke run**: its numbers mean nothing."
    sections = [
        Section("report", "About", [*machine(note, PACKAGES), *INTRODUCTION]),
        *(section_of_values(case, report) for case in SCENES),
        Section("gradients", "Gradients", [GRADIENT_INTRODUCTION]),
        *(section_of_gradients(scene, report) for scene in GRADIENTS),
        Section("peers", "Peers measured separately", [PEERS_TEXT], tables=[PEER_TIMES, PEER_GRADIENTS]),
    ]
    write(options.out, "Error against run time", [section for section in sections if section is not None])
    return 0


PEERS_TEXT = (
    "Too slow to run with the report. Measured separately, on the same kind of machine: not to be set beside times of"
    " this run digit by digit."
)


if __name__ == "__main__":
    sys.exit(main())
