"""The examples, run as their users run them."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
pytest.importorskip("pymeshfix", reason="the examples' packages: pip install .[examples]")


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look it up there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def bunny() -> ModuleType:
    return load("throw_bunny")


def test_throw_bunny_arrives(bunny: ModuleType, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert bunny.main(["--iterations", "40", "--out", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "FAIL" not in output
    assert output.count("ok  ") == 9
    assert (tmp_path / "throw_bunny.png").stat().st_size > 10_000


def test_throw_bunny_check_fails_without_optimisation(bunny: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert bunny.main(["--iterations", "1", "--no-picture"]) == 1
    assert "FAIL  squared distance fell 1 times" in capsys.readouterr().out


def test_throw_bunny_takes_another_mesh(bunny: ModuleType, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "ellipsoid.ply"
    mesh = trimesh.creation.icosphere(subdivisions=4)
    mesh.apply_scale([3.0, 2.0, 1.5])
    mesh.export(path)
    loaded = bunny.load_mesh(str(path))
    assert loaded.is_watertight
    assert len(loaded.faces) <= bunny.FACES
    assert loaded.extents.max() == pytest.approx(bunny.SIZE)
    np.testing.assert_allclose(loaded.center_mass, 0.0, atol=1e-6 * bunny.SIZE)


def test_throw_bunny_judge_sees_what_overlaps(bunny: ModuleType) -> None:
    throw = bunny.Throw(bunny.load_mesh())
    judge = bunny.Judge(throw)
    at_rest = throw.sim.initial_state(batch=1)  # taken for a trajectory of one step
    assert judge.penetrations(at_rest) == []
    chute, wedge = (throw.sim.body_names.index(name) for name in ("chute", "wedge"))
    wall = torch.tensor([0.0, 0.16, 0.0], dtype=torch.float64)
    for place, partner in (
        (throw.rest.position[chute] + wall, "chute"),
        (throw.rest.position[wedge], "wedge"),  # swallowed whole
        (torch.tensor([0.0, 0.0, 0.01], dtype=torch.float64), "the ground"),
    ):
        position = at_rest.position.clone()
        position[:, throw.bunny] = place
        (found,) = judge.penetrations(at_rest.replace(position=position))
        assert "bunny" in found
        assert partner in found
