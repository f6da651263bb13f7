"""Where friction has no balance, or none is found: what a step that failed leaves behind."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

import diffsim as ds

DT = 0.01
pytestmark = pytest.mark.filterwarnings("ignore::diffsim.ConvergenceWarning")
STATES = Path(__file__).parent / "states"


def walled_in(index: int, state: dict[str, list[float]]) -> tuple[ds.Simulator, ds.State, ds.Control]:
    """Ten bodies between four walls, of a scene of the fuzz; their friction is 0 to 1.5."""
    fuzz = importlib.import_module("fuzz")
    seed = 5
    sim = ds.Simulator(fuzz.random_scene(seed, index, bodies=10), DT)
    friction = np.random.default_rng([seed, index, 1]).uniform(0.0, 1.5, size=sim.friction.shape)
    sim.friction.copy_(torch.from_numpy(friction))
    fields = {name: torch.tensor(value, dtype=torch.float64) for name, value in state.items()}
    generator = torch.Generator().manual_seed(index)
    force = 0.5 * sim.mass[:, None] * torch.randn(*fields["velocity"].shape, generator=generator, dtype=torch.float64)
    return sim, ds.State(**fields), ds.Control(force=force)


def test_a_step_that_fails_leaves_a_state_from_which_the_next_recover(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is that of its models in which least was left of the balance; the last one's is squeezed by half the
    thickness. A body moves here as it is told, and jams others: not every step has a balance.
    """
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent))
    sim, state, control = walled_in(99, json.loads((STATES / "jam.json").read_text()))
    with torch.no_grad():
        for _ in range(8):
            state = sim(state, control)
            if any(failure.status == "crawls" for failure in sim.info.failures):
                break
        else:
            pytest.fail("every step has a balance")
        assert sim.info.max_compression < 0.1 * sim.thickness
        sim(state, control)
    assert sim.info.converged


@pytest.mark.parametrize("index", [47, 68, 75])
def test_hits_whose_models_lead_past_each_other_converge(monkeypatch: pytest.MonkeyPatch, index: int) -> None:
    """Of the whole load at once no model leads to the next: each of these steps failed so."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent.parent))
    sim, state, control = walled_in(index, json.loads((STATES / "hits.json").read_text())[str(index)])
    with torch.no_grad():
        sim(state, control)
    assert sim.info.converged, sim.info


MU = 0.6
BRICK, DOMINO = (0.1, 0.05, 0.05), (0.01, 0.03, 0.06)


def hit_wall() -> ds.Simulator:
    """A wall of bricks in courses, and a ball that was thrown at it."""
    scene = ds.Scene()
    scene.add_ground(friction=MU)
    for course in range(5):
        for k in range(5 - course % 2):
            position = ((k + 0.5 * (course % 2)) * 0.102, 0.0, 0.0251 + 0.0502 * course)
            scene.add_body(ds.shapes.box(BRICK), density=600.0, friction=MU, position=position)
    scene.add_sphere(0.04, density=7000.0, friction=MU, position=(0.2, -0.5, 0.12))
    return ds.Simulator(scene, DT)


def leaning_dominoes() -> ds.Simulator:
    """A row that a ball has set off, most of it lying on what lies on the ground."""
    scene = ds.Scene()
    scene.add_ground(friction=MU)
    for k in range(20):
        scene.add_body(ds.shapes.box(DOMINO), density=600.0, friction=MU, position=(0.03 * k, 0.0, 0.03001))
    scene.add_sphere(0.01, density=3000.0, friction=MU, position=(-0.05, 0.0, 0.05))
    return ds.Simulator(scene, 0.5 * DT)


@pytest.mark.parametrize(("name", "make"), [("wall", hit_wall), ("dominoes", leaning_dominoes)])
def test_hits_of_much_that_lies_flush_converge_in_rounds(name: str, make: Callable[[], ds.Simulator]) -> None:
    """Models of bounds that follow lead to and fro between what sticks and what slips, each through hundreds of
    factorizations, and a load in parts is no help: without rounds both steps fail.
    """
    fields = json.loads((STATES / "rounds.json").read_text())[name]
    start = ds.State(**{key: torch.tensor(value, dtype=torch.float64) for key, value in fields.items()})
    sim = make()
    with torch.no_grad():
        end = sim(start)
    assert sim.info.converged, sim.info
    assert sim.info.slipping > 0
    assert sim.info.sticking > 0
    assert sim.kinetic_energy(end) + sim.potential_energy(end) < sim.kinetic_energy(start) + sim.potential_energy(start)


def test_a_cube_that_a_ball_jams_into_the_ground_is_reported_and_set_free() -> None:
    """At 1.2 the ground holds whatever a ball pushes at 45 degrees: each step that drives it on has no balance."""
    scene = ds.Scene()
    scene.add_ground(friction=1.2)
    cube = scene.add_body(ds.shapes.box(0.2), density=500.0, position=(0.0, 0.0, 0.1), friction=1.2, name="cube")
    ball = scene.add_sphere(0.3, kind="kinematic", position=(-0.42, 0.0, 0.25), friction=1.2, name="ball")
    sim = ds.Simulator(scene, DT)
    state = sim.initial_state()
    velocity = torch.zeros(2, 3, dtype=torch.float64)
    velocity[ball, 0] = 0.4
    jammed = []
    with torch.no_grad():
        for _ in range(15):
            state = sim(state, ds.Control(body_velocity=velocity))
            jammed += sim.info.failures
        assert len(jammed) >= 5
        assert all("cube" in failure.bodies for failure in jammed)
        assert any(failure.status == "crawls" for failure in jammed)
        velocity[ball, 0] = -0.4
        for _ in range(20):  # it was tipped, and falls back
            state = sim(state, ds.Control(body_velocity=velocity))
            assert sim.info.converged
    assert state.velocity[cube].abs().max() < 1e-8
