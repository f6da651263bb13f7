"""The benchmarks run: every script in quick mode prints the table it promises, and nothing is said about its times."""

from __future__ import annotations

import csv
import importlib.util
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
SCRIPTS = sorted(BENCHMARKS.glob("[a-z]*.py"))
# Some of a script's columns, first and last among them.
COLUMNS = {
    "adjoint_modes": ("scene", "qr_state", "exact_error_median", "dense_backward_ms"),
    "bits": ("scene", "steps", "state", "gradient"),
    "batch": ("case", "scenes", "loop_forward_per_s", "gradient_ratio"),
    "ccd": ("case", "most_advances", "ours_us", "additive_us", "inclusion_to_ours", "inclusion_lost"),
    "cloth": ("side_nodes", "forward_contact_ms", "mujoco_step_ms", "backward_to_forward", "vbd_depth_m"),
    "cloth_accuracy": ("scene", "name", "time_ms_per_s", "step_error_mm", "error_mm", "depth_mm"),
    "contact_rich": ("scene", "forward_ms", "longest_ms", "failed_steps", "forward_to_mujoco", "longest_to_resting"),
    "falling_cubes": ("cubes", "forward_s", "mujoco_elliptic_s", "memory_mb", "rest_gap_m"),
    "fast_differentiation": ("cubes", "mode", "backward_ms", "memory_mb", "error", "backward_to_mujoco"),
    "friction": ("name", "creep", "acceleration_error", "gradient_error", "gradient_ms"),
    "limits": ("case", "name", "state", "what", "energy_made", "distance", "iterations", "error", "failed_steps"),
    "local_collisions": ("cubes", "step", "mode", "local_ms", "global_ms", "lcp_published_ms", "paper_code_ms"),
    "many_objects": ("objects", "forward_backward_s", "mujoco_forward_s", "memory_mb", "mpm_s", "paper_code_s"),
    "memory": ("case", "cubes", "peak_mb", "tape_bytes_per_body_step"),
    "overhead": ("run", "nothing_forward_us", "backward_ratio"),
    "pay_for_use": ("case", "what", "step_us", "ratio", "allocations_per_step", "module_mb"),
    "relative_scale": ("scale", "forward_backward_s", "memory_mb", "most_iterations"),
    "work_precision": ("scene", "what", "name", "run", "failure", "dt_s", "time_ms", "error"),
    "threads": ("cubes", "threads", "forward_s", "backward_speedup"),
}
POSITIVE = ("_s", "_ms", "_us")  # endings of columns that are times
TEXT = (
    "mode",
    "step",
    "scene",
    "material",
    "name",
    "case",
    "directions",
    "peer",
    "what",
    "state",
    "gradient",
    "run",
    "failure",
)

for package in ("matplotlib", "mujoco", "ipctk"):
    pytest.importorskip(package, reason="the benchmarks' packages: pip install .[bench]")


def test_all_scripts_are_here() -> None:
    assert {script.stem for script in SCRIPTS} >= set(COLUMNS)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder that scripts run in, in this process: to load torch anew takes longer than most of them."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(BENCHMARKS))  # as Python does for a script
    threads = torch.get_num_threads()
    yield tmp_path
    torch.set_num_threads(threads)


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_benchmark_prints_its_table(
    script: Path, here: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    if "_stage" in script.read_text(encoding="utf-8"):
        pytest.importorskip("pymeshfix", reason="the examples' packages: pip install .[examples]")
    spec = importlib.util.spec_from_file_location(script.stem, script)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, script.stem, module)  # processes that it starts find its functions there
    monkeypatch.setattr(sys, "argv", [str(script), "--quick"])
    spec.loader.exec_module(module)
    assert module.main() == 0
    lines = capfd.readouterr().out.splitlines()
    comments = [line for line in lines if line.startswith("#")]
    assert "cores" in comments[0]  # the machine
    assert "mesh-diffsim" in comments[1]  # versions
    table = csv.DictReader(line for line in lines if not line.startswith("#"))
    rows = list(table)
    columns = list(table.fieldnames or ())
    assert len(set(columns)) == len(columns)
    expected = COLUMNS.get(script.stem)
    if expected is not None:
        assert set(expected) <= set(columns)
        assert (expected[0], expected[-1]) == (columns[0], columns[-1])
    assert rows
    for row in rows:
        assert None not in row and None not in row.values(), row  # as many fields as columns
        numbers = {name: text for name, text in row.items() if name not in TEXT and text}
        assert numbers, row
        for name, text in numbers.items():
            value = float(text)
            assert math.isfinite(value), (name, text)
            assert value > 0.0 if name.endswith(POSITIVE) else value >= 0.0, (name, text)
    filled = {name for row in rows for name, text in row.items() if text}
    peers = {name for name in columns if any(peer in name for peer in ("published", "paper", "mpm", "vbd"))}
    assert filled >= set(columns) - peers  # only others' figures may be missing everywhere, as quick runs are small
    for comment in comments:
        if comment.startswith("# plot: "):
            assert (here / comment.removeprefix("# plot: ")).stat().st_size > 5_000


def test_fresh_processes_take_the_package_of_the_one_that_starts_them(tmp_path: Path) -> None:
    """As where the scripts are run from the source tree, whose package is not compiled."""
    (tmp_path / "diffsim").mkdir()
    (tmp_path / "diffsim" / "__init__.py").touch()
    run = subprocess.run(
        [sys.executable, str(BENCHMARKS / "memory.py"), "--quick"], cwd=tmp_path, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    assert "peak_mb" in run.stdout
