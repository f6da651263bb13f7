"""diffsim/_core.pyi says what the compiled module has: names, arguments, defaults and types."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import Any

import pytest

import diffsim
from diffsim import _core

# What pybind11 writes into docstrings -> what the stub says. An int is taken where a float is asked for, as elsewhere.
SPELLINGS = (
    (r"typing\.SupportsFloat \| typing\.SupportsIndex", "float"),
    (r"typing\.SupportsInt \| typing\.SupportsIndex", "int"),
    (r"typing\.Annotated\[(.*), 'FixedSize\(\d+\)'\]", r"\1"),
    (r"collections\.abc\.|diffsim\._core\.|numpy\.typing\.", ""),
    (r"\bnumpy\.", "np."),
)
NOT_IN_DOCSTRINGS = re.compile(r"\b(tuple|dict)\[.*\]")  # the C++ type is a bare tuple or dict


def typed(annotation: ast.expr | None) -> str:
    text = "" if annotation is None else ast.unparse(annotation)
    for pattern, replacement in SPELLINGS:
        text = re.sub(pattern, replacement, text)
    return NOT_IN_DOCSTRINGS.sub(r"\1", text)


def signature(function: ast.FunctionDef) -> tuple[Any, ...]:
    """Arguments as (name, type, default), keyword-only ones apart, and the type of the result."""
    a = function.args
    defaults = [None] * (len(a.args) - len(a.defaults)) + [ast.unparse(d) for d in a.defaults]
    keyword_defaults = [None if d is None else ast.unparse(d) for d in a.kw_defaults]
    plain = [(x.arg, typed(x.annotation), d) for x, d in zip(a.args, defaults) if x.arg != "self"]
    return (
        plain,
        [(x.arg, typed(x.annotation), d) for x, d in zip(a.kwonlyargs, keyword_defaults)],
        typed(function.returns),
    )


def documented(function: Any) -> tuple[Any, ...]:
    """The signature in the first line of a docstring by pybind11."""
    line = function.__doc__.strip().splitlines()[0]
    name = "_" if line.startswith("(") else ""  # getters have none
    definition = ast.parse(f"def {name}{line}: ...").body[0]
    assert isinstance(definition, ast.FunctionDef)
    return signature(definition)


@pytest.fixture(scope="module")
def stub() -> dict[str, ast.stmt]:
    assert diffsim.__file__ is not None
    text = Path(diffsim.__file__).with_name("_core.pyi").read_text(encoding="utf-8")
    return {x.name: x for x in ast.parse(text).body if isinstance(x, (ast.FunctionDef, ast.ClassDef))}


def members(definition: ast.ClassDef) -> dict[str, ast.stmt]:
    found: dict[str, ast.stmt] = {x.name: x for x in definition.body if isinstance(x, ast.FunctionDef)}
    found.update({ast.unparse(x.target): x for x in definition.body if isinstance(x, ast.AnnAssign)})
    return found


def public(namespace: Any) -> dict[str, Any]:
    """Its members without those that every class has; __init__ where Python may make instances."""
    own = {name: value for name, value in vars(namespace).items() if not name.startswith("_")}
    init = vars(namespace).get("__init__")
    if init is not None and (init.__doc__ or "").startswith("__init__(self: "):
        own["__init__"] = init
    return own


def test_stub_has_the_names_of_the_module(stub: dict[str, ast.stmt]) -> None:
    assert set(stub) == set(public(_core))


@pytest.mark.parametrize("name", sorted(public(_core)))
def test_stub_has_the_types_of_the_module(name: str, stub: dict[str, ast.stmt]) -> None:
    compiled, definition = getattr(_core, name), stub[name]
    if isinstance(definition, ast.FunctionDef):
        assert signature(definition) == documented(compiled)
        return
    assert isinstance(definition, ast.ClassDef)
    written, own = members(definition), public(compiled)
    assert set(written) == set(own)
    assert ast.get_docstring(definition) == compiled.__doc__
    for member, statement in written.items():
        value = own[member]
        if isinstance(statement, ast.AnnAssign):
            assert value.fset is not None
            assert typed(statement.annotation) == documented(value.fget)[2], member
        elif isinstance(value, property):
            assert isinstance(statement, ast.FunctionDef)
            assert value.fset is None
            returns = typed(statement.returns)
            assert documented(value.fget)[2] in (returns, returns.removesuffix(" | None")), member  # None for a pointer
        else:
            assert isinstance(statement, ast.FunctionDef)
            assert signature(statement) == documented(value), member


def test_a_difference_is_seen() -> None:
    changed = ast.parse("def min_distance(model: Model, position: NDArray[np.float32]) -> tuple: ...").body[0]
    assert isinstance(changed, ast.FunctionDef)
    assert signature(changed) != documented(_core.min_distance)
