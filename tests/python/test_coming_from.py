"""What docs/coming_from.md says of MuJoCo, asked of MuJoCo; and its code, as printed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

import diffsim as ds

PAGE = Path(__file__).resolve().parents[2] / "docs" / "coming_from.md"
CENTER, MASS = (0.1, -0.2, 0.3), 2.0
MODEL = f"""
<mujoco><worldbody><body name="stone" pos="0 0 1"><freejoint/>
  <inertial pos="{CENTER[0]} {CENTER[1]} {CENTER[2]}" mass="{MASS}" diaginertia=".02 .03 .04" quat=".9 .1 .2 .3"/>
</body></worldbody></mujoco>
"""


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """The names the page's code defines."""
    names: dict[str, Any] = {}
    for code in re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL):
        exec(code, names)
    return names


@pytest.fixture
def stone() -> tuple[Any, Any]:
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    q = np.array([0.5, 0.5, -0.1, 0.7])
    data.qpos[:] = (1.0, 2.0, 3.0, *q / np.linalg.norm(q))
    data.qvel[:] = (0.1, 0.2, 0.3, 3.0, -1.0, 2.0)
    mujoco.mj_forward(model, data)
    return model, data


def test_mujocos_state_becomes_ours_and_back(page: dict[str, Any], stone: tuple[Any, Any]) -> None:
    model, data = stone
    position, orientation, velocity, angular_velocity = page["from_mujoco"](model, data, 1)
    at_center = np.zeros(6)  # angular, then linear, of the centre of mass in world axes
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, 1, at_center, 0)
    np.testing.assert_allclose(position, data.xipos[1], atol=1e-14)
    np.testing.assert_allclose(ds.rotation.to_matrix(orientation), data.xmat[1].reshape(3, 3), atol=1e-14)
    np.testing.assert_allclose(angular_velocity, at_center[:3], atol=1e-13)
    np.testing.assert_allclose(velocity, at_center[3:], atol=1e-13)
    assert np.abs(velocity - data.qvel[:3]).max() > 0.1
    assert np.abs(angular_velocity - data.qvel[3:]).max() > 0.1
    qpos, qvel = page["to_mujoco"](model, 1, position, orientation, velocity, angular_velocity)
    np.testing.assert_allclose(qpos, data.qpos, atol=1e-14)
    np.testing.assert_allclose(qvel, data.qvel, atol=1e-13)


def test_the_same_body_has_the_same_energy_mesh_frame_and_acceleration(
    page: dict[str, Any], stone: tuple[Any, Any]
) -> None:
    model, data = stone
    vertices, faces = ds.shapes.box(0.4)
    scene = ds.Scene()
    mesh = (np.asarray(vertices) + CENTER, faces)  # its frame is that of MuJoCo's body
    body = scene.add_body(mesh, mass=MASS, inertia=page["inertia_of_mujoco"](model, 1))
    sim = ds.Simulator(scene, dt=model.opt.timestep)
    values = [torch.from_numpy(np.array(v))[None] for v in page["from_mujoco"](model, data, 1)]
    state = sim.place(ds.State(*values), body, position=data.qpos[:3], orientation=data.qpos[3:])
    for ours, theirs in zip((state.position, state.orientation), values):
        torch.testing.assert_close(ours, theirs, rtol=0.0, atol=1e-14)
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    force, torque = np.array([3.0, -1.0, 2.0]), np.array([0.2, 0.1, -0.3])
    data.xfrc_applied[1] = (*force, *torque)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(sim.kinetic_energy(state), data.energy[1], rtol=1e-13)
    # By xfrc_applied: the first change of momentum is ours, for a step that is short.
    short = 1e-6
    control = ds.Control(force=torch.tensor(force)[None], torque=torch.tensor(torque)[None])
    end = ds.Simulator(scene, dt=short)(state, control)
    model.opt.timestep = short
    mujoco.mj_step(model, data)
    velocity, angular_velocity = page["from_mujoco"](model, data, 1)[2:]
    change = (end.angular_velocity - state.angular_velocity)[0].numpy()
    assert np.abs(change).max() > 1e-6
    np.testing.assert_allclose(end.velocity[0], velocity, atol=1e-3 * np.abs(change).max())
    np.testing.assert_allclose(end.angular_velocity[0], angular_velocity, atol=1e-3 * np.abs(change).max())


def test_the_fall_of_what_does_not_turn_is_mujocos(stone: tuple[Any, Any]) -> None:
    model, data = stone
    assert model.opt.timestep == 0.002
    data.qvel[3:] = 0.0
    scene = ds.Scene()
    scene.add_sphere(0.1, density=1000.0)
    sim = ds.Simulator(scene, dt=model.opt.timestep)
    start = sim.initial_state().replace(velocity=torch.tensor(data.qvel[:3])[None])
    before = data.xipos[1].copy()
    mujoco.mj_step(model, data, 100)
    mujoco.mj_kinematics(model, data)
    fallen = sim.rollout(start, steps=100).position[-1, 0].numpy()
    np.testing.assert_allclose(fallen, data.xipos[1] - before, atol=1e-12)
