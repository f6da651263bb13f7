"""What a scene's steps consist of, in words: the `repr` of a simulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ._packed import PackedScene


def description(name: str, packed: PackedScene, settings: Mapping[str, Any]) -> str:
    runs, left_out = stages(packed)
    body_count, node_count, cloth_count = len(packed.names), len(packed.node_rest), len(packed.cloth_names)
    contents = f"{body_count} " + ("body" if body_count == 1 else "bodies")
    if cloth_count:
        contents += f", {cloth_count} {'cloth' if cloth_count == 1 else 'cloths'} of {node_count} nodes"
    listed = ", ".join(f"{key}={value!r}" for key, value in settings.items())
    return (
        f"{name}({contents}, thickness={packed.thickness:g}, {listed})\n"
        f"  runs: {', '.join(runs) or 'nothing'}\n"
        f"  leaves out: {', '.join(left_out) or 'nothing'}"
    )


def stages(packed: PackedScene) -> tuple[list[str], list[str]]:
    """Names of the stages of a step that a scene runs, and of those it leaves out, with the reason."""
    count = np.bincount(packed.kind, minlength=3)
    n, dynamic, kinematic = len(packed.names), int(count[0]), int(count[2])
    has_cloth = bool(packed.cloth_names)
    runs: list[str] = []
    left_out: list[str] = []

    def stage(name: str, reason_against: str | None) -> None:
        runs.append(name) if reason_against is None else left_out.append(f"{name} ({reason_against})")

    none_moves = None if dynamic else "no dynamic body"
    stage("free motion", none_moves)
    stage("kinematic motion", None if kinematic else "no kinematic body")
    nothing_moves = None if has_cloth else none_moves
    stage("ground contact", nothing_moves if packed.has_ground else "no ground")
    stage("body-body contact", none_moves or (None if n > 1 else "one body"))
    rubs = packed.friction > 0.0
    folds = bool(rubs[n : n + len(packed.cloth_names)].any())  # and may touch itself
    stage("friction", nothing_moves or (None if folds or rubs.sum() > 1 else "no two objects with friction"))
    stage("restitution", "not in this version")
    no_cloth = None if has_cloth else "no cloth"
    stage("cloth", no_cloth)
    stage("cloth contact", no_cloth)
    return runs, left_out
