"""Importing diffsim is cheap: what only some users need is loaded when they need it."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import diffsim

LAZY_MODULES = (
    *("trimesh", "fcl", "matplotlib", "scipy", "tqdm", "mujoco", "gymnasium"),
    *("k3d", "imageio_ffmpeg", "PIL", "rerun"),
    *("diffsim.diagnostics", "diffsim.interop", "diffsim.viewer", "diffsim.scene", "diffsim.simulator"),
)


def modules_loaded_by(statement: str) -> set[str]:
    script = f"import sys\n{statement}\nprint(*sys.modules)"
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(result.stdout.split())


@pytest.fixture(scope="module")
def loaded() -> set[str]:
    """What `import diffsim` loads beyond `import torch`, which takes tqdm along where that is installed."""
    return modules_loaded_by("import torch, diffsim") - modules_loaded_by("import torch")


@pytest.mark.parametrize("module", LAZY_MODULES)
def test_import_does_not_load(module: str, loaded: set[str]) -> None:
    assert "diffsim" in loaded
    assert module not in loaded


def test_the_ops_of_torch_compile_are_registered_when_they_are_traced() -> None:
    assert "diffsim._compiled" not in modules_loaded_by("import torch, diffsim; diffsim.Simulator")


def test_loaded_modules_are_seen() -> None:
    assert "trimesh" in modules_loaded_by("import trimesh")


def test_public_names_exist() -> None:
    assert diffsim.__all__
    missing = [name for name in diffsim.__all__ if not hasattr(diffsim, name)]
    assert not missing
    assert set(diffsim.__all__) <= set(dir(diffsim))


def test_type_checkers_see_what_is_loaded_later() -> None:
    tree = ast.parse(Path(diffsim.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    told = {alias.name for node in block.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert told | {"Control", "State"} == set(diffsim.__all__)
