"""What scenes of the work-precision report are made of, and their runs: trajectories that can be compared."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
import torch
from _mujoco import Settings, model_of

import diffsim as ds

G = 9.81
ROUNDS = 3
SHORT, LONG = 0.05, 1.0  # a run that takes less is timed more often, and one that takes more once [s]


class Unstable(RuntimeError):
    """A run has no end that could be compared."""


@dataclass(frozen=True)
class Motion:
    """Where a scene went, as any of the simulators says."""

    start: ds.State
    states: ds.State  # after each step, along a leading time axis
    dt: float
    gap: float  # what the simulator keeps between two surfaces that touch: its thickness [m]
    sim: ds.Simulator  # of the scene, for energies

    def times(self) -> np.ndarray:
        return self.dt * np.arange(1, len(self.states.position) + 1)


@dataclass(frozen=True)
class Run:
    timed: Callable[[], object]  # the steps and no more
    motion: Callable[[], Motion]


@dataclass(frozen=True)
class Method:
    """A curve of a plot. To add a method, add an entry to the table of a scene."""

    name: str
    prepare: Callable[[ds.Scene, float, float], Run]  # scene, dt [s], duration [s]
    ours: bool = False
    own_limit: bool = False  # errors are from its own limit, where scenes have no closed form: it has another model


Error = Callable[[Motion, "Motion | None"], float]  # the motion, and the one it is held against where there is one


@dataclass(frozen=True)
class ValueScene:
    """A scene whose errors are of motions. To add one, add an entry to a table of scenes."""

    name: str
    title: str
    reference: str  # what errors are from, in words
    build: Callable[[], ds.Scene]
    duration: float  # [s]
    steps: Sequence[float]  # dt, large to small [s]
    errors: Mapping[str, Error]  # by the label of their axis
    methods: Sequence[Method]
    limit_dt: float | None = None  # of the run errors are from, without closed form [s]
    limit: Method | None = None  # of the same, for methods that have no limit of their own; the first if none
    quick: bool = False  # part of quick runs
    note: str = ""  # why a peer is better here, or seems to be


def diffsim(name: str = "diffsim", **options: Any) -> Method:
    def prepare(scene: ds.Scene, dt: float, duration: float) -> Run:
        sim = ds.Simulator(scene, dt, num_threads=1, **options)
        start, steps = sim.initial_state(), round(duration / dt)

        def steps_alone() -> ds.State:
            with torch.no_grad():
                return sim.rollout(start, None, steps)

        def motion() -> Motion:
            states = steps_alone()
            assert sim.info is not None
            if not sim.info.converged and sim._settings["newton_iterations"] is None:
                raise Unstable(f"{sim.info.failed_steps} of {steps} steps: {sim.info.failure}")
            return Motion(start, states, dt, sim.thickness, sim)

        return Run(steps_alone, motion)

    return Method(name, prepare, ours=True)


def mujoco_bodies(settings: Settings) -> Method:
    """MuJoCo's steps in C."""

    def prepare(scene: ds.Scene, dt: float, duration: float) -> Run:
        sim = ds.Simulator(scene, dt)  # only for the start and for what measures energies
        start = sim.initial_state()
        model, data = model_of(scene, start, dt=dt, settings=settings)
        steps, moving = round(duration / dt), torch.from_numpy(scene.pack().kind == 0)
        steps_alone, trajectory = mujoco_runs(model, data, steps)

        def motion() -> Motion:
            return Motion(start, _as_states(start, moving, trajectory(), model.nq), dt, 0.0, sim)

        return Run(steps_alone, motion)

    return Method(settings.name, prepare)


def mujoco_runs(model: Any, data: Any, steps: int) -> tuple[Callable[[], object], Callable[[], np.ndarray]]:
    """The steps alone, looped over in C, from where `data` is now; and the states they pass, (steps, ...)."""
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    initial = np.zeros(mujoco.mj_stateSize(model, kind))
    mujoco.mj_getState(model, data, initial, kind)

    def steps_alone() -> object:
        mujoco.mj_resetData(model, data)  # warnings and the warm start, too
        mujoco.mj_setState(model, data, initial, kind)
        mujoco.mj_step(model, data, nstep=steps)
        return data

    def trajectory() -> np.ndarray:
        mujoco.mj_resetData(model, data)
        found = mujoco.rollout.rollout(model, data, initial, nstep=steps)[0][0]
        if any(warning.number for warning in data.warning) or not np.isfinite(found).all():
            raise Unstable("MuJoCo warns of a state that blew up")
        return np.asarray(found)

    return steps_alone, trajectory


def _as_states(start: ds.State, moving: torch.Tensor, found: np.ndarray, nq: int) -> ds.State:
    """MuJoCo's states, (steps, 1 + nq + nv), as ours."""
    steps = len(found)
    place = torch.from_numpy(np.ascontiguousarray(found[:, 1 : 1 + nq])).reshape(steps, -1, 7)
    motion = torch.from_numpy(np.ascontiguousarray(found[:, 1 + nq :])).reshape(steps, -1, 6)
    q, spin = place[..., 3:], motion[..., 3:]  # the spin is in the body's frame
    fields = {
        "position": place[..., :3],
        "orientation": q,
        "velocity": motion[..., :3],
        "angular_velocity": (ds.rotation.to_matrix(q) @ spin[..., None])[..., 0],
    }
    full = {}
    for name, value in fields.items():
        full[name] = getattr(start, name).expand(steps, -1, -1).clone()
        full[name][:, moving] = value
    nothing = torch.zeros(steps, 0, 3, dtype=torch.float64)
    return ds.State(**full, node_position=nothing, node_velocity=nothing)


INTEGRATORS = tuple(Settings(name) for name in ("Euler", "implicitfast", "RK4"))
MUJOCO_SMOOTH = tuple(map(mujoco_bodies, INTEGRATORS))
MUJOCO = (*MUJOCO_SMOOTH, mujoco_bodies(Settings("implicitfast", stiff=True)))

HARD = diffsim("diffsim compliance=0", compliance=0.0)
LOOSE = diffsim("diffsim tolerance=1e-4", tolerance=1e-4)
SECOND_ORDER = diffsim("diffsim second_order", integrator="second_order")
SPLIT = diffsim("diffsim split", coupling="split")
SPLIT_ONCE = diffsim("diffsim split 1 Newton", coupling="split", newton_iterations=1)
TENTHS = (0.04, 0.02, 0.01, 0.005, 0.0025, 0.00125)


def timed(run: Callable[[], Any], quick: bool = False) -> tuple[Any, float]:
    """What a call returns, and the median of its times on the processor [ms], after one that is not counted.

    `quick`: that one is.
    """
    seconds: list[float] = []
    rounds = 1 if quick else 2
    while len(seconds) < rounds:
        start = time.process_time()
        result = run()
        seconds.append(time.process_time() - start)
        if len(seconds) == 1 and not quick:
            rounds += 0 if seconds[0] > LONG else ROUNDS - 1 if seconds[0] > SHORT else 3 * ROUNDS - 1
    return result, 1e3 * statistics.median(seconds if quick else seconds[1:])


def rms(difference: np.ndarray) -> float:
    """Of vectors, along the last axis."""
    return float(np.sqrt(np.square(difference).sum(axis=-1).mean()))


def penetration(scene: ds.Scene, motion: Motion, samples: int = 50) -> float:
    """Deepest over time, judged for all simulators by the same geometry, that of MuJoCo [m]."""
    model, data = model_of(scene, motion.start, dt=motion.dt)
    moving = torch.from_numpy(scene.pack().kind == 0)
    count = len(motion.states.position)
    deepest = 0.0
    for k in np.unique(np.linspace(0, count - 1, min(count, samples)).round().astype(int)):
        place = torch.cat([motion.states.position[k], motion.states.orientation[k]], dim=-1)[moving]
        data.qpos[:] = place.reshape(-1).numpy()
        mujoco.mj_forward(model, data)
        deepest = max(deepest, -min(data.contact.dist, default=0.0))
    return deepest


def energy_made(motion: Motion, _: Motion | None = None) -> float:
    """The largest rise of the energy above an earlier value, as a part of what the scene lost in all."""
    sim, states = motion.sim, motion.states
    energy = sim.kinetic_energy(states) + sim.potential_energy(states)
    first = sim.kinetic_energy(motion.start) + sim.potential_energy(motion.start)
    energy = torch.cat([first[None], energy]).detach()
    rise = (energy - torch.cummin(energy, 0).values).max()
    return float(rise / (energy[0] - energy.min()).clamp(min=1e-12))


def at_times(motion: Motion, values: np.ndarray, times: Sequence[float]) -> np.ndarray:
    """Values after steps, at times that all steps of a sweep share."""
    return np.stack([values[round(t / motion.dt) - 1] for t in times])
