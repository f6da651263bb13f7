"""Error against run time: motions, gradients, and the useful gradient, beside MuJoCo in the same run.

Each scene is run by all its methods with all its steps; errors are from a closed form where there is one, else from the
limit dt -> 0. Times are those of the steps alone, on the
processor, one thread, medians. Writes a page in Markdown and in HTML, its plots and its CSV into --out; prints the CSV.

To add a scene, a method or a peer, add one entry to a table: `FREE`, `IMPACTS`, `FRICTION` and `CLOTH` of motions,
`CONTACT_GRADIENTS` and `FRICTION_GRADIENTS` of gradients, each at the end of the file of its name.
"""

from __future__ import annotations

import csv
import itertools
import sys
import time
import warnings
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
COLUMNS = ("scene", "what", "name", "dt_s", "time_ms", "error")
TIME = "time on the processor [ms]"
PACKAGES = ("mesh-diffsim", "torch", "numpy", "scipy", "mujoco")


def measure_values(case: ValueScene, table: Table, steps: tuple[float, ...], duration: float, quick: bool) -> list[str]:
    """Adds the rows of a scene, and returns what could not be run, in words."""
    limits: dict[str, Any] = {}
    limit_dt = 0.5 * steps[-1] if quick and case.limit_dt else case.limit_dt
    failed: dict[str, list[str]] = {}
    for method in case.methods:
        for dt in steps:
            run = method.prepare(case.build(), dt, duration)
            try:
                motion = run.motion()
                limit = None
                if limit_dt is not None:
                    which = method if method.own_limit else case.methods[0]
                    if which.name not in limits:
                        limits[which.name] = which.prepare(case.build(), limit_dt, duration).motion()
                    limit = limits[which.name]
                errors = {label: error(motion, limit) for label, error in case.errors.items()}
            except Unstable as reason:
                failed.setdefault(f"{method.name} ({reason})", []).append(f"{dt:g}")
                continue
            _, milliseconds = timed(run.timed, quick)
            for label, error in errors.items():
                row = {"scene": case.name, "what": label, "name": method.name, "dt_s": dt, "time_ms": milliseconds}
                table.add({**row, "error": error})
    return [f"No end at dt = {', '.join(steps)} s: {name}." for name, steps in failed.items()]


def section_of_values(case: ValueScene, table: Table, failed: list[str], steps: tuple[float, ...]) -> Section:
    ours = frozenset(method.name for method in case.methods if method.ours)
    panels = []
    for label in case.errors:
        names = [method.name for method in case.methods]
        curves = {n: table.curve("time_ms", "error", scene=case.name, what=label, name=n) for n in names}
        panels.append(Panel(TIME, label, curves, ours))
    text = [f"Errors from: {case.reference}. dt = {', '.join(f'{dt:g}' for dt in steps)} s, large to small."]
    return Section(f"value_{case.name}", case.title, [*text, *map(verdict, panels), *failed], panels)


DISCRETE, CONTINUOUS = (
    "relative error from the gradient of the same steps",
    "relative error from the continuous gradient",
)


def measure_gradients(case: GradientScene, table: Table, steps: tuple[float, ...], quick: bool) -> None:
    right = continuous(case)

    def add(name: str, dt: float, gradient: Any, milliseconds: float, discrete: Any = None) -> None:
        row = {"scene": case.name, "name": name, "dt_s": dt, "time_ms": milliseconds}
        if discrete is not None:
            table.add({**row, "what": DISCRETE, "error": relative(gradient, discrete)})
        table.add({**row, "what": CONTINUOUS, "error": relative(gradient, right)})

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


def section_of_gradients(case: GradientScene, table: Table, steps: tuple[float, ...]) -> Section:
    names = list(dict.fromkeys(row["name"] for row in table.rows if row["scene"] == case.name))
    ours = frozenset(name for name in names if name.startswith("diffsim"))

    def curves(x: str, what: str) -> dict[str, tuple[list[float], list[float]]]:
        return {name: table.curve(x, "error", scene=case.name, what=what, name=name) for name in names}

    useful = Panel(TIME, CONTINUOUS, curves("time_ms", CONTINUOUS), ours)
    panels = [
        Panel(TIME, DISCRETE, curves("time_ms", DISCRETE), ours),
        useful,
        Panel("dt [s]", CONTINUOUS, curves("dt_s", CONTINUOUS), ours),
    ]
    x, y = table.curve("dt_s", "error", scene=case.name, what=CONTINUOUS, name="diffsim exact")
    falls = " to ".join(f"{value:.2g}" for value in (y[0], y[-1]))
    inputs = ", ".join(dict.fromkeys(name for name, _ in case.inputs))
    text = [
        f"A loss on the last state, by {inputs}: {len(case.inputs)} numbers. Continuous gradient: {case.reference}.",
        f"As dt falls from {x[0]:g} to {x[-1]:g} s, the exact adjoint's error from it goes from {falls}.",
        verdict(useful),
    ]
    return Section(f"gradient_{case.name}", case.title, text, panels)


INTRODUCTION = (
    "A reader looks at the plots: left is faster, below is more exact. In each, the same scene is run with ever smaller"
    " steps. MuJoCo runs with the scene's friction, without where there is none, and with its default contacts and"
    " pyramidal cones, unless a name says otherwise. Ours keeps surfaces apart by the scene's thickness, which closed"
    " forms take into account; errors of exactly 0 are drawn at the bottom.",
    "*Smooth motion*: our default steps are implicit Euler, of first order; `trapezoidal` is of second order there,"
    " keeps what free motion keeps, and pays for contact with a second solve. MuJoCo's RK4 is of fourth order.",
    "*Friction*: a stack that leans, a box that has stopped and a ball that rolls should not creep or slip at all."
    " MuJoCo's friction gives way with a speed that impratio divides; ours is exact, and slips by rounding.",
)
GRADIENT_INTRODUCTION = (
    "`exact` keeps the curvature of contacts, `qr` and `dense` leave it out as the paper does and have no friction;"
    " `trapezoidal` is `exact` with the other integrator. Differences are central; MuJoCo's are taken with two"
    " widths, of which the larger averages over what jumps from step to step. A gradient can be that of the steps"
    " that were run, and still not be useful: an impact falls into some step, and where in the step it falls changes"
    " with the inputs. The third plot of a scene shows whether that fades as dt falls; where it does not, a gradient"
    " averaged over many starts is right and a single one is not."
)


def main() -> int:
    parser = make_parser(__doc__, plot=True)
    parser.set_defaults(clock=time.process_time, out=Path("out/report"))
    names = [case.name for case in (*SCENES, *GRADIENTS)]
    parser.add_argument("--scene", nargs="+", choices=names, default=names, help="which to run")
    parser.add_argument("--reduced", action="store_true", help="for busy machines: three steps of a sweep, short stack")
    options = parser.parse_args()
    warnings.simplefilter("ignore")  # steps that fail are named on the page
    torch.set_num_threads(1)
    mujoco.set_mju_user_warning(lambda message: None)  # a run that blows up is named on the page, too
    print_header("scipy", "mujoco", clock=options.clock)
    table = Table(COLUMNS)
    values, gradients = [], []
    for case in SCENES:
        if case.name not in options.scene or (options.quick and not case.quick):
            continue
        steps = tuple(case.steps[1:2] if options.quick else case.steps[:3] if options.reduced else case.steps)
        duration = case.duration
        if options.quick or options.reduced:
            duration = min(duration, 0.2 if options.quick else 10.0)
        failed = measure_values(case, table, steps, duration, options.quick)
        values.append(section_of_values(case, table, failed, steps))
    for scene in GRADIENTS:
        if scene.name not in options.scene or (options.quick and not scene.quick):
            continue
        steps = tuple(scene.steps[:1] if options.quick else scene.steps[:3] if options.reduced else scene.steps)
        measure_gradients(scene, table, steps, options.quick)
        gradients.append(section_of_gradients(scene, table, steps))
    note = "**A reduced run**: three steps of each sweep, scenes of 10 s at most." if options.reduced else ""
    if options.quick:
        note = "**A smoke run**: its numbers mean nothing."
    sections = [
        Section("report", "About", [*machine(note, PACKAGES), *INTRODUCTION]),
        *values,
        Section("gradients", "Gradients", [GRADIENT_INTRODUCTION]),
        *gradients,
        Section("peers", "Peers measured separately", [PEERS_TEXT], tables=[PEER_TIMES, PEER_GRADIENTS]),
    ]
    write(options.out, "Error against run time", sections)
    write_csv(options.out / "work_precision.csv", table)
    return 0


PEERS_TEXT = (
    "Too slow to run with the report. Measured separately, on the same kind of machine: not to be set beside times of"
    " this run digit by digit."
)


def write_csv(path: Path, table: Table) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, table.columns)
        writer.writeheader()
        writer.writerows({k: f"{v:.4g}" if isinstance(v, float) else v for k, v in row.items()} for row in table.rows)


if __name__ == "__main__":
    sys.exit(main())
