"""MuJoCo's side of the report's scenes with one sheet of cloth, and bodies: a flex made from a scene."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import torch
from _cloth_scenes import DAMPING, POISSON, THICK, YOUNG
from _mujoco import _numbers, body_elements, contact_attributes, set_velocity
from _report_motion import Method, Motion, Run, mujoco_runs

import diffsim as ds


def sheet_model(sim: ds.Simulator, start: ds.State, dt: float, integrator: str) -> Any:
    """The sheet with the masses of ours; CG to 1e-4 is the fastest that solves the step (see `_cloth_scenes`)."""
    p = sim._packed
    points, faces = start.node_position.numpy(), p.triangles
    masses = sim._node_mass().detach().numpy()
    pinned = np.flatnonzero(p.pinned)
    assets, elements = body_elements(p, start, p.mass)
    contact = contact_attributes(p.friction)
    pins = f'<pin id="{" ".join(map(str, pinned))}"/>' if len(pinned) else ""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><size memory="1G"/><option timestep="{dt}" gravity="{_numbers(p.gravity)}" integrator="{integrator}"'
        f' solver="CG" tolerance="1e-4" iterations="500" cone="elliptic"/><default><geom {contact}/></default>'
        f"<asset>{assets}</asset><worldbody>{elements}"
        f'<flexcomp name="sheet" type="direct" dim="2" radius="{0.5 * THICK}" mass="{masses.sum()}"'
        f' point="{_numbers(points)}" element="{" ".join(map(str, faces.ravel()))}">'
        f'<elasticity young="{YOUNG}" poisson="{POISSON}" thickness="{THICK}" elastic2d="both" damping="{DAMPING}"/>'
        f'<contact selfcollide="none" {contact}/>{pins}</flexcomp></worldbody></mujoco>'
    )
    for node in np.flatnonzero(p.pinned == 0):  # MuJoCo gives all the same
        model.body_mass[model.flex_vertbodyid[node]] = masses[node]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def mujoco_sheet(integrator: str) -> Method:
    def prepare(scene: ds.Scene, dt: float, duration: float) -> Run:
        sim = ds.Simulator(scene, dt)
        start = sim.initial_state()
        p = sim._packed
        model = sheet_model(sim, start, dt, integrator)
        data, steps = mujoco.MjData(model), round(duration / dt)
        set_velocity(data.qvel, p, start)
        steps_alone, trajectory = mujoco_runs(model, data, steps)
        free, moving = np.flatnonzero(p.pinned == 0), np.flatnonzero(p.kind == 0)

        def motion() -> Motion:
            place = torch.from_numpy(trajectory()[:, 1 : 1 + model.nq].copy())
            nodes = start.node_position.expand(steps, -1, -1).clone()
            nodes[:, free] += place[:, 7 * len(moving) :].reshape(steps, -1, 3)  # three slides for a node
            poses = torch.cat([start.position, start.orientation], dim=1).expand(steps, -1, -1).clone()
            poses[:, moving] = place[:, : 7 * len(moving)].reshape(steps, -1, 7)
            nothing = torch.zeros(steps, len(p.names), 3, dtype=torch.float64)
            states = ds.State(poses[..., :3], poses[..., 3:], nothing, nothing, nodes, torch.zeros_like(nodes))
            return Motion(start, states, dt, 0.0, sim)

        return Run(steps_alone, motion)

    return Method(f"MuJoCo {integrator}", prepare, own_limit=True)


MUJOCO_SHEETS = tuple(map(mujoco_sheet, ("discrete", "Euler", "RK4")))
