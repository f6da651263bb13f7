"""The work-precision report as pages: Markdown and HTML from one list of sections, plots as SVG."""

from __future__ import annotations

import datetime
import html
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from _common import draw_curves, installed_version, processor, save_plot

FLOOR = 1e-14  # errors below are drawn there
ALONE = 1.5  # load of a machine on which nothing else runs, at most
Curves = Mapping[str, tuple[Sequence[float], Sequence[float]]]


@dataclass
class Panel:
    """Curves over one axis, of which some are ours."""

    xlabel: str
    ylabel: str
    curves: Curves
    ours: frozenset[str] = frozenset()


@dataclass
class Section:
    name: str
    title: str
    text: list[str]
    panels: list[Panel] = field(default_factory=list)
    tables: list[Mapping[str, Any]] = field(default_factory=list)  # of columns and rows


# ---- plots and what they say -----------------------------------------------------------------------------------------


def draw(section: Section, figure: Any) -> None:
    rows = math.ceil(len(section.panels) / 2)
    grid = list(figure.subplots(rows, min(2, len(section.panels)), squeeze=False).flat)
    for axes, panel in zip(grid, section.panels):
        curves = {name: (x, [max(v, FLOOR) for v in y]) for name, (x, y) in panel.curves.items()}
        draw_curves(axes, curves, panel.xlabel, panel.ylabel)
        axes.tick_params(axis="x", which="minor", labelsize=6, labelrotation=45)  # there may be no power of ten
    for axes in grid[len(section.panels) :]:
        axes.set_axis_off()


def plot(section: Section, folder: Path) -> str:
    name = f"{section.name}.svg"
    rows = math.ceil(len(section.panels) / 2)
    save_plot(folder / name, lambda figure: draw(section, figure), (10.2, 5.2 * rows))
    return name


def verdict(panel: Panel) -> str:
    """Whether our curves are left of and below each peer's, and the number where they are not."""
    ours = [point for name in panel.ours for point in zip(*panel.curves.get(name, ((), ())))]
    ours = [(t, e) for t, e in ours if not any(a < t and b <= e for a, b in ours)]  # the best of each error
    behind, ahead = [], []
    for name, (x, y) in panel.curves.items():
        if name in panel.ours or not ours or not len(x):
            continue
        least = [(t, min((a for a, b in zip(x, y) if b <= max(e, FLOOR)), default=math.inf)) for t, e in ours]
        worst = max(t / peer for t, peer in least)
        finer = min(y) < 0.99 * min(e for _, e in ours)
        if worst <= 1.0 and not finer:
            ahead.append(f"{name} (never as exact)" if math.isinf(min(peer for _, peer in least)) else name)
            continue
        digits = 1 if worst > 1.1 else 3
        texts = [f"as exact as ours in 1/{worst:.{digits}f} of the time"] if worst > 1.0 else []
        texts += ["goes on to smaller errors than ours"] if finer else []
        behind.append(f"{name} ({', '.join(texts)})")
    where = f"*{panel.ylabel}*"
    if not behind and not ahead:
        return f"{where}: no peer has a curve here."
    texts = [f"**a peer is better somewhere**: {'; '.join(behind)}"] if behind else []
    texts += [f"ours is left of and below {'; '.join(ahead)}"] if ahead else []
    return f"{where}: {'. '.join(texts)}."


# ---- pages -----------------------------------------------------------------------------------------------------------


def machine(note: str, packages: Sequence[str]) -> list[str]:
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0
    versions = [f"Python {platform.python_version()}", *(f"{name} {installed_version(name)}" for name in packages)]
    shared = f"**Other work ran on the machine at the same time** (load {load:.1f} at the end): it makes times longer."
    return [
        f"{datetime.date.today().isoformat()}; {processor()}, {os.cpu_count()} cores, {platform.system()}.",
        ", ".join(versions) + ".",
        "Times are on the processor, one thread, medians; ratios within this run hold, digits do not.",
        *([shared] if load > ALONE else []),
        *([note] if note else []),
    ]


def markdown(title: str, sections: Sequence[Section], plots: Mapping[str, str]) -> str:
    lines = [f"# {title}", ""]
    for section in sections:
        lines += [f"## {section.title}", ""]
        for text in section.text:
            lines += [text, ""]
        if section.name in plots:
            lines += [f"![{section.title}]({plots[section.name]})", ""]
        for table in section.tables:
            lines += ["| " + " | ".join(table["columns"]) + " |", "|" + "---|" * len(table["columns"])]
            lines += ["| " + " | ".join(cell(value) for value in row) + " |" for row in table["rows"]] + [""]
    return "\n".join(lines)


def page(title: str, sections: Sequence[Section], plots: Mapping[str, str]) -> str:
    body = [f"<h1>{html.escape(title)}</h1>"]
    for section in sections:
        body.append(f'<h2 id="{section.name}">{html.escape(section.title)}</h2>')
        body += [f"<p>{_inline(text)}</p>" for text in section.text]
        if section.name in plots:
            body.append(f'<img src="{plots[section.name]}" alt="{html.escape(section.title)}">')
        for table in section.tables:
            head = "".join(f"<th>{html.escape(name)}</th>" for name in table["columns"])
            rows = ["".join(f"<td>{_inline(cell(value))}</td>" for value in row) for row in table["rows"]]
            body.append(f"<table><tr>{head}</tr>{''.join(f'<tr>{row}</tr>' for row in rows)}</table>")
    style = (
        "body{font:15px/1.5 sans-serif;max-width:62em;margin:2em auto;padding:0 1em}img{max-width:100%}"
        "table{border-collapse:collapse}td,th{border:1px solid #ccc;padding:.2em .6em;text-align:left}"
    )
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{style}</style></head>\n<body>\n" + "\n".join(body) + "\n</body></html>\n"
    )


def cell(value: object) -> str:
    return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def _inline(text: str) -> str:
    """Bold and italics of Markdown."""
    text = html.escape(text)
    for mark, tag in (("**", "b"), ("*", "i"), ("`", "code")):
        parts = text.split(mark)
        text = parts[0] + "".join(f"<{'' if i % 2 else '/'}{tag}>{part}" for i, part in enumerate(parts[1:], 1))
    return text


def write(folder: Path, title: str, sections: Sequence[Section]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    plots = {section.name: plot(section, folder) for section in sections if section.panels}
    (folder / "index.md").write_text(markdown(title, sections, plots), encoding="utf-8")
    (folder / "index.html").write_text(page(title, sections, plots), encoding="utf-8")
