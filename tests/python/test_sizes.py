"""Files of 500 lines, functions of csrc of 60, lines of C++ of 120 columns at most; `make lint` asks it, too."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

TOP = Path(__file__).resolve().parents[2]
FOLDERS = ("csrc", "diffsim", "tests", "benchmarks", "examples", "docs")
MOST_LINES_OF_A_FILE = 500
MOST_LINES_OF_A_FUNCTION = 60
MOST_COLUMNS = 120  # of C++, whose comments clang-format leaves as they are; ruff counts those of Python


def blocks(lines: list[str]) -> Iterator[tuple[int, int]]:
    """First and last line, counted from 1, of what ends with a brace of its own: as clang-format writes code, functions
    and what is in them, but no classes, namespaces and initializers.
    """
    for end, line in enumerate(lines):
        if line.strip() != "}":
            continue
        indent = line.index("}")
        for begin in range(end - 1, -1, -1):
            text = lines[begin]
            if text.strip() and not text.startswith("#") and len(text) - len(text.lstrip()) <= indent:
                yield begin + 1, end + 1
                break


def violations(top: Path) -> list[str]:
    found = []
    for path in sorted(path for folder in FOLDERS for path in (top / folder).rglob("*.*")):
        if path.suffix not in (".py", ".pyi", ".cpp", ".hpp"):
            continue
        name, lines = path.relative_to(top).as_posix(), path.read_text(encoding="utf-8").splitlines()
        if len(lines) > MOST_LINES_OF_A_FILE:
            found.append(f"{name}: {len(lines)} lines, at most {MOST_LINES_OF_A_FILE}")
        found += [
            f"{name}:{number}: {len(line)} columns, at most {MOST_COLUMNS}"
            for number, line in enumerate(lines, 1)
            if len(line) > MOST_COLUMNS and path.suffix in (".cpp", ".hpp")
        ]
        if name.startswith("csrc/"):
            found += [
                f"{name}:{begin}: {end - begin + 1} lines of one function, at most {MOST_LINES_OF_A_FUNCTION}"
                for begin, end in blocks(lines)
                if end - begin + 1 > MOST_LINES_OF_A_FUNCTION
            ]
    return found


def test_files_and_functions_are_short() -> None:
    assert len(list((TOP / "csrc").rglob("*.cpp"))) > 10
    assert violations(TOP) == []


def test_what_is_too_long_is_found(tmp_path: Path) -> None:
    body = ["    int i = 0;", "", "#if X", "    for (;;) {", "        ++i;", "    }", *["    ++i;"] * 52]
    function = ["int f(", "    int a) {", *body, "}"]
    assert len(function) == 61
    (tmp_path / "csrc/room").mkdir(parents=True)
    (tmp_path / "csrc/room/a.cpp").write_text("\n".join(["namespace n {", "", *function, "", "}  // namespace n"]))
    assert violations(tmp_path) == ["csrc/room/a.cpp:3: 61 lines of one function, at most 60"]
    (tmp_path / "csrc/room/a.cpp").write_text("\n".join([*function[:-2], "}"]))
    assert violations(tmp_path) == []
    (tmp_path / "diffsim").mkdir()
    (tmp_path / "diffsim/a.py").write_text("x = 1\n" * 501)
    assert violations(tmp_path) == ["diffsim/a.py: 501 lines, at most 500"]
    (tmp_path / "diffsim/a.py").unlink()
    (tmp_path / "csrc/room/a.cpp").write_text("// " + "é" * 117 + "\n// " + "é" * 118, encoding="utf-8")
    assert violations(tmp_path) == ["csrc/room/a.cpp:2: 121 columns, at most 120"]


if __name__ == "__main__":
    sys.exit("\n".join(violations(TOP)) or None)
