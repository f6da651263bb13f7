"""Two processes, each with half of the scenes, give the gradient of one process with all of them."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCRIPT = EXAMPLES / "train_distributed.py"
SAME = 1e-10  # relative

pytest.importorskip("pymeshfix", reason="the examples' packages: pip install .[examples]")
if not torch.distributed.is_available() or not torch.distributed.is_gloo_available():
    pytest.skip("this torch has no gloo", allow_module_level=True)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def run(processes: int, *arguments: str, cwd: Path) -> tuple[str, int]:
    """Output and exit code of the example, by torchrun if there is more than one process."""
    launcher: list[str] = []
    if processes > 1:
        launcher = ["-m", "torch.distributed.run", "--nproc_per_node", str(processes)]
        launcher += ["--master_addr", "127.0.0.1", "--master_port", str(free_port())]
    command = [sys.executable, *launcher, str(SCRIPT), "--no-picture", *arguments]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=600)
    assert "iteration" in done.stdout, done.stderr
    return done.stdout, done.returncode


def test_two_processes_give_the_gradient_of_one(tmp_path: Path) -> None:
    gradients = []
    for processes in (1, 2):
        path = tmp_path / f"gradient_{processes}.pt"
        output, _ = run(processes, "--iterations", "1", "--gradient", str(path), cwd=tmp_path)
        assert f"ok    gradient of {processes} process(es) equals that of one" in output
        gradients.append(torch.load(path))
    one, two = gradients
    assert float(one.norm()) > 1e-3
    assert float((two - one).norm()) <= SAME * float(one.norm())
    # Half of the scenes alone would be far off: what is compared is not insensitive to who plays which.
    sys.path.insert(0, str(EXAMPLES))
    spec = importlib.util.spec_from_file_location("train_distributed", SCRIPT)
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = example
    spec.loader.exec_module(example)
    policy, half = example.Policy(), example.Share(0, 2).part(example.targets(example.SCENES, seed=0))
    example.squared_distance(policy(half), half).backward()
    assert float((example.gradient(policy) - one).norm()) > 1e-3 * float(one.norm())


def test_training_in_two_processes_passes_its_checks(tmp_path: Path) -> None:
    output, code = run(2, cwd=tmp_path)
    assert code == 0, output
    assert output.count("ok  ") == 6, output


def test_scenes_must_divide_between_processes(tmp_path: Path) -> None:
    environment = {**os.environ, "WORLD_SIZE": "3", "RANK": "0"}
    done = subprocess.run([sys.executable, str(SCRIPT)], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode != 0
    assert "32 scenes cannot be shared equally between 3 processes" in done.stderr
