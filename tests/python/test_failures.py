"""Who failed: the records of steps that did not converge."""

from __future__ import annotations

import copy
import pickle
import warnings

import pytest
import torch
from test_robustness import PRESS, driven, squeeze

import diffsim as ds
from diffsim import scenes


def squeezes(speeds: list[float]) -> ds.Control:
    velocity = torch.stack([driven(speed).body_velocity for speed in speeds])  # type: ignore[misc]
    return ds.Control(body_velocity=velocity)


def test_all_converged() -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    for batch, shape in ((None, ()), (1, (1,)), (3, (3,))):
        sim.rollout(sim.initial_state(batch), None, 2)
        assert sim.info is not None
        assert sim.info.failures == []
        assert sim.info.scenes_converged.dtype is torch.bool
        assert sim.info.scenes_converged.shape == shape
        assert bool(sim.info.scenes_converged.all())


def test_a_squeeze_names_scene_step_and_what_is_squeezed() -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    with pytest.warns(ds.ConvergenceWarning, match=r"step 9 of scene 1: 'cube', 'press'"):
        sim.rollout(sim.initial_state(batch=3), squeezes([0.0, -0.5, 0.0]), 14)
    info = sim.info
    assert info is not None
    assert info.scenes_converged.tolist() == [True, False, True]
    assert info.failed_steps == len(info.failures) == 5
    assert [f.step for f in info.failures] == [9, 10, 11, 12, 13]
    for failure in info.failures:
        assert failure.scene == 1
        assert failure.bodies == ("cube", "press")
        assert failure.status == "blocked"
        assert "squeezed" in failure.reason
    assert info.failure == info.failures[0].reason
    # The failed step is the one that is taken from the state after `step` steps.
    trajectory = sim.rollout(sim.initial_state(), PRESS, 14)
    sim(trajectory[8 - 1], PRESS)
    assert sim.info.converged
    sim(trajectory[9 - 1], PRESS)
    assert not sim.info.converged
    assert sim.info.scenes_converged.shape == ()
    assert [(f.scene, f.step) for f in sim.info.failures] == [(0, 0)]


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0)], ids=["into", "along"])
def test_a_kinematic_body_stops_at_a_static_one_in_its_way(direction: tuple[float, float, float]) -> None:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((0.2, 0.2, 0.2)), kind="static", name="wall")
    scene.add_body(
        ds.shapes.box((0.2, 0.2, 0.2)),
        kind="kinematic",
        position=(-0.225, 0.0, 0.0),
        velocity=direction,
        name="ram",
    )
    scene.add_sphere(0.05, density=500.0, position=(0.0, 0.0, 2.0), name="bystander")
    sim = ds.Simulator(scene, dt=0.01)
    state, blocked = sim.initial_state(), []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ds.ConvergenceWarning)
        for k in range(6):
            state = sim(state, ds.Control(body_velocity=state.velocity.new_tensor([[0.0] * 3, direction, [0.0] * 3])))
            assert sim.info is not None
            if not sim.info.converged:
                blocked.append(k)
                assert sim.info.failures[0].status == "blocked"
                assert sim.info.failures[0].bodies == ("wall", "ram")
    gap = -0.2 - float(state.position[1, 0])
    if direction[0] == 0.0:
        assert blocked == [] and gap == pytest.approx(0.025)
    else:
        assert blocked == [2, 3, 4, 5]
        assert 0.0 < gap < 0.001


def test_a_kinematic_body_built_into_a_static_one_moves_on() -> None:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((0.2, 0.2, 0.2)), kind="static", name="bearing")
    scene.add_body(ds.shapes.box((1.0, 0.05, 0.05)), kind="kinematic", velocity=(1.0, 0.0, 0.0), name="shaft")
    sim = ds.Simulator(scene, dt=0.01)
    end = sim.rollout(sim.initial_state(), steps=20)[-1]
    assert sim.info is not None and sim.info.converged
    assert float(end.position[1, 0]) == pytest.approx(0.2)


def test_a_squeeze_between_others_names_what_takes_part_and_no_one_else() -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box((2, 2, 0.2)), kind="static", position=(0, 0, 0.1), name="table")
    scene.add_body(ds.shapes.box(0.2), density=1000.0, position=(0.0, 0, 0.301), name="held")
    scene.add_body(ds.shapes.box(0.2), density=1000.0, position=(0.0, 0, 0.502), name="held too")
    scene.add_body(ds.shapes.box(0.2), density=1000.0, position=(0.7, 0, 0.301), name="beside")
    scene.add_body(ds.shapes.box((0.4, 0.4, 0.1)), kind="kinematic", position=(0, 0, 0.67), name="press")
    scene.add_body(ds.shapes.box(0.2), kind="kinematic", position=(-0.7, 0, 2.0), name="elsewhere")
    sim = ds.Simulator(scene, dt=0.01)
    control = ds.Control(body_velocity=torch.zeros(6, 3, dtype=torch.float64))
    assert control.body_velocity is not None
    control.body_velocity[4, 2] = -0.5
    with pytest.warns(ds.ConvergenceWarning):
        sim.rollout(sim.initial_state(), control, 30)
    assert sim.info is not None
    assert sim.info.failures
    assert {f.bodies for f in sim.info.failures} == {("table", "held", "held too", "press")}


def test_the_records_do_not_depend_on_threads_and_segments() -> None:
    found = []
    for num_threads, every in ((1, None), (2, None), (2, 4)):
        sim = ds.Simulator(squeeze(), dt=0.01, num_threads=num_threads)
        with pytest.warns(ds.ConvergenceWarning):
            sim.rollout(sim.initial_state(batch=3), squeezes([-0.5, 0.0, -0.7]), 14, checkpoint_every=every)
        assert sim.info is not None
        found.append(sim.info.failures)
        assert sim.info.scenes_converged.tolist() == [False, True, False]
    assert found[0] == found[1] == found[2]
    assert found[0] == sorted(found[0], key=lambda f: (f.step, f.scene))


def test_long_lists_are_cut_and_say_so() -> None:
    for every in (None, 20):
        sim = ds.Simulator(squeeze(), dt=0.01)
        with pytest.warns(ds.ConvergenceWarning, match="of which the first 256 are listed"):
            sim.rollout(sim.initial_state(batch=5), squeezes([-0.5] * 5), 80, checkpoint_every=every)
        assert sim.info is not None
        assert sim.info.failed_steps > 300
        assert len(sim.info.failures) == 256
        assert sim.info.failures[-1].step < 70


def test_an_error_carries_the_records() -> None:
    sim = ds.Simulator(squeeze(), dt=0.01, on_failure="raise")
    with pytest.raises(ds.SolverError, match=r"step 9: 'cube', 'press'") as caught:
        sim.rollout(sim.initial_state(), PRESS, 12)
    error = caught.value
    assert error.failures == error.info.failures
    assert [f.step for f in error.failures] == [9, 10, 11]
    assert pickle.loads(pickle.dumps(error)).failures == error.failures
    twin = copy.deepcopy(sim)
    assert twin.info == sim.info
    assert twin.info is not None
    assert twin.info.scenes_converged.tolist() is False


def test_a_zone_that_is_not_solved_names_its_bodies() -> None:
    sim = ds.Simulator(scenes.tilted_box(), dt=0.01, max_iterations=1)
    with pytest.warns(ds.ConvergenceWarning):
        sim.rollout(sim.initial_state(), None, 60)
    assert sim.info is not None
    assert {f.bodies for f in sim.info.failures} == {sim.body_names}
    assert {f.status for f in sim.info.failures} == {"max_iterations"}
    assert {f.iterations for f in sim.info.failures} == {1}


def test_a_large_zone_names_a_few() -> None:
    sim = ds.Simulator(scenes.two_layer_stack(12), dt=0.01, max_iterations=1)
    with pytest.warns(ds.ConvergenceWarning):
        sim.rollout(sim.initial_state(), None, 5)
    assert sim.info is not None
    assert max(len(f.bodies) for f in sim.info.failures) == 8


def test_cloth_is_named() -> None:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box(0.5), density=1000.0, position=(3, 0, 0), name="apart")
    scene.add_cloth(ds.shapes.sheet((1.0, 1.0), (4, 4)), ds.ClothMaterial(), pinned=[0], name="sheet")
    for coupling in ("monolithic", "split"):
        sim = ds.Simulator(scene, dt=0.05, max_iterations=1, coupling=coupling)
        with pytest.warns(ds.ConvergenceWarning, match="'sheet'"):
            sim(sim.initial_state())
        assert sim.info is not None
        assert [f.bodies for f in sim.info.failures] == [("sheet",)]


def test_a_body_that_spins_too_fast_is_named() -> None:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((0.1, 0.2, 0.3)), density=1000.0, name="calm")
    scene.add_body(ds.shapes.box((0.1, 0.2, 0.3)), density=1000.0, position=(1, 0, 0), name="wild")
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    state.angular_velocity[1] = torch.tensor([1e9, 2e9, 3e9])
    with pytest.warns(ds.ConvergenceWarning, match="'wild'"):
        sim(state)
    assert sim.info is not None
    assert [(f.bodies, f.status) for f in sim.info.failures] == [(("wild",), "spinning")]
