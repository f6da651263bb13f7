"""The README's example runs as printed, and says something true; the pages it links to exist."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
README = ROOT / "README.md"
PAGES = (*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md")))


def test_example_runs_and_its_gradient_is_right(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    names: dict[str, Any] = {}
    exec(code, names)
    assert "tensor" in capsys.readouterr().out

    sim, state, ball, crate = (names[name] for name in ("sim", "state", "ball", "crate"))
    along_x = state.velocity.grad[ball, 0]
    assert along_x > 0.01  # a faster ball pushes the crate further
    ends = []
    for sign in (1.0, -1.0):
        velocity = state.velocity.detach().clone()
        velocity[ball, 0] += sign * 1e-6
        ends.append(sim.rollout(state.detach().replace(velocity=velocity), None, steps=100).position[-1, crate, 0])
    torch.testing.assert_close(along_x, (ends[0] - ends[1]) / 2e-6, rtol=1e-6, atol=0.0)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#:]+)\)", page.read_text(encoding="utf-8"))
    assert page != README or links
    assert [link for link in links if not (page.parent / link).exists()] == []


@pytest.mark.parametrize("page", [README, ROOT / "docs" / "gallery.md"], ids=lambda page: page.name)
def test_every_example_is_shown_with_its_picture_and_command(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    names = sorted(path.stem for path in (ROOT / "examples").glob("[a-z]*.py"))
    assert len(names) > 10
    assert [name for name in names if f"`python examples/{name}.py`" not in text] == []
    assert [name for name in names if not re.search(rf"\]\(\S*images/{name}\.(png|webp)\)", text)] == []


def test_cited_papers_are_in_the_bibliography() -> None:
    keys = set(re.findall(r"@\w+\{(\w+),", (ROOT / "docs" / "references.bib").read_text(encoding="utf-8")))
    cited = {key for page in PAGES for key in re.findall(r"\[([a-z]+\d{4}[a-z]+)\]", page.read_text(encoding="utf-8"))}
    assert cited
    assert cited <= keys
