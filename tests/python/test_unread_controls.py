"""Controls that nothing would read are refused where they are not zero, by name and with the mend."""

from typing import Any

import pytest
import torch
from torch.func import vmap

import diffsim as ds

NAMES = ("floor", "belt", "box")
KINDS = ("static", "kinematic", "dynamic")


def make_sim() -> ds.Simulator:
    scene = ds.Scene()
    for k, (name, kind) in enumerate(zip(NAMES, KINDS)):
        mass = {"density": 1e3} if kind == "dynamic" else {}
        scene.add_body(ds.shapes.box(1.0), kind=kind, position=(3 * k, 0, 5), name=name, **mass)
    scene.add_cloth(ds.shapes.sheet(1.0, 3), pinned=[0, 2], position=(0, 5, 5), name="flag")
    scene.add_cloth(ds.shapes.sheet(1.0, 3), position=(0, 9, 5), name="sail")
    return ds.Simulator(scene, dt=0.01)


def at(row: int, rows: int = 3) -> torch.Tensor:
    value = torch.zeros(rows, 3, dtype=torch.float64)
    value[row, 1] = 0.5
    return value


REFUSED: list[tuple[str, int, int, str]] = [
    (
        "force",
        0,
        3,
        r"control.force of body 'floor' \(index 0\) must be zero, because the body is static, got \(0 0.5 0\)",
    ),
    ("force", 1, 3, "control.force of body 'belt' .* the body is kinematic, .* only a body of kind='dynamic'"),
    ("torque", 0, 3, "control.torque of body 'floor'"),
    ("torque", 1, 3, "control.torque of body 'belt'"),
    ("body_velocity", 0, 3, "control.body_velocity of body 'floor' .* static, .* only a body of kind='kinematic'"),
    ("body_velocity", 2, 3, "control.body_velocity of body 'box' .* dynamic, .* is given to the state"),
    ("body_angular_velocity", 2, 3, "control.body_angular_velocity of body 'box'"),
    (
        "node_velocity",
        1,
        18,
        r"control.node_velocity of node 1 of cloth 'flag' \(index 1\) .* not pinned, .* pinned=",
    ),
    ("node_velocity", 9, 18, r"control.node_velocity of node 0 of cloth 'sail' \(index 9\) must be zero"),
]


@pytest.mark.parametrize(("field", "row", "rows", "text"), REFUSED)
def test_what_nothing_reads_is_refused(field: str, row: int, rows: int, text: str) -> None:
    sim, control = make_sim(), ds.Control(**{field: at(row, rows)})
    state = sim.initial_state()
    for use in (lambda: sim(state, control), lambda: sim.rollout(state, control, 2)):
        with pytest.raises(ValueError, match=text):
            use()


def test_what_is_read_or_zero_is_taken() -> None:
    sim = make_sim()
    state = sim.initial_state()
    control = ds.Control(
        force=at(2), torque=at(2), body_velocity=at(1), body_angular_velocity=at(1), node_velocity=at(2, 18)
    )
    end = sim(state, control)
    assert end.velocity[2, 1] > 0.0
    assert end.velocity[1, 1] == 0.5
    assert end.node_velocity[2, 1] == pytest.approx(0.5)
    sim(state, ds.Control(node_force=torch.ones(18, 3, dtype=torch.float64)))  # of pins, too: what holds them takes it


def test_the_refusal_tells_the_step_and_the_scene() -> None:
    sim = make_sim()
    force = torch.zeros(4, 2, 3, 3, dtype=torch.float64)
    force[3, 1, 0] = 1.0
    with pytest.raises(ValueError, match=r"'floor'.*, in (step 3.*scene 1|scene 1.*step 3)"):
        sim.rollout(sim.initial_state(batch=2), ds.Control(force=force), 4)
    with pytest.raises(ValueError, match="'floor'"):
        vmap(lambda f: sim(sim.initial_state(), ds.Control(force=f)).position)(force[3])


def test_gradcheck_moves_only_what_is_read() -> None:
    sim = make_sim()
    zeros, nodes = torch.zeros(3, 3, dtype=torch.float64), torch.zeros(18, 3, dtype=torch.float64)
    control: Any = ds.Control(zeros, zeros, nodes, zeros, zeros, nodes)
    names = ["force", "torque", "body_velocity", "body_angular_velocity", "node_drive"]
    report = ds.diagnostics.gradcheck(sim, sim.initial_state(), control, wrt=names, directions=1)
    assert report.passed, str(report)
    assert not report.zero_gradients
