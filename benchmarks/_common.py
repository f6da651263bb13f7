"""What benchmarks share: the header that names machine and versions, timing in turns, memory."""

from __future__ import annotations

import math
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path


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


def print_header(*distributions: str) -> None:
    """Comment lines: machine, and versions of Python, of diffsim and of what else is named."""
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    print(f"# {processor()}, {os.cpu_count()} cores{load}, {platform.system()} {platform.release()}")
    versions = [f"Python {platform.python_version()}"]
    versions += [f"{name} {installed_version(name)}" for name in ("mesh-diffsim", "torch", "numpy", *distributions)]
    print("#", ", ".join(versions))


def print_row(values: Iterable[object]) -> None:
    print(*(f"{value:.4g}" if isinstance(value, float) else value for value in values), sep=",", flush=True)


def in_turns(
    cases: Mapping[str, Callable[[], object]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, list[float]]:
    """Seconds each case took, round after round: what slows the machine down for a while hits all of them."""
    seconds: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds):
        for name, call in cases.items():
            start = clock()
            call()
            seconds[name].append(clock() - start)
    return seconds


def median_ratio(numerator: list[float], denominator: list[float]) -> float:
    """Median of the ratios within each round."""
    return statistics.median(a / b for a, b in zip(numerator, denominator))


def slope(x: list[float], y: list[float]) -> float:
    """Exponent p of the least-squares fit y ~ x^p."""
    if len(x) < 2:
        return float("nan")
    return statistics.linear_regression(*([math.log(v) for v in values] for values in (x, y))).slope


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
