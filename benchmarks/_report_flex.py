"""MuJoCo's side of the report's scenes with one sheet of cloth, and balls: a flex made from a scene."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch
from _cloth_scenes import DAMPING, POISSON, THICK, YOUNG
from _mujoco import _numbers
from _report_motion import Method, Motion, Run, mujoco_runs

import diffsim as ds


def sheet_model(sim: ds.Simulator, start: ds.State, dt: float, integrator: str) -> Any:
    """The sheet with the masses of ours; CG to 1e-4 is the fastest that solves the step (see `_cloth_scenes`)."""
    p = sim._packed
    points, faces = start.node_position.numpy(), p.triangles
    masses = sim._node_mass().detach().numpy()
    pinned = np.flatnonzero(p.pinned)
    balls = "".join(
        f'<body pos="{_numbers(start.position[k])}"><freejoint/><inertial pos="0 0 0" mass="{p.mass[k]}"'
        f' diaginertia="{_numbers(np.diag(p.inertia[k]))}"/>'
        f'<geom type="sphere" size="{p.margin[k]}" condim="1"/></body>'
        for k in range(len(p.names))
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><size memory="1G"/><option timestep="{dt}" gravity="{_numbers(p.gravity)}" integrator="{integrator}"'
        f' solver="CG" tolerance="1e-4" iterations="500"/><worldbody>{balls}'
        f'<flexcomp name="sheet" type="direct" dim="2" radius="{0.5 * THICK}" mass="{masses.sum()}"'
        f' point="{_numbers(points)}" element="{" ".join(map(str, faces.ravel()))}">'
        f'<elasticity young="{YOUNG}" poisson="{POISSON}" thickness="{THICK}" elastic2d="both" damping="{DAMPING}"/>'
        f'<contact selfcollide="none" condim="1"/><pin id="{" ".join(map(str, pinned))}"/>'
        "</flexcomp></worldbody></mujoco>"
    )
    for node in np.flatnonzero(p.pinned == 0):  # MuJoCo gives all the same
        model.body_mass[model.flex_vertbodyid[node]] = masses[node]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def mujoco_sheet(integrator: str) -> Method:
    def prepare(scene: ds.Scene, dt: float, duration: float) -> Run:
        sim = ds.Simulator(scene, dt)
        start = sim.initial_state()
        model = sheet_model(sim, start, dt, integrator)
        data, steps = mujoco.MjData(model), round(duration / dt)
        data.qvel[: 6 * len(start.velocity)].reshape(-1, 6)[:, :3] = start.velocity
        steps_alone, trajectory = mujoco_runs(model, data, steps)
        free = np.flatnonzero(sim._packed.pinned == 0)

        def motion() -> Motion:
            bodies = len(start.position)
            place = torch.from_numpy(trajectory()[:, 1 : 1 + model.nq].copy())
            nodes = start.node_position.expand(steps, -1, -1).clone()
            nodes[:, free] += place[:, 7 * bodies :].reshape(steps, -1, 3)  # three slides for a node
            poses = place[:, : 7 * bodies].reshape(steps, bodies, 7)
            nothing = torch.zeros(steps, bodies, 3, dtype=torch.float64)
            states = ds.State(poses[..., :3], poses[..., 3:], nothing, nothing, nodes, torch.zeros_like(nodes))
            return Motion(start, states, dt, 0.0, sim)

        return Run(steps_alone, motion)

    return Method(f"MuJoCo {integrator}", prepare, own_limit=True)
