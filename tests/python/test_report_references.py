"""The closed forms that benchmarks/work_precision.py holds simulators against."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
import torch

import diffsim as ds

for package in ("matplotlib", "mujoco", "scipy"):
    pytest.importorskip(package, reason="the benchmarks' packages: pip install .[bench]")

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
from _report_motion import mujoco_bodies  # noqa: E402
from _report_page import Panel, verdict  # noqa: E402
from _report_scenes import SCENES, two_balls  # noqa: E402


def test_the_tumbling_brick_is_that_of_a_fourth_order_method() -> None:
    brick = next(case for case in SCENES if case.name == "brick")
    motion = mujoco_bodies("RK4").prepare(brick.build(), 0.01, 4.0).motion()
    assert float(ds.rotation.to_matrix(motion.states.orientation[-1])[0, 1, 1]) < 0.0  # it turns over
    for error in brick.errors.values():
        assert error(motion, None) < 1e-7


def test_an_oblique_impact_keeps_momentum_and_stops_the_approach() -> None:
    position = torch.tensor([[0.0, 0.0, 0.0], [0.4, 0.1, 0.0]], dtype=torch.float64)
    velocity = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)
    mass = torch.tensor([1.0, 2.0], dtype=torch.float64)
    early, late = (two_balls(position, velocity, mass, time) for time in (0.5, 0.6))
    after = (late - early) / 0.1
    assert torch.allclose(mass @ after, mass @ velocity)
    impact = 0.4 - 0.03**0.5  # when their centres are 0.2 m apart, 0.1 m of it sideways
    normal = two_balls(position, velocity, mass, impact) @ torch.eye(3, dtype=torch.float64)
    normal = (normal[1] - normal[0]) / 0.2
    assert float(normal.norm()) == pytest.approx(1.0, rel=1e-12)
    assert float((after[1] - after[0]) @ normal) == pytest.approx(0.0, abs=1e-12)
    assert float(after[1, 1]) > 0.1  # it was struck from below


def test_a_peer_that_is_better_is_named_with_the_number() -> None:
    ours = ([1.0, 2.0], [1e-2, 1e-3])
    for peer, words in (
        (([0.5, 1.0], [1e-2, 1e-3]), "as exact as ours in 1/2.0 of the time"),
        (([4.0], [1e-5]), "goes on to smaller errors"),
        (([4.0], [1e-3]), "ours is left of and below peer"),
        (([0.1], [1e-1]), "peer (never as exact)"),
    ):
        assert words in verdict(Panel("x", "y", {"ours": ours, "peer": peer}, frozenset({"ours"})))
