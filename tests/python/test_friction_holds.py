"""What friction holds: a jam, a tall stack, a sheet laid over a ball; and a rod that cannot slide smoothly."""

from __future__ import annotations

import math

import pytest
import torch
from energy_rises import rises_of_energy

import diffsim as ds
from diffsim import scenes

DT = 0.01
G = 9.81


def turned(degrees: float) -> tuple[float, float, float, float]:
    """The x axis up by so much."""
    half = 0.5 * math.radians(degrees)
    return (math.cos(half), 0.0, -math.sin(half), 0.0)


def ball_under_a_gable(mu: float, half: float) -> ds.Simulator:
    """It touches two boards that lean on each other, open downwards by 2 `half` [°]."""
    radius = 0.2
    scene = ds.Scene()
    away, angle = radius + 0.051, math.radians(half)
    for side in (-1.0, 1.0):
        place = (side * away * math.cos(angle), 0.0, away * math.sin(angle))
        board = ds.shapes.box((0.1, 1.0, 2.0))
        scene.add_body(board, kind="static", position=place, orientation=turned(side * half), friction=mu)
    scene.add_sphere(radius, density=1000.0, friction=mu)
    return ds.Simulator(scene, DT, on_failure="raise")


def threshold(half: float, push: float) -> float:
    """The least μ that holds a ball pushed up by `push` weights and let go.

    Pushed, it slides, and 2 N (sin + μ cos) = (push - 1) m g. That N stays, and holds it if 2 N (μ cos - sin) > m g.
    """
    return math.tan(math.radians(half)) * push / (push - 2.0)


@pytest.mark.parametrize(("of_threshold", "holds"), [(0.98, False), (1.02, True), (4.0, True)])
def test_a_ball_pushed_into_a_gap_jams_where_it_should(of_threshold: float, holds: bool) -> None:
    half, push, steps = 20.0, 30.0, 20
    mu = of_threshold * threshold(half, push)  # 0.39, and at last 1.56
    sim = ball_under_a_gable(mu, half)
    force = torch.zeros(300, 3, 3, dtype=torch.float64)
    force[:steps, 2, 2] = push * sim.mass[2].detach() * G
    path = sim.rollout(sim.initial_state(), ds.Control(force=force), 300)
    if holds:
        assert (path.position[-1] - path.position[steps]).abs().max() < 1e-9
        assert path.velocity[-1].abs().max() < 1e-9
    else:
        assert path.position[-1, 2, 2] < -1.0


@pytest.mark.parametrize("speed", [-5.0, -1.0, 1.0, 5.0])
@pytest.mark.parametrize("mu", [0.5, 1.5, 3.0])
@pytest.mark.filterwarnings("ignore::diffsim.ConvergenceWarning")
def test_a_rod_that_chatters_is_finite_and_comes_to_lie(mu: float, speed: float) -> None:
    """Painlevé's: with much friction it can neither slide on its tip nor leave the ground. What fails is reported."""
    radius, length = 0.02, 1.0
    scene = ds.Scene()
    scene.add_ground(friction=mu)
    height = 0.5 * length * math.sin(math.radians(63.0)) + radius + 1e-5
    # A capsule's axis is z.
    place = {"orientation": turned(63.0 - 90.0), "position": (0.0, 0.0, height)}
    scene.add_capsule(radius, length, density=1000.0, velocity=(speed, 0.0, 0.0), friction=mu, name="rod", **place)
    sim = ds.Simulator(scene, DT)
    frames = [sim.initial_state()]
    for _ in range(150):
        frames.append(sim(frames[-1]))
        assert sim.info is not None
        assert sim.info.converged or "rod" in str(sim.info.failures)
    path = ds.State.stack(frames)
    assert path.position.isfinite().all()
    assert path.velocity.abs().max() < 1.1 * max(abs(speed), math.sqrt(3.0 * G * length))
    assert path.position[-1, 0, 2] < 1.01 * radius
    assert path.velocity[-1].abs().max() < 1e-9
    assert rises_of_energy(sim, frames) == []


def test_a_sheet_stays_on_a_ball() -> None:
    def draped(mu: float) -> ds.State:
        scene = ds.Scene()
        scene.add_sphere(0.25, kind="static", position=(0.0, 0.0, 0.25), friction=mu)
        material = ds.ClothMaterial.isotropic(young=1e5, thickness=2e-3, density=300.0, poisson=0.3, damping=1e-2)
        scene.add_cloth(ds.shapes.sheet(0.4, 5), material, position=(0.03, 0.0, 0.502), friction=mu)
        sim = ds.Simulator(scene, DT, on_failure="raise")
        return sim.rollout(sim.initial_state(), steps=150)

    path = draped(0.4)
    assert path.node_position[-1, :, 2].min() < 0.42  # it hangs over
    assert path.node_velocity[-1].abs().max() < 1e-9
    assert (path.node_position[-1] - path.node_position[100]).abs().max() < 1e-9
    assert draped(0.0).node_position[-1, :, 2].max() < 0.0


@pytest.mark.slow
def test_a_tall_stack_with_a_heavy_top_stands_still() -> None:
    scene = ds.Scene()
    scene.add_ground(friction=0.5)
    for k in range(20):
        density = 1e6 if k == 19 else 1e3
        scene.add_body(ds.shapes.box(1.0), density=density, position=(0.0, 0.0, 1.001 * k + 0.501), friction=0.5)
    sim = ds.Simulator(scene, DT, on_failure="raise")
    path = sim.rollout(sim.initial_state(), steps=1000)
    assert (path.position[-1] - path.position[100]).abs().max() < 1e-9
    assert path.velocity[-1].abs().max() < 1e-9


def test_a_leaning_stack_stands() -> None:
    """Each offset by a tenth from the one below, this way and that."""
    scene = ds.Scene()
    scene.add_ground(friction=0.5)
    for k in range(10):
        place = (0.05 * (-1.0) ** k, 0.0, 1.001 * k + 0.501)
        scene.add_body(ds.shapes.box(1.0), density=1000.0, position=place, friction=0.5)
    sim = ds.Simulator(scene, DT, on_failure="raise")
    path = sim.rollout(sim.initial_state(), steps=300)
    assert (path.position[-1] - path.position[100]).abs().max() < 1e-9
    assert path.velocity[-1].abs().max() < 1e-9


# ---- how it is solved ------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::diffsim.ConvergenceWarning")
def test_cards_that_slide_apart_on_their_edges_are_mostly_solved() -> None:
    """Thin enough that a contact's normal turns by much while the cards slip: without that 33 of these steps fail."""
    length, thick, lean = 1.0, 0.02, math.radians(25.0)
    across = length * math.sin(lean) + thick * math.cos(lean)  # of one card
    height = length * math.cos(lean) + thick * math.sin(lean)
    failed = 0
    for mu in (0.05, 0.1, 0.2):
        scene = ds.Scene()
        scene.add_ground(friction=mu)
        for side in (-1.0, 1.0):
            scene.add_body(
                ds.shapes.box((thick, 0.6, length)),
                density=1000.0,
                position=(side * 0.5 * (across + 0.002), 0.0, 0.5 * height + 1.5e-3),
                orientation=(math.cos(0.5 * lean), 0.0, -side * math.sin(0.5 * lean), 0.0),
                friction=mu,
            )
        sim = ds.Simulator(scene, DT, on_failure="warn")
        end = sim.rollout(sim.initial_state(), steps=60)[-1]
        assert end.position[1, 0] - end.position[0, 0] > across + 0.01  # they have slid
        failed += sim.info.failed_steps
    assert failed <= 5


def test_what_rests_takes_no_iteration() -> None:
    scene = ds.Scene()
    scene.add_ground(friction=0.5)
    scene.add_body(ds.shapes.box((1.0, 1.0, 1.0)), density=1000.0, position=(0.0, 0.0, 0.52), friction=0.5)
    sim = ds.Simulator(scene, DT, on_failure="raise")
    state = sim.rollout(sim.initial_state(), steps=40)[-1]
    after = sim(state)
    assert sim.info.iterations == 0
    assert sim.info.sticking == 4
    assert after.velocity.abs().max() == 0.0


@pytest.mark.parametrize("scene", [scenes.boxes_in_bin(20), scenes.two_layer_stack(6)], ids=["bin", "layers"])
def test_what_leans_on_each_other_rests_without_an_iteration(scene: ds.Scene) -> None:
    """What friction holds them by no state tells: it is found for all of them together, where they are."""
    sim = ds.Simulator(scene, DT, on_failure="raise")
    with torch.no_grad():
        sim.friction.fill_(0.5)
    state = sim.rollout(sim.initial_state(), steps=400)[-1]
    contacts = sim.contacts(state)
    across = contacts.friction.norm(dim=1)
    assert across.max() > 1e-2 * contacts.normal_force.norm(dim=1).max()
    assert (across <= 0.5 * contacts.normal_force.norm(dim=1) * (1.0 + 1e-9)).all()
    assert contacts.sticking.all()
    weight = -sim.mass.detach()[:, None] * sim.gravity.detach()
    free = sim.mass.detach() > 0.0
    torch.testing.assert_close(contacts.net_force()[free], weight[free], rtol=0.0, atol=1e-7 * float(weight.max()))
    after = sim.rollout(state, steps=50)
    assert sim.info.iterations == 0
    for name in ("position", "orientation"):
        assert torch.equal(getattr(after[-1], name), getattr(state, name)), name
    assert after[-1].velocity.abs().max() < 1e-16


@pytest.mark.parametrize("friction", [0.5, 1.0])
def test_bricks_that_land_flush_on_each_other_converge(friction: float) -> None:
    """Many contacts come to push in one step: with springs as stiff at first as near the balance models crawl, and take
    factorizations by the ten thousands.
    """
    scene = ds.Scene()
    scene.add_ground(friction=friction)
    for row in range(5):
        for k in range(5):
            position = ((k + 0.5 * (row % 2)) * 0.202, 0.0, 0.05 + 0.1 * row + 1e-3 * (row + 1))
            scene.add_body(ds.shapes.box((0.2, 0.1, 0.1)), density=500.0, position=position, friction=friction)
    sim = ds.Simulator(scene, DT, on_failure="raise")
    end = sim.rollout(sim.initial_state(), steps=10)[-1]
    assert end.velocity.abs().max() < 0.1  # [m/s], those that overhang by half of their length


@pytest.mark.parametrize("count", [12, 20])
def test_layers_of_cubes_come_to_rest_in_few_models(count: int) -> None:
    """Only slips of what sticks are left: with springs as soft as elsewhere 12 take 15 models, and 20 keep 2e-9 m/s."""
    sim = ds.Simulator(scenes.two_layer_stack(count), DT)
    with torch.no_grad():
        sim.friction.fill_(0.5)
        end = sim.rollout(sim.initial_state(), steps=29)[-1]
        end = sim(end)
    assert end.velocity.abs().max() < 1e-13
    assert sim.info.iterations <= 10
