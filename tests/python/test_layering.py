"""The rooms of csrc: each file includes only its own room and those its room stands on."""

import re
from pathlib import Path

import pytest

CSRC = Path(__file__).resolve().parents[2] / "csrc"

# What a room may include, besides what those rooms may include in turn. New room? It goes into this table first.
ROOMS = {
    "math": [],
    "geometry": ["math"],
    "model": ["geometry"],
    "dynamics": ["model", "geometry"],
    "collision": ["geometry"],
    "parallel": [],
    "contact": ["collision", "model"],
    "zone": ["contact", "dynamics"],
    "solve": ["zone", "parallel"],
    "adjoint": ["zone"],
    "step": ["solve", "adjoint"],
    "scene_queries": ["step"],
    "rollout": ["scene_queries"],
    "bindings": ["rollout", "scene_queries"],
}
PYTHON_ROOM = "bindings"  # the only one that sees Python

INCLUDE = re.compile(r'^\s*#\s*include\s*([<"])([^>"]+)[>"]', re.MULTILINE)
PYTHON_HEADER = re.compile(r"^(pybind11/|Python\.h|numpy/|torch/)")


def reachable_rooms(room: str) -> set[str]:
    return {room}.union(*(reachable_rooms(below) for below in ROOMS[room]))


def room_of(path: Path, csrc: Path) -> str:
    """The first folder, or for a file directly in csrc its name."""
    return Path(path.relative_to(csrc).parts[0]).stem


def violations(csrc: Path) -> list[str]:
    found = []
    for source in sorted(csrc.rglob("*.[ch]pp")):
        name = source.relative_to(csrc).as_posix()
        room = room_of(source, csrc)
        if room not in ROOMS:
            found.append(f"{name}: {room} is not a room")
            continue
        for bracket, header in INCLUDE.findall(source.read_text(encoding="utf-8")):
            beside, below_csrc = source.parent / header, csrc / header
            target = next((path.resolve() for path in (beside, below_csrc) if path.is_file()), None)
            if target is None and bracket == '"':
                found.append(f"{name}: {header} does not exist")
            elif target is not None and room_of(target, csrc.resolve()) not in reachable_rooms(room):
                found.append(f"{name}: {room} may not include {header}")
            elif PYTHON_HEADER.match(header) and room != PYTHON_ROOM:
                found.append(f"{name}: only {PYTHON_ROOM} may include {header}")
    return found


def test_csrc_keeps_to_its_rooms() -> None:
    assert len(list(CSRC.rglob("*.[ch]pp"))) > 10
    assert violations(CSRC) == []


def test_the_page_for_contributors_names_every_room() -> None:
    page = (CSRC.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^\| room \|.*?\n\n", page, re.MULTILINE | re.DOTALL)
    named = re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)
    assert sorted(named) == sorted(ROOMS)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """A small csrc in which every include is allowed."""
    for name, text in {
        "math/rotation.hpp": "#include <Eigen/Core>\n",
        "geometry/mesh.hpp": '#include "math/rotation.hpp"\n',
        "model/model.hpp": '#include "geometry/mesh.hpp"\n',
        "dynamics/solve.hpp": '#include "geometry/mesh.hpp"\n#include "model/model.hpp"\n',
        "collision/ccd.hpp": '#include "geometry/mesh.hpp"\n#include "math/rotation.hpp"\n',
        "contact/law.hpp": '#include "collision/ccd.hpp"\n',
        "zone/zone.hpp": '#include "contact/law.hpp"\n#include "dynamics/solve.hpp"\n',
        "zone/zone.cpp": '#include "zone.hpp"\n',
        "solve/zone_solver.hpp": '#include "zone/zone.hpp"\n',
        "adjoint/adjoint.hpp": '#include "zone/zone.hpp"\n',
        "step/step.cpp": '#include "solve/zone_solver.hpp"\n#include "adjoint/adjoint.hpp"\n',
        "step/step.hpp": '#include "model/model.hpp"\n',
        "step/step_backward.cpp": '#include "step/step.hpp"\n',
        "rollout.hpp": '#include "step/step.hpp"\n',
        "rollout.cpp": '#include "rollout.hpp"\n#include "math/rotation.hpp"\n',
        "bindings/bind_contact.cpp": '#include <pybind11/pybind11.h>\n#include "zone/zone.hpp"\n',
        "bindings/bind_rollout.cpp": '#include <pybind11/pybind11.h>\n#include "rollout.hpp"\n',
    }.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    return tmp_path


def test_allowed_includes_pass(tree: Path) -> None:
    assert violations(tree) == []


@pytest.mark.parametrize(
    ("name", "line", "complaint"),
    [
        ("math/a.hpp", '#include "geometry/mesh.hpp"', "math may not include geometry/mesh.hpp"),
        ("collision/a.cpp", '#include "model/model.hpp"', "collision may not include model/model.hpp"),
        ("collision/a.cpp", "  # include <model/model.hpp>", "collision may not include model/model.hpp"),
        ("contact/a.cpp", '#include "../step/step.hpp"', "contact may not include ../step/step.hpp"),
        ("contact/a.hpp", '#include "zone/zone.hpp"', "contact may not include zone/zone.hpp"),
        ("zone/a.cpp", '#include "solve/zone_solver.hpp"', "zone may not include solve/zone_solver.hpp"),
        ("adjoint/a.cpp", '#include "solve/zone_solver.hpp"', "adjoint may not include solve/zone_solver.hpp"),
        ("dynamics/a.cpp", '#include "collision/ccd.hpp"', "dynamics may not include collision/ccd.hpp"),
        ("geometry/a.hpp", '#include "model/model.hpp"', "geometry may not include model/model.hpp"),
        ("step/step.hpp", '#include "rollout.hpp"', "step may not include rollout.hpp"),
        ("step/step.hpp", '#include "bindings/bind_contact.cpp"', "step may not include bindings/bind_contact.cpp"),
        ("rollout.cpp", '#include "bindings/bind_rollout.cpp"', "rollout may not include bindings/bind_rollout.cpp"),
        ("rollout.hpp", "#include <pybind11/numpy.h>", "only bindings may include pybind11/numpy.h"),
        ("math/a.hpp", '#include "missing.hpp"', "missing.hpp does not exist"),
        ("shortcut/a.hpp", "", "shortcut is not a room"),
    ],
)
def test_violations_are_found(tree: Path, name: str, line: str, complaint: str) -> None:
    (tree / name).parent.mkdir(exist_ok=True)
    (tree / name).write_text(f"// a comment\n{line}\n")
    assert violations(tree) == [f"{name}: {complaint}"]
