"""Importing diffsim is cheap: what only some users need is loaded when they need it."""

import subprocess
import sys

import pytest

LAZY_MODULES = (
    *("trimesh", "fcl", "matplotlib", "scipy", "tqdm", "mujoco", "gymnasium"),
    *("k3d", "imageio_ffmpeg", "PIL", "rerun"),
    *("diffsim.diagnostics", "diffsim.interop", "diffsim.viewer"),
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


def test_loaded_modules_are_seen() -> None:
    assert "trimesh" in modules_loaded_by("import trimesh")


def test_public_names_exist() -> None:
    import diffsim

    assert diffsim.__all__
    missing = [name for name in diffsim.__all__ if not hasattr(diffsim, name)]
    assert not missing
    assert set(diffsim.__all__) <= set(dir(diffsim))
