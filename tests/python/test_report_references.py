"""The closed forms that benchmarks/work_precision.py holds simulators against."""

from __future__ import annotations

import math
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

for package in ("matplotlib", "mujoco", "scipy"):
    pytest.importorskip(package, reason="the benchmarks' packages: pip install .[bench]")

sys.path.append(str(Path(__file__).resolve().parents[2] / "benchmarks"))
from _mujoco import Settings, contact_attributes  # noqa: E402
from _report_free import FREE  # noqa: E402
from _report_friction import FRICTION, PEERS, bowled, top_axis  # noqa: E402
from _report_gradients import CONTACT_GRADIENTS, Inputs, relative  # noqa: E402
from _report_impacts import two_balls  # noqa: E402
from _report_motion import SECOND_ORDER, ValueScene, mujoco_bodies  # noqa: E402
from _report_page import Panel, verdict  # noqa: E402
from work_precision import SCENES, Report, section_of_values  # noqa: E402


def scene_of(table: tuple[ValueScene, ...], name: str) -> ValueScene:
    return next(case for case in table if case.name == name)


@pytest.mark.parametrize("name", ["brick", "coin"])
def test_free_spin_is_that_of_a_fourth_order_method(name: str) -> None:
    case = scene_of(FREE, name)
    motion = mujoco_bodies(Settings("RK4")).prepare(case.build(), 0.0025, case.duration).motion()
    assert float((motion.states.angular_velocity[-1] - motion.start.angular_velocity).norm()) > 0.1
    assert float((motion.states.orientation[-1] - motion.start.orientation).norm()) > 0.1
    for error in case.errors.values():
        assert error(motion, None) < 1e-7


@pytest.mark.parametrize("name", ["slide", "incline", "rolling", "bowling"])
def test_with_friction_our_second_order_steps_go_to_the_closed_forms(name: str) -> None:
    case = scene_of(FRICTION, name)
    errors = []
    for dt in (0.01, 0.0025):
        motion = SECOND_ORDER.prepare(case.build(), dt, case.duration).motion()
        assert float((motion.states.position[-1] - motion.start.position).norm()) > 0.1
        errors.append([error(motion, None) for error in case.errors.values()])
    assert max(errors[1]) < 2e-5
    assert errors[1][0] < 0.5 * errors[0][0]


def test_a_thrown_ball_rolls_on_without_slip() -> None:
    """What the closed form says of where it is says how fast it is, too."""
    start = [torch.tensor(v, dtype=torch.float64) for v in ((0.0, 0.0, 0.5), (2.0, 1.0, -1.0), (3.0, -4.0, 0.0))]
    at = [bowled(*start, 0.1, time)[:2] for time in (2.0, 2.1)]
    spin = start[2][:2].flip(0) * torch.tensor([1.0, -1.0])  # rolling with v it is v over the radius
    speed = (at[1] - at[0]) / 0.1
    # Friction acts at the lowest point: about that it leaves the angular momentum.
    torch.testing.assert_close(speed, 5.0 / 7.0 * start[1][:2] + 2.0 / 7.0 * 0.1 * spin, rtol=1e-12, atol=1e-12)


def test_a_fast_top_precesses_as_gyroscopes_do() -> None:
    start = np.array([math.sin(0.3), 0.0, math.cos(0.3)])
    axis = top_axis(start, 1000.0, (0.003, 0.002), 0.3, 1.0)
    assert axis[2] == pytest.approx(start[2], abs=1e-4)
    assert math.atan2(axis[1], axis[0]) == pytest.approx(0.3 / (0.002 * 1000.0), rel=0.01)


def test_a_peer_is_given_one_coefficient_of_friction_or_none() -> None:
    assert contact_attributes(np.zeros(3)) == 'condim="1"'
    assert contact_attributes(np.full(3, 0.5)) == 'condim="3" friction="0.5 0 0"'
    with pytest.raises(ValueError, match="all objects must have the same coefficient"):
        contact_attributes(np.array([0.5, 0.4]))
    assert len({settings.name for settings in PEERS}) == len(PEERS)


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


def test_an_error_of_the_derivative_to_a_stiffness_counts_whatever_its_unit() -> None:
    case = next(case for case in CONTACT_GRADIENTS if case.name == "sphere_on_cloth")
    inputs = Inputs(case, case.steps[0])
    right = inputs.adjoint()
    without = np.where([name == "cloth_stretch" for name, _ in case.inputs], 0.0, right)
    assert 1e-2 < relative(without, right, inputs.sizes) < 1.0
    assert relative(without, right, np.ones(len(right))) < 1e-4  # in newtons per metre it is next to nothing


def test_a_peer_that_is_better_is_named_with_the_number() -> None:
    ours = ([1.0, 2.0], [1e-2, 1e-3])
    for peer, words in (
        (([0.5, 1.0], [1e-2, 1e-3]), "as exact as ours in 1/2.0 of the time"),
        (([4.0], [1e-5]), "goes on to smaller errors"),
        (([4.0], [1e-3]), "ours is left of and below peer"),
        (([0.1], [1e-1]), "peer (never as exact)"),
    ):
        assert words in verdict(Panel("x", "y", {"ours": ours, "peer": peer}, frozenset({"ours"})))


def test_scenes_have_names_of_their_own_and_labels_that_csv_can_hold() -> None:
    assert len({case.name for case in SCENES}) == len(SCENES)
    for case in SCENES:
        assert case.errors
        assert not [text for text in (*case.errors, *(method.name for method in case.methods)) if "," in text]


def test_a_report_keeps_what_an_earlier_run_said_of_other_scenes(tmp_path: Path) -> None:
    brick, coin = (scene_of(FREE, name) for name in ("brick", "coin"))
    earlier = Report("then")
    for case in (brick, coin):
        row = {"scene": case.name, "dt_s": 0.5}
        for label in case.errors:
            earlier.add({**row, "what": label, "name": "diffsim", "time_ms": 2.0, "error": 0.1})
        earlier.add({**row, "what": label, "name": "MuJoCo RK4", "failure": "blew up"})
    earlier.write(tmp_path / "out" / "report.csv")
    report = Report("now")
    report.keep(tmp_path / "out" / "report.csv", ["brick"])
    assert section_of_values(brick, report) is None
    section = section_of_values(coin, report)
    assert section is not None
    assert section.text[0].endswith("Run then; dt = 0.5 s.")
    assert section.text[-1] == "No end at dt = 0.5 s: MuJoCo RK4 (blew up)."
    assert [panel.curves for panel in section.panels] == [{"diffsim": ([2.0], [0.1])}] * 2
