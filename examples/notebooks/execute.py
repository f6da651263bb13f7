"""Run the notebooks and keep what they show: every `NN_name.py` here is written to `NN_name.ipynb` with its outputs.

The `.py` files are the ones to edit, in jupytext's percent format, of which notebooks are made. `make notebooks` runs
this.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import jupytext
import nbformat
from nbclient import NotebookClient
from tqdm import tqdm

HERE = Path(__file__).resolve().parent
LARGEST = 300_000  # of a notebook with its outputs [bytes]
PAIRED = {"formats": "ipynb,py:percent"}


def notebook_of(path: Path) -> Any:
    """The notebook in a `.py` file, without outputs, its cells numbered so that it is the same each time."""
    notebook = jupytext.read(path)
    for number, cell in enumerate(notebook.cells):
        cell["id"] = f"cell-{number}"
    notebook.metadata = {
        "jupytext": PAIRED,
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
    }
    return notebook


def without_widgets(output: Any) -> Any:
    """What is to be turned around needs a live kernel: of it only its name is kept."""
    if "data" in output:
        output["data"].pop("application/vnd.jupyter.widget-view+json", None)
    return output


def execute(path: Path) -> Path:
    notebook = notebook_of(path)
    resources = {"metadata": {"path": str(HERE)}}
    NotebookClient(notebook, timeout=600, store_widget_state=False, resources=resources).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)  # when it ran
        if cell.cell_type == "code":
            cell.outputs = [without_widgets(output) for output in cell.outputs]
    result = path.with_suffix(".ipynb")
    nbformat.write(notebook, result)
    size = result.stat().st_size
    if size > LARGEST:
        raise SystemExit(f"{result.name} has {size} bytes, more than {LARGEST}: draw less, or smaller")
    return result


def main() -> None:
    wanted = [Path(name) for name in sys.argv[1:]] or sorted(HERE.glob("[0-9]*.py"))
    for path in tqdm(wanted, desc="notebooks", unit="notebook"):
        execute(path.resolve())


if __name__ == "__main__":
    main()
