"""Gradients of the work-precision report. One entry of `CONTACT_GRADIENTS` is one scene.

Two errors are told apart: of the gradient from that of the discrete steps that were run, and of either from the
gradient of the motion in continuous time, which is what someone who asks for one means.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import torch
from _mujoco import Settings, model_of
from _report_cloth import ball_on_damped_sheet, ball_on_sheet, figurine_on_sheet
from _report_impacts import landing, oblique, push, stack, two_balls
from torch import Tensor

import diffsim as ds

# A field of the state or a parameter, and an index into it; a list in it is of entries that are one number.
Place = tuple[str, tuple["int | list[int]", ...]]
Loss = Callable[[ds.State], Tensor]
DIFFERENCES = 1e-5  # step of central differences, of values of order one
WIDE = 1e-2  # another, for MuJoCo: it averages over what jumps from step to step
SHARP = 1e-13  # tolerance of the runs that gradients of the discrete steps are known from
ADJOINTS = tuple((name, {"adjoint": name}) for name in ("exact", "qr", "dense"))
MODES = (*ADJOINTS, ("second_order", {"integrator": "second_order"}))


@dataclass(frozen=True)
class GradientScene:
    name: str
    title: str
    reference: str  # what the continuous gradient is from, in words
    build: Callable[[], ds.Scene]
    duration: float  # [s]
    steps: Sequence[float]  # dt, large to small [s]
    inputs: Sequence[Place]
    loss: Loss  # of the last state
    exact: Callable[[Tensor, Inputs], Tensor] | None = None  # the loss as a closed form of the inputs
    limit_dt: float | None = None  # without closed form: of steps of second order [s]
    ours: Sequence[tuple[str, dict[str, str]]] = MODES  # names and options of simulators
    # By central differences. What is in contact, implicitfast does as Euler.
    mujoco: Sequence[Settings] = (Settings("Euler"), Settings("RK4"))
    quick: bool = False  # part of quick runs
    note: str = ""  # what its errors are of, where a reader might take them for something else


class Inputs:
    """What is differentiated by: a vector whose entries stand for entries of the state and of parameters."""

    def __init__(self, case: GradientScene, dt: float, **options: Any) -> None:
        self.case, self.dt = case, dt
        self.sim = ds.Simulator(case.build(), dt, num_threads=1, **options)
        self.start = self.sim.initial_state()
        self.count = round(case.duration / dt)
        self.values = torch.stack([self._field(name)[index].flatten()[0] for name, index in case.inputs]).detach()
        # Errors are of changes of parameters by a part of themselves: else what is large in its unit would not count.
        sizes = [1.0 if hasattr(self.start, name) else float(v) for v, (name, _) in zip(self.values, case.inputs)]
        self.sizes = np.array(sizes)

    def _field(self, name: str) -> Tensor:
        return getattr(self.start if hasattr(self.start, name) else self.sim, name).detach()

    def placed(self, values: Tensor) -> tuple[ds.State, dict[str, Tensor]]:
        fields: dict[str, Tensor] = {}
        for value, (name, index) in zip(values, self.case.inputs):
            place = tuple(torch.tensor(i) for i in index)
            fields[name] = fields.get(name, self._field(name)).index_put(place, value)
        state = {name: value for name, value in fields.items() if hasattr(self.start, name)}
        parameters = {name: value for name, value in fields.items() if name not in state}
        return self.start.replace(**state), parameters

    def loss(self, values: Tensor) -> Tensor:
        state, parameters = self.placed(values)
        return self.case.loss(self.sim.rollout(state, None, self.count, parameters=parameters)[-1])

    def adjoint(self) -> np.ndarray:
        values = self.values.clone().requires_grad_()
        return torch.autograd.grad(self.loss(values), values)[0].numpy()

    def differences(self, eps: float = DIFFERENCES) -> np.ndarray:
        with torch.no_grad():
            return central_differences(lambda values: float(self.loss(values)), self.values, eps)

    def discrete(self) -> np.ndarray:
        """Of the steps that are run: differences of two sizes that agree, extrapolated."""
        wide, narrow = self.differences(DIFFERENCES), self.differences(0.5 * DIFFERENCES)
        return (4.0 * narrow - wide) / 3.0


def central_differences(loss: Callable[[Tensor], float], values: Tensor, eps: float) -> np.ndarray:
    result = []
    for k, value in enumerate(values):
        step = eps * max(1.0, abs(float(value)))
        ends = []
        for sign in (-1.0, 1.0):
            moved = values.clone()
            moved[k] += sign * step
            ends.append(loss(moved))
        result.append((ends[1] - ends[0]) / (2.0 * step))
    return np.array(result)


def mujoco_differences(case: GradientScene, dt: float, settings: Settings, eps: float) -> Callable[[], np.ndarray]:
    """Central differences through MuJoCo; its models are made before, and not timed."""
    inputs = Inputs(case, dt)
    scene, models = case.build(), {}
    moving = torch.from_numpy(scene.pack().kind == 0)

    def prepared(values: Tensor) -> tuple[Any, Any, np.ndarray]:
        key = tuple(values.tolist())
        if key not in models:
            state, parameters = inputs.placed(values)
            given = {name: parameters[name].detach().numpy() for name in ("mass", "friction") if name in parameters}
            model, data = model_of(scene, state, dt=dt, settings=settings, **given)
            start = np.zeros(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
            mujoco.mj_getState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
            models[key] = model, data, start
        return models[key]

    def loss(values: Tensor) -> float:
        model, data, start = prepared(values)
        mujoco.mj_resetData(model, data)
        mujoco.mj_setState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        mujoco.mj_step(model, data, nstep=inputs.count)
        position = inputs.start.position.clone()
        position[moving] = torch.from_numpy(data.qpos.reshape(-1, 7)[:, :3].copy())
        return float(case.loss(inputs.start.replace(position=position)))

    central_differences(loss, inputs.values, eps)  # makes the models
    return lambda: central_differences(loss, inputs.values, eps)


def continuous(case: GradientScene) -> np.ndarray:
    if case.exact is not None:
        inputs = Inputs(case, case.steps[-1])
        values = inputs.values.clone().requires_grad_()
        return torch.autograd.grad(case.exact(values, inputs), values)[0].numpy()
    assert case.limit_dt is not None
    return Inputs(case, case.limit_dt, integrator="second_order").adjoint()


def relative(found: np.ndarray, right: np.ndarray, sizes: np.ndarray) -> float:
    return float(np.linalg.norm(sizes * (found - right)) / np.linalg.norm(sizes * right))


# ---- losses and closed forms -----------------------------------------------------------------------------------------


def weighted(end: ds.State) -> Tensor:
    """Of all centres, each coordinate with another weight."""
    weight = torch.arange(1.0, end.position.numel() + 1.0, dtype=torch.float64).reshape(end.position.shape)
    return (weight.cos() * end.position).sum()


def _after_landing(values: Tensor, inputs: Inputs) -> Tensor:
    """It slides on as fast as it was thrown, at the height of rest."""
    state, _ = inputs.placed(values)
    x = state.position[:, :2] + inputs.case.duration * state.velocity[:, :2]
    rest = torch.full((1, 1), 0.2, dtype=torch.float64)
    return weighted(inputs.start.replace(position=torch.cat([x, rest], dim=1)))


def _after_impact(values: Tensor, inputs: Inputs) -> Tensor:
    state, parameters = inputs.placed(values)
    end = two_balls(state.position, state.velocity, parameters["mass"], inputs.case.duration)
    return weighted(inputs.start.replace(position=end))


def _slides(values: Tensor, inputs: Inputs) -> Tensor:
    """Boxes of a stack without friction go their way sideways, at the heights of rest."""
    state, _ = inputs.placed(values)
    x = state.position[:, :2] + inputs.case.duration * state.velocity[:, :2]
    return weighted(inputs.start.replace(position=torch.cat([x, inputs.start.position[:, 2:]], dim=1)))


def _body_and_sheet(end: ds.State) -> Tensor:
    return weighted(end) + end.node_position[:, 2].mean()


def by_vector(name: str, body: int, axes: Sequence[int] = (0, 1, 2)) -> tuple[Place, ...]:
    return tuple((name, (body, axis)) for axis in axes)


# ---- the table -------------------------------------------------------------------------------------------------------

_BALLS = (*by_vector("position", 0), *by_vector("velocity", 0), ("mass", (0,)), ("mass", (1,)))
_STEPS = (0.02, 0.01, 0.005, 0.0025, 0.00125)

_NO_PEER = (
    "No peer: MuJoCo has no gradients of a flex, and differences through it would go to another limit, that of its soft"
    " contacts and of its own elasticity."
)
_WRINKLES = (
    " The limit itself is not sharp: a sheet that is struck wrinkles, which nodes touch changes from dt to dt, and the"
    " derivative to a sideways velocity is 0.043, 0.079 and 0.054 at dt = 0.00063, 0.00031 and 0.00016 s. It is right"
    " for its steps; one that means more is an average over starts."
)
_DAMPED = (
    " What is damped 40 times as much does not wrinkle, and the limit is sharp to 2 %: what it changes by from dt ="
    " 0.0006 to 0.0003 s. At dt = 0.00125 s differences of `second_order` step over a kink: those a tenth as wide agree"
    " with the adjoint to 1e-8."
)

CONTACT_GRADIENTS = (
    GradientScene(
        "landing",
        "A ball lands and stays",
        "closed form",
        landing,
        0.8,
        _STEPS,
        (*by_vector("position", 0), *by_vector("velocity", 0)),
        weighted,
        _after_landing,
    ),
    GradientScene(
        "push",
        "A ball runs into another",
        "closed form",
        push,
        0.8,
        _STEPS,
        _BALLS,
        weighted,
        _after_impact,
    ),
    GradientScene(
        "oblique",
        "Oblique impact without friction",
        "closed form",
        oblique,
        0.8,
        _STEPS,
        _BALLS,
        weighted,
        _after_impact,
        quick=True,
    ),
    GradientScene(
        "stack",
        "A stack, each box pushed sideways",
        "closed form",
        stack,
        0.4,
        _STEPS[:4],
        tuple(place for body in range(5) for place in by_vector("velocity", body)),
        weighted,
        _slides,
    ),
    GradientScene(
        "sphere_on_cloth",
        "A ball falls on a sheet",
        "own limit, dt → 0, by second_order",
        ball_on_sheet,
        0.15,
        (0.01, 0.005, 0.0025),
        (*by_vector("velocity", 0), ("mass", (0,)), ("cloth_stretch", (0,))),
        _body_and_sheet,
        limit_dt=0.0003125,
        mujoco=(),
        note=_NO_PEER + _WRINKLES,
    ),
    GradientScene(
        "sphere_on_damped_cloth",
        "A ball falls on a damped sheet",
        "own limit, dt → 0, by second_order",
        ball_on_damped_sheet,
        0.15,
        (0.01, 0.005, 0.0025, 0.00125),
        (*by_vector("velocity", 0), ("mass", (0,)), ("cloth_stretch", (0,))),
        _body_and_sheet,
        limit_dt=0.0003125,
        mujoco=(),
        note=_NO_PEER + _DAMPED,
    ),
    GradientScene(
        "figurine_on_cloth",
        "A figurine falls on a sheet",
        "own limit, dt → 0, by second_order",
        figurine_on_sheet,
        0.15,
        (0.01, 0.005, 0.0025),
        (*by_vector("velocity", 0), ("mass", (0,)), ("cloth_stretch", (0,)), ("cloth_bend", (0,))),
        _body_and_sheet,
        limit_dt=0.0003125,
        mujoco=(),
        note=_NO_PEER,
    ),
)
