"""MuJoCo's side of the benchmarks of bodies on a plane; its steps are looped over in C."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np
from numpy.typing import ArrayLike

import diffsim as ds

CONES = ("pyramidal", "elliptic")
_START = mujoco.mjtState.mjSTATE_FULLPHYSICS


def boxes(
    position: ArrayLike,
    edge: float,
    *,
    dt: float,
    cone: str = "pyramidal",
    gravity: float = 9.81,
    density: float = 1000.0,
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[Any, Any]:
    """Model and data of upright cubes with these centres above the plane z = 0, all moving alike. Default options."""
    half = 0.5 * edge
    # By default its arena grows with the square of the number of boxes: 24 GB at 4,000, and no model at all at 5,000.
    arena = '<size memory="4G"/>' if len(np.asarray(position)) > 3000 else ""
    bodies = [
        f'<body pos="{x} {y} {z}"><freejoint/><geom type="box" size="{half} {half} {half}" density="{density}"/></body>'
        for x, y, z in np.asarray(position).tolist()
    ]
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="{dt}" cone="{cone}" gravity="0 0 {-gravity}"/>{arena}<worldbody>
        <geom type="plane" size="0 0 1"/>{"".join(bodies)}</worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qvel.reshape(-1, 6)[:, :3] = velocity
    return model, data


@dataclass(frozen=True)
class Settings:
    """What MuJoCo is run with: its defaults, but for what is said here."""

    integrator: str = "Euler"
    cone: str = "pyramidal"
    impratio: float = 1.0  # by how much friction is stiffer than the normal direction, against creep
    stiff: bool = False  # contacts as stiff as a step lets them be

    @property
    def name(self) -> str:
        words = ["MuJoCo", self.integrator]
        words += [self.cone] if self.cone != "pyramidal" else []
        words += [f"impratio {self.impratio:g}"] if self.impratio != 1.0 else []
        return " ".join(words + ["stiff"] * self.stiff)

    def option(self, dt: float, gravity: ArrayLike) -> str:
        """The element of a model."""
        return (
            f'<option timestep="{dt}" integrator="{self.integrator}" cone="{self.cone}" impratio="{self.impratio}"'
            f' gravity="{_numbers(gravity)}"/>'
        )


DEFAULT = Settings()


def model_of(
    scene: ds.Scene,
    state: ds.State,
    *,
    dt: float,
    settings: Settings = DEFAULT,
    mass: ArrayLike | None = None,
    friction: ArrayLike | None = None,
) -> tuple[Any, Any]:
    """Model and data of the bodies of a scene at a state, with the scene's friction, and without where it has none.

    Meshes of 8 vertices are boxes, and must be upright in their body's frame; of others MuJoCo takes the convex hull.
    `mass`, `friction`: in place of the scene's [kg], [1]. Of two objects MuJoCo takes the larger coefficient, not the
    geometric mean: all must have the same.
    """
    p = scene.pack()
    assets, elements = body_elements(p, state, p.mass if mass is None else np.asarray(mass))
    contact = contact_attributes(p.friction if friction is None else np.asarray(friction))
    contact += f' solref="{2.0 * dt} 1" solimp="0.9999 0.9999 0.001"' if settings.stiff else ""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco>{settings.option(dt, p.gravity)}
        <default><geom {contact}/></default>
        <asset>{assets}</asset><worldbody>{elements}</worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    set_velocity(data.qvel, p, state)
    return model, data


def body_elements(p: Any, state: ds.State, mass: np.ndarray) -> tuple[str, str]:
    """Assets, and what the world has of bodies and ground, of a packed scene at a state."""
    meshes, bodies = [], []
    last = np.cumsum(p.vertex_count)
    for body, (name, count) in enumerate(zip(p.names, p.vertex_count)):
        points = p.vertices[last[body] - count : last[body]]
        if count == 1:
            shape = f'type="sphere" size="{_numbers(p.margin[body])}"'
        elif count == 8:
            shape = f'type="box" size="{_numbers(np.ptp(points, axis=0) / 2)}"'
        else:
            shape = f'type="mesh" mesh="{name}"'
            meshes.append(f'<mesh name="{name}" vertex="{_numbers(points)}"/>')
        place = f'pos="{_numbers(state.position[body])}" quat="{_numbers(state.orientation[body])}"'
        if p.kind[body] == 0:
            inertia = p.inertia[body][[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
            inertial = f'<inertial pos="0 0 0" mass="{_numbers(mass[body])}" fullinertia="{_numbers(inertia)}"/>'
            bodies.append(f"<body {place}><freejoint/>{inertial}<geom {shape}/></body>")
        else:
            bodies.append(f"<geom {shape} {place}/>")
    ground = f'<geom type="plane" size="0 0 1" pos="0 0 {p.ground_height}"/>' if p.has_ground else ""
    return "".join(meshes), ground + "".join(bodies)


def set_velocity(qvel: np.ndarray, p: Any, state: ds.State) -> None:
    """Of the free bodies, which come first."""
    moving = p.kind == 0
    velocity = qvel[: 6 * moving.sum()].reshape(-1, 6)
    velocity[:, :3] = state.velocity[moving]
    for k, body in enumerate(np.flatnonzero(moving)):  # MuJoCo's is in the body's frame
        mujoco.mju_rotVecQuat(
            velocity[k, 3:],
            state.angular_velocity[body].numpy(),
            state.orientation[body].numpy() * [1.0, -1.0, -1.0, -1.0],
        )


def contact_attributes(friction: np.ndarray) -> str:
    """Of geoms and flexes, for the coefficients of all objects."""
    if np.ptp(friction) > 0.0:
        raise ValueError(f"MuJoCo's side: all objects must have the same coefficient of friction, got {friction}")
    return f'condim="3" friction="{_numbers(friction[0])} 0 0"' if friction[0] > 0.0 else 'condim="1"'


def _numbers(values: ArrayLike) -> str:
    return " ".join(f"{value:.17g}" for value in np.ravel(np.asarray(values)))


def ways_to_step(model: Any, data: Any, steps: int) -> dict[str, Callable[[], object]]:
    """Two ways to take the same steps, over and over from where `data` is now, with its warm start."""
    state = np.zeros(mujoco.mj_stateSize(model, _START))
    mujoco.mj_getState(model, data, state, _START)
    warm = data.qacc_warmstart.copy()

    def by_mj_step() -> object:
        mujoco.mj_setState(model, data, state, _START)
        data.qacc_warmstart[:] = warm
        mujoco.mj_step(model, data, nstep=steps)
        return data

    def by_rollout() -> object:
        return mujoco.rollout.rollout(model, data, state, nstep=steps, initial_warmstart=warm)

    return {"mj_step": by_mj_step, "rollout": by_rollout}


def set_friction(model: Any, friction: float, cone: str = "elliptic") -> None:
    """Coulomb's, with one coefficient for all, in place of what the model was made with: none about the normal."""
    model.opt.cone = mujoco.mjtCone.mjCONE_ELLIPTIC if cone == "elliptic" else mujoco.mjtCone.mjCONE_PYRAMIDAL
    model.geom_condim[:] = 3
    model.geom_friction[:] = (friction, 0.0, 0.0)


def faster(seconds: Mapping[str, list[float]], prefix: str) -> list[float]:
    """The times of the faster of the cases whose names begin so."""
    return min((values for name, values in seconds.items() if name.startswith(prefix)), key=statistics.median)
