"""Nothing that is not finite goes in or comes out without a word: states, parameters, gradients."""

from __future__ import annotations

import math
import pickle
import warnings
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

import diffsim as ds
from diffsim._outcome import gradient_error

HUGE = 1e308
CONTROLS = ("force", "torque", "node_force", "body_velocity", "body_angular_velocity", "node_velocity")


def two_bodies(**options: object) -> ds.Simulator:
    scene = ds.Scene(gravity=(0, 0, 0))
    scene.add_sphere(0.1, density=1000.0, name="ball")
    scene.add_body(ds.shapes.box(0.2), density=1000.0, position=(1, 0, 0), name="box")
    return ds.Simulator(scene, dt=0.01, **options)  # type: ignore[arg-type]


def with_cloth() -> ds.Simulator:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.2), density=1000.0, position=(0, 0, 1), name="box")
    scene.add_cloth(
        ds.shapes.sheet((1.0, 1.0), (3, 3)), ds.ClothMaterial(), pinned=[0], position=(0, 0, 0.5), name="sheet"
    )
    return ds.Simulator(scene, dt=0.01)


# ---- gradients -------------------------------------------------------------------------------------------------------


def test_a_gradient_that_overflows_names_step_scene_and_body() -> None:
    """d(position)/d(velocity) grows by dt a step: that of one body in one scene passes the largest number."""
    sim = two_bodies()
    state = sim.initial_state(batch=3)
    velocity = state.velocity.requires_grad_()
    for every in (None, 60):
        trajectory = sim.rollout(state.replace(velocity=velocity), None, 300, checkpoint_every=every)
        with pytest.raises(ds.GradientError) as caught:
            trajectory.position[-1, 1, 1].sum().mul(HUGE).backward()
        error = caught.value
        assert isinstance(error, RuntimeError)
        assert (error.scene, error.bodies) == (1, ("box",))
        assert "state.velocity" in error.gradients
        # After k steps back it is k dt 1e308, which is computed as 1 / dt times something on the way.
        assert 300 - 180 <= error.step < 300
        assert f"step {error.step} of the rollout, scene 1" in str(error)
        assert "'box'" in str(error)
        assert "'ball'" not in str(error)
        assert velocity.grad is None
    again = pickle.loads(pickle.dumps(error))
    assert (again.step, again.scene, again.gradients, again.bodies) == (error.step, 1, error.gradients, ("box",))


def test_a_gradient_of_the_grounds_friction_names_the_ground() -> None:
    """The core numbers it -1, from behind."""
    fault: Any = SimpleNamespace(args=(0, 3, ["friction"], [-1, 0], []))
    error = gradient_error(two_bodies()._model, fault)
    assert error.bodies == ("ground", "ball")


def test_a_step_between_is_named() -> None:
    sim = two_bodies()
    state = sim.initial_state()
    velocity = state.velocity.requires_grad_()
    trajectory = sim.rollout(state.replace(velocity=velocity), None, 40)
    with pytest.raises(ds.GradientError, match=r"in step 17 of the rollout"):
        # The two go in together at the end of that step; each alone is fine.
        ((trajectory.position[17, 0, 0] + trajectory.velocity[17, 0, 0]) * HUGE).backward()
    (1e300 * trajectory.velocity[17, 0, 0]).backward()
    assert velocity.grad is not None
    assert bool(velocity.grad.isfinite().all())


@pytest.mark.parametrize("name", ["mass", "inertia", "gravity", "force", "torque"])
def test_gradients_of_parameters_and_controls_are_watched(name: str) -> None:
    sim = two_bodies()
    state = sim.initial_state()
    force = torch.full((2, 3), 1e3, dtype=torch.float64)
    control = ds.Control(force=force, torque=force.clone())
    given = getattr(control if name in ("force", "torque") else sim, name).requires_grad_()
    end = sim.rollout(state, control, 3)[-1]
    with pytest.raises(ds.GradientError, match=rf"with respect to .*\b{name}\b") as caught:
        (end.velocity.sum() + end.angular_velocity.sum()).mul(1.7e308).backward()
    assert given.grad is None
    assert caught.value.step == 2


def test_gradients_of_cloth_are_watched() -> None:
    sim = with_cloth()
    state = sim.initial_state()
    position = state.node_position.requires_grad_()
    end = sim.rollout(state.replace(node_position=position), None, 3)[-1]
    with pytest.raises(
        ds.GradientError, match=r"state.node_velocity.*'sheet' \(nodes .*5.* of the node axis\)"
    ) as caught:
        (end.node_position[5] + end.node_velocity[5]).sum().mul(HUGE).backward()
    assert 5 in caught.value.nodes
    assert caught.value.bodies == ("sheet",)


def test_a_sum_over_scenes_that_overflows_is_told() -> None:
    scene = ds.Scene(gravity=(0, 0, 0))
    scene.add_sphere(0.1, mass=0.01)
    sim = ds.Simulator(scene, dt=0.01)
    sim.mass.requires_grad_()
    end = sim(sim.initial_state(batch=4), ds.Control(force=torch.full((1, 3), 1e4, dtype=torch.float64)))
    (unit,) = torch.autograd.grad(end.velocity.sum(), sim.mass, retain_graph=True)
    loss = end.velocity * (2 * (1.2e308 / abs(float(unit))))  # a quarter of it, a scene's share, is finite
    loss[0].sum().backward(retain_graph=True)
    with pytest.raises(ds.GradientError, match="mass is not finite in the sum over steps and scenes") as caught:
        loss.sum().backward()
    assert (caught.value.scene, caught.value.step) == (-1, -1)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_upstream_that_is_not_finite_is_the_callers(value: float) -> None:
    sim = two_bodies()
    state = sim.initial_state(batch=2)
    velocity = state.velocity.requires_grad_()
    trajectory = sim.rollout(state.replace(velocity=velocity), None, 4)
    trajectory.position[1, 0, 0, 0].mul(value).backward(retain_graph=True)
    assert velocity.grad is not None
    assert not bool(velocity.grad[0, 0, 0].isfinite())
    assert not velocity.grad[1].any()
    with pytest.raises(ds.GradientError, match="scene 1"):  # not where another scene's is ours
        (
            trajectory.position[1, 0, 0, 0] * value + (trajectory.position + trajectory.velocity)[3, 1, 0, 0] * HUGE
        ).backward()


def test_gradients_must_fit_into_the_states_precision() -> None:
    sim = two_bodies()
    for dtype, fits in ((torch.float64, True), (torch.float32, False)):
        state = sim.initial_state().to(dtype)
        velocity = state.velocity.requires_grad_()
        end = sim.rollout(state.replace(velocity=velocity), None, 500)[-1]
        loss = end.position[0, 0] * 1e38
        if fits:
            loss.backward()
            assert float(velocity.grad[0, 0]) == pytest.approx(5e38)  # type: ignore[index]
        else:
            with pytest.raises(ds.GradientError, match=r"state.velocity"):
                loss.backward()


def test_gradients_must_fit_into_the_precision_of_a_control() -> None:
    sim = two_bodies()
    force = torch.zeros(2, 3, requires_grad=True)
    for controls in (ds.Control(force=force), [ds.Control(force=force.double()), ds.Control(force=force)]):
        loss = sim.rollout(sim.initial_state(), controls, 2).position[-1, 0, 0] * 1e45
        with pytest.raises(ds.GradientError, match=r"control.force"):
            loss.backward()


# ---- states ----------------------------------------------------------------------------------------------------------


def fields(state: ds.State) -> list[Tensor]:
    return [t for t in state.__dict__.values() if t.numel()]


def test_a_motion_that_overflows_is_held_and_told() -> None:
    sim = two_bodies()
    state = sim.initial_state(batch=2)
    force = torch.zeros(2, 2, 3, dtype=torch.float64)
    force[1, 0, 2] = 1e300
    with pytest.warns(ds.ConvergenceWarning, match=r"too large.*step 0 of scene 1: 'ball'"):
        end = sim.rollout(state, ds.Control(force=force), 3)[-1]
    assert sim.info is not None
    assert sim.info.scenes_converged.tolist() == [True, False]
    assert {(f.bodies, f.status) for f in sim.info.failures} == {(("ball",), "overflow")}
    for a, b in zip(fields(end), fields(state)):
        assert torch.equal(a[1], b[1])
    sim = two_bodies(on_failure="raise")
    with pytest.raises(ds.SolverError, match="too large") as caught:
        sim.rollout(state, ds.Control(force=force), 3)
    assert all(bool(t.isfinite().all()) for t in fields(caught.value.state))


@pytest.mark.parametrize(
    ("dtype", "size"),
    [
        (torch.float32, 1e20),
        (torch.float32, 3e38),
        *((torch.float64, x) for x in (1e20, 1e50, 1e100, 1e155, 1e200, 1e308)),
    ],
)
def test_values_out_of_all_proportion_are_answered_or_refused(dtype: torch.dtype, size: float) -> None:
    """Never NaN or infinity, whatever is large; never a hang."""
    sim = with_cloth()
    start = sim.initial_state().to(dtype)
    controls = ds.Control(*(torch.zeros_like(start.node_position if "node" in n else start.position) for n in CONTROLS))
    answered = 0
    for kind, names in (
        (start, ("position", "velocity", "angular_velocity", "node_position", "node_velocity")),
        (controls, CONTROLS),
    ):
        for name in names:
            value = getattr(kind, name).clone()
            value[-1] = size * torch.tensor([0.3, 0.1, 1.0], dtype=dtype)
            state = start.replace(**{name: value}) if kind is start else start
            control = controls if kind is start else controls.replace(**{name: value})
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                try:
                    trajectory = sim.rollout(state, control, 2)
                except ValueError:
                    continue
            answered += 1
            for t in fields(trajectory):
                assert bool(t.isfinite().all()), name
    assert answered >= 6


# ---- parameters ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("mass", r"mass of body 'box' \(index 0\) must be positive and finite, got -?nan kg"),
        ("inertia", r"inertia of body 'box' \(index 0\) must be positive definite, got \(-?nan"),
        ("gravity", r"gravity must be finite, got \(-?nan"),
        ("cloth_density", r"cloth_density of cloth 'sheet' \(index 0\) must be positive and finite, got -?nan kg/m²"),
        ("cloth_stretch", r"cloth_stretch of cloth 'sheet' \(index 0\) must be positive and finite, got -?nan N/m"),
        ("cloth_shear", r"cloth_shear of cloth 'sheet' \(index 0\)"),
        ("cloth_bend", r"cloth_bend of cloth 'sheet' \(index 0\)"),
        ("cloth_damping", r"cloth_damping of cloth 'sheet' \(index 0\)"),
        ("friction", r"friction .*'box' \(index 0\).*nan"),
        ("restitution", r"restitution .*'box' \(index 0\).*nan"),
    ],
)
def test_parameters_that_an_optimizer_made_nan_are_refused_by_name(name: str, text: str) -> None:
    sim = with_cloth()
    parameter = getattr(sim, name).requires_grad_()
    optimizer = torch.optim.SGD([parameter], lr=1.0)
    parameter.grad = torch.full_like(parameter, math.nan)
    optimizer.step()
    for call in (lambda: sim(sim.initial_state()), lambda: sim.rollout(sim.initial_state(), None, 2)):
        with pytest.raises((ValueError, NotImplementedError), match=text):
            call()
