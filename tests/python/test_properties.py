"""What holds for every scene, input and sequence of calls: hypothesis looks for one for which it does not.

`pytest --hypothesis-profile long tests/python/test_properties.py` looks longer, and elsewhere every time;
`tests/fuzz.py` runs larger scenes for longer. What they find becomes a test of its own where it belongs.
"""

from __future__ import annotations

import copy
import math
import pickle
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from small_scenes import STATE_FIELDS

import diffsim as ds

pytest.importorskip("hypothesis", reason="the tests' packages: pip install .[test]")
pytest.importorskip("ipctk", reason="the tests' packages: pip install .[test]")
from hypothesis import assume, example, given
from hypothesis import strategies as st
from penetration import PenetrationCheck

ALL_FIELDS = (*STATE_FIELDS, "node_position", "node_velocity")
SIZE = 0.25  # radius of a ball around each body, of the scene's unit
DT = 0.01


def numbers(most: float) -> st.SearchStrategy[float]:
    return st.floats(-most, most)


def vectors(most: float) -> st.SearchStrategy[tuple[float, ...]]:
    return st.tuples(*[numbers(most)] * 3)


def quaternions() -> st.SearchStrategy[tuple[float, ...]]:
    return st.tuples(*[numbers(1.0)] * 4).filter(lambda q: math.hypot(*q) > 0.1)


def mesh(draw: Any, unit: float) -> Any:
    vertices, faces = draw(
        st.sampled_from(
            (
                ds.shapes.box((1.0, 0.7, 0.4)),
                ds.shapes.tetrahedron(),
                ds.shapes.l_shape(1.0, 0.4, 0.5),
                ds.shapes.torus(1.0, 0.3, 6, 4),
            )
        )
    )
    return vertices * (unit * SIZE / max(math.hypot(*v) for v in vertices)), faces


@st.composite
def scenes(draw: Any) -> ds.Scene:
    """One to four bodies, each in a cell of its own, over a ground or not, and perhaps a cloth above them."""
    unit = draw(st.sampled_from((1.0, 1e-3, 1e2)))  # [m]
    coefficients = st.sampled_from((0.0, 0.0, 0.3, 1.5))
    scene = ds.Scene(gravity=draw(vectors(10.0)))
    if draw(st.booleans()):
        scene.add_ground(friction=draw(coefficients))
    for k in range(draw(st.integers(1, 4))):
        kind = draw(st.sampled_from(("dynamic", "dynamic", "dynamic", "static", "kinematic")))
        options: dict[str, Any] = {
            "kind": kind,
            "position": (0.55 * unit * (k % 2), 0.0, unit * (0.3 + 0.55 * (k // 2))),
            "orientation": draw(quaternions()),
            "friction": draw(coefficients),
        }
        if kind == "dynamic":
            options["density"] = 10.0 ** draw(st.integers(1, 4))
        if kind != "static":
            options["velocity"] = tuple(unit * v for v in draw(vectors(5.0)))
            options["angular_velocity"] = draw(vectors(10.0))
        if draw(st.booleans()):
            scene.add_sphere(unit * SIZE, **options)
        else:
            scene.add_body(mesh(draw, unit), **options)
    if unit == 1.0 and draw(st.integers(0, 3)) == 0:
        pinned = draw(st.sampled_from(((), (0,), (0, 3))))
        friction = draw(coefficients)
        scene.add_cloth(ds.shapes.sheet(1.0, 4), position=(0.3, 0.0, 1.2), pinned=pinned, friction=friction)
    return scene


def same(a: ds.State, b: ds.State) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in ALL_FIELDS)


@pytest.fixture(autouse=True)
def _quiet() -> Any:
    """Steps that do not converge, and what is fast, are answered all the same."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


# ---- scenes ----------------------------------------------------------------------------------------------------------


@given(scenes(), st.sampled_from((0.001, DT, 0.05)), st.sampled_from(("implicit_euler", "second_order")))
def test_every_scene_steps_with_finite_gradients_and_nothing_in_anything(
    scene: ds.Scene, dt: float, integrator: str
) -> None:
    sim = ds.Simulator(scene, dt, integrator=integrator, num_threads=1)
    start = sim.initial_state()
    leaves = [t for name in ALL_FIELDS if (t := getattr(start, name)).numel()] + [sim.mass, sim.gravity, sim.friction]
    for leaf in leaves:
        leaf.requires_grad_()
    states = sim.rollout(start, None, 8)
    assert all(bool(getattr(states, name).isfinite().all()) for name in ALL_FIELDS)
    loss = sum((getattr(states[-1], name).sin().sum() for name in ALL_FIELDS), torch.zeros(()))
    gradients = torch.autograd.grad(loss, leaves)
    assert all(bool(gradient.isfinite().all()) for gradient in gradients)
    assert gradients[0].any()
    check = PenetrationCheck(scene, sim.thickness)
    for state in states.detach():
        assert not list(check.problems(sim, state))


@given(scenes(), vectors(1.0))
def test_a_rollout_of_a_batch_is_the_steps_of_its_scenes(scene: ds.Scene, push: tuple[float, ...]) -> None:
    sim = ds.Simulator(scene, DT, num_threads=2)
    first = sim.initial_state()
    second = first.replace(velocity=first.velocity + torch.tensor(push, dtype=torch.float64))
    together = sim.rollout(ds.State.stack([first, second]), None, 3)
    for scene_index, state in enumerate((first, second)):
        for step in range(3):
            state = sim(state)
            assert same(state, together[step, scene_index])


# ---- sequences of calls ----------------------------------------------------------------------------------------------


def _backward(sim: ds.Simulator, state: ds.State) -> ds.Simulator:
    velocity = state.velocity.clone().requires_grad_()
    sim.rollout(state.replace(velocity=velocity), None, 2).position.sum().backward()
    assert velocity.grad is not None
    return sim


def _refused(sim: ds.Simulator, state: ds.State) -> ds.Simulator:
    with pytest.raises(ValueError, match="velocity"):
        sim(state.replace(velocity=torch.full_like(state.velocity, math.nan)))
    return sim


def _kept(call: Callable[[ds.Simulator, ds.State], object]) -> Callable[[ds.Simulator, ds.State], ds.Simulator]:
    def run(sim: ds.Simulator, state: ds.State) -> ds.Simulator:
        call(sim, state)
        return sim

    return run


def _loaded(sim: ds.Simulator, _: ds.State) -> None:
    sim.load_state_dict(copy.deepcopy(sim.state_dict()))


CALLS: dict[str, Callable[[ds.Simulator, ds.State], ds.Simulator]] = {
    "rollout": _kept(lambda sim, state: sim.rollout(state, None, 3)),
    "batch": _kept(lambda sim, state: sim(sim.initial_state(batch=2))),
    "lighter": _kept(lambda sim, state: sim(state, parameters={"mass": 0.5 * sim.mass})),
    "contacts": _kept(lambda sim, state: sim.contacts(sim(state))),
    "separate": _kept(lambda sim, state: sim.separate(state)),
    "repr": _kept(lambda sim, state: repr(sim)),
    "load": _kept(_loaded),
    "backward": _backward,
    "refused": _refused,
    "copy": lambda sim, _: copy.deepcopy(sim),
    "pickle": lambda sim, _: pickle.loads(pickle.dumps(sim)),
}


@given(scenes(), st.lists(st.sampled_from(sorted(CALLS)), min_size=1, max_size=5))
def test_no_call_leaves_a_trace_in_the_next(scene: ds.Scene, names: list[str]) -> None:
    sim = ds.Simulator(scene, DT, num_threads=1)
    start = sim.initial_state()
    once = sim(start)
    for name in names:
        sim = CALLS[name](sim, start)
        assert same(sim(start), once), name
        assert same(sim.initial_state(), start), name


# ---- inputs ----------------------------------------------------------------------------------------------------------


def two_boxes(**options: Any) -> ds.Simulator:
    scene = ds.Scene()
    scene.add_ground()
    for k in range(2):
        scene.add_body(ds.shapes.box(0.2), density=500.0, position=(0.0, 0.0, 0.15 + 0.3 * k), **options)
    return ds.Simulator(scene, DT, num_threads=1)


def step_with(sim: ds.Simulator, name: str, value: Any) -> ds.State:
    state = sim.initial_state()
    if name in STATE_FIELDS:
        return sim(state.replace(**{name: value}))
    if name in ("force", "torque"):
        return sim(state, ds.Control(**{name: value}))
    return sim(state, parameters={name: value})


WRONG: tuple[Any, ...] = (
    "text",
    3.0,
    [[0.0] * 3] * 2,
    *(torch.zeros(2, 3, dtype=dtype) for dtype in (torch.int64, torch.float16, torch.bool, torch.complex128)),
)


@given(
    st.sampled_from((*STATE_FIELDS, "force", "torque", "mass", "inertia", "gravity", "friction")),
    st.one_of(
        st.sampled_from(WRONG),
        st.sampled_from((math.nan, math.inf, -math.inf)).map(lambda value: ("entry", value)),
        st.lists(st.integers(0, 4), max_size=4).map(lambda shape: torch.zeros(shape, dtype=torch.float64)),
    ),
    st.integers(0, 5),
)
def test_what_is_no_input_is_refused_by_name(name: str, wrong: Any, place: int) -> None:
    sim = two_boxes()
    state = sim.initial_state()
    right = getattr(state, name, None) if name in STATE_FIELDS else getattr(sim, name, state.velocity)
    assert right is not None
    if isinstance(wrong, tuple):
        value = right.detach().clone()
        value.view(-1)[place % value.numel()] = wrong[1]
    else:
        value = wrong
        if isinstance(value, torch.Tensor):  # with a batch axis in front it may be right
            assume(value.dtype != torch.float64 or value.shape[-right.ndim :] != right.shape)
    with pytest.raises((TypeError, ValueError), match=name):
        step_with(sim, name, value)


OPTIONS = ("dt", "thickness", "compliance", "tolerance", "density", "friction", "margin", "scale", "position")


@given(st.sampled_from(OPTIONS), st.floats())
@example("dt", 1e-300)
@example("density", 5e-324)
@example("friction", 1e308)
def test_any_number_is_taken_or_refused_by_name(name: str, value: float) -> None:
    refused, end = step_of_numbers(name, value)
    if refused is None:
        assert all(bool(getattr(end, field).isfinite().all()) for field in STATE_FIELDS)
        return
    assert name in refused or "body_0" in refused  # what a number makes of the body may be what is wrong


def step_of_numbers(name: str, value: float) -> tuple[str | None, ds.State | None]:
    """What was said against it, or the state after a step."""
    body: dict[str, Any] = {"density": 500.0, "position": (0.0, 0.0, 0.3), "friction": 0.5}
    options: dict[str, Any] = {"dt": DT}
    (options if name in OPTIONS[:4] else body)[name] = (0.0, value, 0.3) if name == "position" else value
    scene = ds.Scene()
    scene.add_ground(friction=0.5)
    try:
        scene.add_body(ds.shapes.box(0.2), **body)
        sim = ds.Simulator(scene, **options)
        return None, sim(sim.initial_state())
    except ValueError as error:
        return str(error), None
