"""The notebooks run, in a short setting; and what is committed with outputs is what their text says."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import pytest
import torch

NOTEBOOKS = Path(__file__).resolve().parents[2] / "examples" / "notebooks"
TEXTS = sorted(NOTEBOOKS.glob("[0-9]*.py"))
LARGEST = 300_000  # [bytes]

jupytext = pytest.importorskip("jupytext", reason="pip install 'mesh-diffsim[notebooks]'")


@pytest.fixture
def shell(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Runs cells as a notebook does, here, where torch is loaded already."""
    pytest.importorskip("k3d", reason="pip install 'mesh-diffsim[notebooks]'")
    pytest.importorskip("pymeshfix", reason="pip install 'mesh-diffsim[notebooks]'")
    interactive = pytest.importorskip("IPython.core.interactiveshell", reason="pip install 'mesh-diffsim[notebooks]'")
    matplotlib = pytest.importorskip("matplotlib", reason="pip install 'mesh-diffsim[notebooks]'")
    matplotlib.use("Agg")
    dtype, hook = torch.get_default_dtype(), sys.excepthook
    yield interactive.InteractiveShell()
    torch.set_default_dtype(dtype)
    sys.excepthook = hook
    matplotlib.pyplot.close("all")


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.stem)
@pytest.mark.filterwarnings("ignore")
def test_notebook_runs(text: Path, shell: Any) -> None:
    cells = [cell.source for cell in jupytext.read(text).cells if cell.cell_type == "code"]
    assert sum("QUICK = False" in cell for cell in cells) == 1
    for cell in cells:
        result = shell.run_cell(cell.replace("QUICK = False", "QUICK = True"), silent=True)
        result.raise_error()


def test_notebooks_are_there() -> None:
    assert len(TEXTS) == 5
    assert [path.stem for path in sorted(NOTEBOOKS.glob("*.ipynb"))] == [path.stem for path in TEXTS]


@pytest.mark.parametrize("text", TEXTS, ids=lambda path: path.stem)
def test_notebook_is_the_text_with_outputs(text: Path) -> None:
    path = text.with_suffix(".ipynb")
    assert path.stat().st_size < LARGEST
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    ours = [(cell.cell_type, cell.source) for cell in jupytext.read(text).cells]
    mend = "run examples/notebooks/execute.py"
    assert [(cell["cell_type"], "".join(cell["source"])) for cell in cells] == ours, mend
    outputs = [output for cell in cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs), mend
    assert not any(output["output_type"] == "error" for output in outputs), mend
