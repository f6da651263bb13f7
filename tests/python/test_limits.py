"""A few of the cases of benchmarks/limits.py, which has them all: what was expected of them happens."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
from _limit_cases import CASES, Case
from limits import judge, run

GREEN = {
    ("mass ratio (heavy on light)", "10000"),
    ("compliance", "0"),
    ("dt [s]", "1e-06"),
    ("size [m]", "1e-06"),
    ("size [m]", "100000"),
    ("triangles twice", "all"),
    ("coplanar faces: gap [m]", "1e-08"),
    ("meeting", "corner on corner"),
    ("turned about an axis", "180° about 1 1 1"),
    ("friction", "10: heap"),
    ("card house", "2 high (friction 0.5)"),
    ("jam", "box between walls (friction 1.5)"),
    ("jam", "rod on its tip at -1 m/s (friction 10)"),
}
CHOSEN = [case for case in CASES if (case.family, case.value) in GREEN]


def test_all_chosen_cases_are_there() -> None:
    assert len(CHOSEN) == len(GREEN)


@pytest.mark.parametrize("case", CHOSEN, ids=lambda case: f"{case.family} {case.value}")
def test_what_was_expected_at_a_limit_happens(case: Case) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        row = run(case)
    judge(case, row)
    assert (row["state"], row["what"]) == ("green", "as expected")


def test_a_failed_expectation_is_told() -> None:
    """The suite sees what it is there to see: here a box that must not move and falls."""
    falls = next(case for case in CASES if case.family == "size [m]" and case.value == "1")
    row = run(Case("test", "falls", falls.build, "stands", steps=5, still=1e-3))
    judge(falls, row)
    assert row["state"] == "yellow"
    assert "moves by" in row["what"]
