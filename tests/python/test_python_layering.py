"""The rooms of diffsim/: each module imports only from its own room and those its room stands on."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).resolve().parents[2] / "diffsim"


class Room(NamedTuple):
    """What belongs to it, and what it may import, besides what the rooms below may import in turn."""

    modules: str  # or folders
    stands_on: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()  # others' that its modules need as soon as they are imported
    lazy: tuple[str, ...] = ()  # that only functions import, when they are called


# New module? It goes into this table first.
ROOMS = {
    "core": Room("_core _input_table"),
    "basics": Room("rotation shapes _extras _handles _progress", (), ("numpy", "torch"), ("scipy", "tqdm")),
    "meshes": Room("_mass_properties _mesh _mesh_queries _surfaces _volume", (), ("numpy",), ("trimesh", "fcl")),
    "model": Room(
        "_arguments materials _body_shape _cloth_shape _interpenetration _packed _units scene",
        ("core", "basics", "meshes"),
        ("numpy",),
        ("fcl",),
    ),
    "state": Room("state _check _inputs", ("core", "basics"), ("numpy", "torch")),
    "operator": Room("_outcome _core_calls _folding ops _owners _compiled", ("core", "state"), ("numpy", "torch")),
    "measures": Room(
        "_energies _cloth_energy _measurements contacts _description _identity",
        ("model", "state"),
        ("numpy", "torch"),
        ("trimesh",),
    ),
    "simulator": Room("simulator parameters", ("operator", "measures"), ("numpy", "torch")),
    "diagnostics": Room("diagnostics _dump", ("simulator",), ("numpy", "torch")),
    "scenes": Room("scenes", ("model",), ("numpy",)),
    "viewer": Room("viewer", ("simulator",), ("numpy", "torch"), ("trimesh",)),
    "interop": Room("interop", ("simulator",), ("numpy", "torch", "gymnasium", "mujoco"), ("trimesh",)),
}
TOP = "__init__"  # imports what is public
LOADED_AT_ONCE = ("state",)  # by the top, all else when someone asks for it


class Import(NamedTuple):
    """One name that a module imports."""

    target: str  # dotted; within the package without its name
    ours: bool
    eager: bool  # when the module is imported, and not only where types are checked


def room_of(module: str) -> str | None:
    first = module.partition(".")[0]
    return next((name for name, room in ROOMS.items() if first in room.modules.split()), None)


def reachable_rooms(room: str) -> set[str]:
    return {room}.union(*(reachable_rooms(below) for below in ROOMS[room].stands_on))


def imports_of(source: str, package: tuple[str, ...]) -> Iterator[Import]:
    """All of a module in that package, `()` for diffsim itself."""

    def visit(node: ast.AST, eager: bool) -> Iterator[Import]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import):
                yield from (Import(alias.name, False, eager) for alias in child.names)
            elif isinstance(child, ast.ImportFrom):
                parents = package[: len(package) - child.level + 1] if child.level else ()
                dotted = ".".join((*parents, *([child.module] if child.module else ())))
                names = [dotted] if dotted else [alias.name for alias in child.names]
                yield from (Import(name, bool(child.level), eager) for name in names)
            else:
                function = isinstance(child, ast.FunctionDef | ast.Lambda)
                types_only = isinstance(child, ast.If) and ast.unparse(child.test).endswith("TYPE_CHECKING")
                yield from visit(child, eager and not function and not types_only)

    yield from visit(ast.parse(source), True)


def violations(package: Path) -> list[str]:
    found = []
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package).with_suffix("").parts
        name, room = path.relative_to(package).as_posix(), room_of(parts[0])
        if room is None and parts != (TOP,):
            found.append(f"{name}: it is in no room")
            continue
        for target, ours, eager in imports_of(path.read_text(encoding="utf-8"), parts[:-1]):
            if ours and room is None:
                wrong = eager and target not in LOADED_AT_ONCE
            elif ours:
                wrong = room_of(target) not in reachable_rooms(room)
            else:
                other = target.partition(".")[0]
                allowed = (*ROOMS[room].packages, *(() if eager else ROOMS[room].lazy)) if room else ()
                wrong = other not in sys.stdlib_module_names and other not in allowed
            if wrong:
                found.append(f"{name}: {room or TOP} may not import {target}{'' if eager else ' in a function'}")
    return found


def test_the_package_keeps_to_its_rooms() -> None:
    assert len(list(PACKAGE.rglob("*.py"))) > 30
    assert violations(PACKAGE) == []


def test_every_module_of_the_table_exists() -> None:
    listed = [module for room in ROOMS.values() for module in room.modules.split()]
    assert len(listed) == len(set(listed))
    there = {path.name.partition(".")[0] for path in PACKAGE.iterdir()}
    assert [module for module in listed if module not in there] == []


def test_the_page_for_contributors_names_every_room_and_module() -> None:
    page = (PACKAGE.parent / "CONTRIBUTING.md").read_text(encoding="utf-8")
    (table,) = re.findall(r"^\| layer room \|.*?\n\n", page, re.MULTILINE | re.DOTALL)
    rows = re.findall(r"^\| `(\w+)` \| ([^|]+) \|", table, re.MULTILINE)
    assert [(room, re.findall(r"`(\w+)`", modules)) for room, modules in rows] == [
        (name, room.modules.split()) for name, room in ROOMS.items()
    ]


@pytest.mark.parametrize(
    ("name", "line", "complaint"),
    [
        ("_mesh.py", "import torch", "meshes may not import torch"),
        ("_mesh.py", "import trimesh", "meshes may not import trimesh"),
        ("_mesh.py", "from .scene import Scene", "meshes may not import scene"),
        ("scene.py", "from .state import State", "model may not import state"),
        ("_mesh.py", "from . import _core", "meshes may not import _core"),
        ("ops.py", "def f():\n    from .simulator import Simulator", "operator may not import simulator in a function"),
        ("_energies.py", "from .viewer import record", "measures may not import viewer"),
        ("simulator.py", "import scipy.sparse", "simulator may not import scipy.sparse"),
        ("viewer/_draw.py", "import matplotlib", "viewer may not import matplotlib"),
        ("viewer/_draw.py", "from ..interop import mujoco", "viewer may not import interop"),
        ("viewer/_draw.py", "from ..diagnostics import dump", "viewer may not import diagnostics"),
        ("__init__.py", "from . import interop", "__init__ may not import interop"),
        ("_new.py", "", "it is in no room"),
    ],
)
def test_violations_are_found(tmp_path: Path, name: str, line: str, complaint: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(f"{line}\n")
    assert violations(tmp_path) == [f"{name}: {complaint}"]


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("_mesh.py", "def f():\n    import trimesh"),
        ("contacts.py", "if TYPE_CHECKING:\n    from .state import State"),
        ("viewer/_draw.py", "from .._extras import require\nfrom ._film import write\nfrom .. import _energies"),
        ("interop/mujoco.py", "try:\n    import mujoco\nexcept ImportError:\n    raise"),
        ("__init__.py", "from .state import State\ndef f():\n    from . import interop"),
    ],
)
def test_what_is_allowed_passes(tmp_path: Path, name: str, line: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(f"{line}\n")
    assert violations(tmp_path) == []
