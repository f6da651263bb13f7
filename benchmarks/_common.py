"""What benchmarks share: the header that names machine and versions, timing in turns, memory, plots."""

from __future__ import annotations

import argparse
import math
import multiprocessing
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

import diffsim as ds
from diffsim import _core
from diffsim.ops import RolloutCall, rollout

Result = TypeVar("Result")
Clock = Callable[[], float]  # seconds


def make_parser(
    description: str | None, *, rounds: int | None = None, plot: bool = False, cpu_time: bool = True
) -> argparse.ArgumentParser:
    """With what benchmarks understand: `rounds` is how many are timed by default.

    Args:
        description: The script's docstring.
        rounds: Default of --rounds; None: the script has no rounds.
        plot: Whether it draws one, into --out.
        cpu_time: Whether its times may be those on the processor: not where several threads work.
    """
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a smoke run of a few seconds; its numbers mean nothing")
    parser.set_defaults(clock=time.perf_counter)
    if cpu_time:
        parser.add_argument(
            "--cpu-time",
            dest="clock",
            action="store_const",
            const=time.process_time,
            help="time on the processor instead of wall time: for machines that others use, too",
        )
    if rounds is not None:
        parser.add_argument(
            "--rounds", type=int, default=rounds, help="of which the medians are printed (default: %(default)s)"
        )
    if plot:
        parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the plot (default: %(default)s)")
    return parser


# ---- output ----------------------------------------------------------------------------------------------------------


def processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def installed_version(distribution: str) -> str:
    try:
        return version(distribution)
    except PackageNotFoundError:
        return "not installed"


def print_header(*distributions: str, clock: Clock) -> None:
    """Comment lines: machine, versions of Python, of diffsim and of what else is named, and what times are."""
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    print(f"# {processor()}, {os.cpu_count()} cores{load}, {platform.system()} {platform.release()}")
    versions = [f"Python {platform.python_version()}"]
    versions += [f"{name} {installed_version(name)}" for name in ("mesh-diffsim", "torch", "numpy", *distributions)]
    print("#", ", ".join(versions))
    print("# times:", "on the processor" if clock is time.process_time else "wall")


def print_row(values: Iterable[object]) -> None:
    """One CSV line. None is an empty field: a peer has no figure there."""
    texts = (f"{value:.4g}" if isinstance(value, float) else value for value in values)
    print(*("" if text is None else text for text in texts), sep=",", flush=True)


class Table:
    """CSV with named columns: prints its heading at once and every row as it comes, and keeps the rows."""

    def __init__(self, columns: Sequence[str]) -> None:
        self.columns = columns
        self.rows: list[dict[str, Any]] = []
        print_row(columns)

    def add(self, row: dict[str, Any]) -> None:
        """What a row lacks is an empty field."""
        self.rows.append(row)
        print_row(row.get(name) for name in self.columns)

    def curve(self, x: str, y: str, **those: object) -> tuple[list[float], list[float]]:
        """Two columns, of the rows that have `those` values."""
        rows = [row for row in self.rows if all(row[name] == value for name, value in those.items())]
        return [row[x] for row in rows], [row[y] for row in rows]


def print_slopes(curves: Mapping[str, tuple[list[float], list[float]]]) -> None:
    """A comment line with the log-log slope of each that has one."""
    slopes = [f"{name} {slope(x, y):.3f}" for name, (x, y) in curves.items() if len(x) > 1]
    if slopes:
        print("# log-log slopes:", ", ".join(slopes))


def save_plot(path: Path, draw: Callable[[Any], None], size: tuple[float, float] = (9.6, 4.6)) -> None:
    """Make a figure, let `draw(figure)` fill it, write it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=size, layout="constrained")
    draw(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=90)
    plt.close(figure)
    print(f"# plot: {path}")


def draw_curves(
    axes: Any, curves: Mapping[str, tuple[Sequence[float], Sequence[float | None]]], xlabel: str, ylabel: str
) -> None:
    """Log-log; None is a point left out. Names with brackets are drawn broken: figures not measured in this run. A name
    has the same colour in all panels of a figure.
    """
    named: dict[str, str] = {}
    for other in axes.figure.axes:
        named |= {line.get_label(): line.get_color() for line in other.get_lines()}
    for name, (x, y) in curves.items():
        points = [(a, b) for a, b in zip(x, y) if b is not None]
        if points:
            color = named.setdefault(name, f"C{len(named)}")
            style = (0, (4, 3)) if "(" in name else "-"
            axes.plot(*zip(*points), marker="o", ms=4.0, lw=1.4, ls=style, color=color, label=name)
    axes.set(xscale="log", yscale="log", xlabel=xlabel, ylabel=ylabel)
    axes.grid(True, which="major", alpha=0.3)
    axes.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.01), borderaxespad=0.0, frameon=False)


# ---- time and memory -------------------------------------------------------------------------------------------------


def in_turns(
    cases: Mapping[str, Callable[[], object]], rounds: int, clock: Clock = time.perf_counter
) -> dict[str, list[float]]:
    """Seconds each case took, round after round: what slows the machine down for a while hits all of them."""
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, call in cases.items():
            start = clock()
            call()
            seconds[name].append(clock() - start)
    return seconds


def repeated(call: Callable[[], object], repeats: int) -> None:
    for _ in range(repeats):
        call()


def median_ratio(numerator: list[float], denominator: list[float]) -> float:
    """Median of the ratios within each round."""
    return statistics.median(a / b for a, b in zip(numerator, denominator))


def slope(x: list[float], y: list[float]) -> float:
    """Exponent p of the least-squares fit y ~ x^p."""
    return statistics.linear_regression(*([math.log(v) for v in values] for values in (x, y))).slope


def fresh_processes() -> Any:
    """How to start processes whose memory nothing has used before.

    Where the system can, they are forked from one that has imported torch, which takes seconds, and nothing else.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch"])  # not diffsim: of two, the one in the working folder would be found
    return context


def in_fresh_process(function: Callable[..., Result], *arguments: object) -> Result:
    """The result of a call in a process of its own."""
    with ProcessPoolExecutor(1, fresh_processes()) as pool:
        return pool.submit(function, *arguments).result()


def added_memory(call: Callable[[], object]) -> float:
    """How far the peak of resident memory during a call is above what was resident before [MB]; nan but on Linux.

    Memory that was used and given back earlier in the process is not seen again: measure first, in a fresh process.
    """
    if not sys.platform.startswith("linux"):
        call()
        return float("nan")
    Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
    before = _status_megabytes("VmRSS")
    call()
    return _status_megabytes("VmHWM") - before


def _status_megabytes(field: str) -> float:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{field}:"):
            return float(line.split()[1]) / 1024.0
    raise RuntimeError(f"/proc/self/status has no {field}")


# ---- what is timed ---------------------------------------------------------------------------------------------------

STATE_FIELDS = ("position", "orientation", "velocity", "angular_velocity", "node_position", "node_velocity")


def advance(sim: ds.Simulator, start: ds.State, steps: int) -> ds.State:
    """Forward alone: no gradients recorded."""
    with torch.no_grad():
        return sim.rollout(start, None, steps)


class Recorded:
    """A rollout with gradients recorded, and a loss on its last state."""

    def __init__(self, sim: ds.Simulator, start: ds.State, steps: int) -> None:
        fields = {name: getattr(start, name).detach() for name in STATE_FIELDS}
        self.inputs = [t.requires_grad_() for t in fields.values() if t.numel()]
        self.inputs.append(sim.mass.requires_grad_())
        final = sim.rollout(ds.State(**fields), None, steps)[-1]
        self.loss = sum((getattr(final, name).square().sum() for name in STATE_FIELDS), torch.zeros(()))

    def backward(self) -> tuple[Tensor, ...]:
        """The gradient with respect to the initial state and the masses; as often as wanted."""
        return torch.autograd.grad(self.loss, self.inputs, retain_graph=True)


def tape_bytes(sim: ds.Simulator, start: ds.State, steps: int) -> int:
    """What a rollout keeps for its backward; not public, so asked of the operator."""
    call = RolloutCall(sim._model, sim._options, steps, 1, keep_time=True)
    inputs = sim._checked_inputs("tape_bytes", start.detach(), None, None).inputs
    with torch.enable_grad():
        next(t for t in inputs if t is not None).requires_grad_()
        rollout(call, *inputs)
    assert isinstance(call.tape, _core.Tape)
    return call.tape.nbytes


def differentiate(sim: ds.Simulator, start: ds.State, steps: int) -> tuple[Tensor, ...]:
    """Forward and backward."""
    return Recorded(sim, start, steps).backward()
