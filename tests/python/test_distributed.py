"""Two processes, each with half of the scenes, give the gradient of one process with all of them."""

from __future__ import annotations

import importlib.util
import os
import socket
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
SCRIPT = EXAMPLES / "train_distributed.py"
SAME = 1e-10  # relative

pytest.importorskip("pymeshfix", reason="the examples' packages: pip install .[examples]")
if not torch.distributed.is_available() or not torch.distributed.is_gloo_available():
    pytest.skip("this torch has no gloo", allow_module_level=True)


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(EXAMPLES))
    spec = importlib.util.spec_from_file_location("train_distributed", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def test_two_processes_train_by_the_gradient_of_one(example: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "gradient.pt"
    launcher = ["-m", "torch.distributed.run", "--nproc_per_node", "2", "--master_addr", "127.0.0.1"]
    launcher += ["--master_port", str(free_port())]
    command = [sys.executable, *launcher, str(SCRIPT), "--quick", "--no-picture", "--gradient", str(path)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "ok    gradient of 2 process(es) equals that of one" in done.stdout
    assert done.stdout.count("ok  ") == 7, done.stdout
    two, one = torch.load(path), example.reference_gradient(0)
    assert float(one.norm()) > 1e-3
    assert float((two - one).norm()) <= SAME * float(one.norm())
    # Half of the scenes alone would be far off: what is compared is not insensitive to who plays which.
    policy, half = example.Policy(), example.Share(0, 2).part(example.targets(example.SCENES, seed=0))
    example.squared_distance(policy(half), half).backward()
    assert float((example.gradient(policy) - one).norm()) > 1e-3 * float(one.norm())


def test_one_process_gives_its_gradient_to_who_asks(example: ModuleType, tmp_path: Path) -> None:
    path = tmp_path / "gradient.pt"
    example.main(["--iterations", "1", "--no-picture", "--gradient", str(path)])
    assert torch.equal(torch.load(path), example.reference_gradient(0))


def test_a_striker_of_another_mass_is_noticed(example: ModuleType) -> None:
    policy = example.Policy()
    assert example.momentum_error(policy) <= example.MOMENTUM_ERROR
    with torch.no_grad():
        policy.sim.mass[0] *= 1.5
    assert example.momentum_error(policy) > 0.1


def test_scenes_must_divide_between_processes(example: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "3")
    monkeypatch.setenv("RANK", "0")
    with pytest.raises(SystemExit, match="32 scenes cannot be shared equally between 3 processes"):
        example.main([])
