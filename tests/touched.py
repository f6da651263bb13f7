"""Which tests `make check` runs: those of what differs from the last commit, and of what stands on it.

python tests/touched.py cpp      a regular expression of ctest's names
python tests/touched.py python   files of tests for pytest
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

TOP = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(TOP / "tests" / "python"))

from test_layering import ROOMS, reachable_rooms  # noqa: E402

# Of a change in the core: the layer end to end, in seconds. What else there is is slower, or about other things.
END_TO_END = ("closed_forms", "contacts", "determinism", "failures", "ops", "simulator", "stub")
OF_THE_LAYER = ("import", "python_layering", "simulator", "state")
ALWAYS = ("layering", "sizes")


def changed_files() -> list[Path]:
    """In the working tree, against the last commit."""
    names = subprocess.run(
        ["git", "status", "--porcelain", "--no-renames", "--untracked-files=all"],
        cwd=TOP,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.splitlines()
    return [Path(line[3:]) for line in names]


def touched_rooms(files: list[Path]) -> set[str]:
    """Rooms of csrc with a change in them or in their tests, and all that stand on a room that changed."""
    changed = {Path(file.parts[1]).stem for file in files if file.parts[0] == "csrc"}
    tested = {file.parts[2] for file in files if file.parts[:2] == ("tests", "cpp") and len(file.parts) > 3}
    above = {room for room in ROOMS if changed & reachable_rooms(room)}
    return above | (tested & set(ROOMS))


def ctest_names(files: list[Path]) -> str:
    rooms = touched_rooms(files)
    return "|".join(f"tests/cpp/(test_)?{room}[./]" for room in sorted(rooms)) or "test_build_flags"


def pytest_files(files: list[Path]) -> list[str]:
    names = set(ALWAYS)
    for file in files:
        if file.parts[0] == "csrc":
            names.update(END_TO_END)
        elif file.parts[0] == "diffsim":
            names.update((file.stem.lstrip("_"), *OF_THE_LAYER))
        elif file.parts[:2] == ("tests", "python") and file.stem.startswith("test_"):
            names.add(file.stem.removeprefix("test_"))
    paths = (Path("tests/python") / f"test_{name}.py" for name in sorted(names))
    return [str(path) for path in paths if (TOP / path).is_file()]


def main() -> int:
    files = changed_files()
    print({"cpp": ctest_names, "python": lambda files: " ".join(pytest_files(files))}[sys.argv[1]](files))
    return 0


if __name__ == "__main__":
    sys.exit(main())
