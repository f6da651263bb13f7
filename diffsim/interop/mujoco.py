"""Scenes from MuJoCo's models, and states from and to its data. Extra ``mujoco``.

One body of a scene is one body of MuJoCo's with all that is welded to it, and goes by its name. Its mesh frame is
MuJoCo's body frame, so that ``sim.mesh_transform(state)`` is xpos and xmat. What differs between the two:

=====================  =======================================  =============================================
of a free body         MuJoCo (qpos, qvel)                      `State`
=====================  =======================================  =============================================
position               the body frame's origin, world           the centre of mass, world
orientation            quaternion w, x, y, z                    the same
velocity               of the body frame's origin, world        of the centre of mass, world
angular velocity       in the axes of the body                  in the axes of the world
=====================  =======================================  =============================================

Contact differs too: MuJoCo's is soft and creeps under friction, and it takes a mesh for its convex hull; here it is
stiff, what friction holds stays, and a mesh is what it is. Of two objects that differ MuJoCo takes the larger
coefficient of friction, and here their geometric mean acts: between equal ones it is the same.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import torch

try:
    import mujoco
except ImportError as error:
    raise ImportError('diffsim.interop.mujoco needs mujoco: pip install "mesh-diffsim[mujoco]"') from error

from .._arguments import Kind
from .._body_shape import Shape, mesh_shape, round_shape
from .._mass_properties import FloatArray, MassProperties
from .._mesh import read_mesh
from .._packed import rotation_matrix
from ..scene import Scene
from ..simulator import Simulator
from ..state import State
from . import _mjcf
from ._mjcf import Group, Inertial

__all__ = ["from_mjdata", "load", "to_mjdata"]

_ROOM = 0.1  # of the thickness, to which MuJoCo's contacts are opened: rounding must not let meshes cross
_SAME_CENTER = 1e-9  # of the centres of mass of a simulator and a model, relative to their size


def load(source: str | os.PathLike[str] | mujoco.MjModel) -> Scene:
    """A scene of what an MJCF model describes, in its initial configuration.

    Bodies with a free joint become dynamic ones, mocap bodies kinematic ones; each geom of a body that cannot move
    becomes a static body of its own, named "body/geom", but for horizontal planes: the highest of them becomes the
    ground. A plane that is not horizontal becomes a rectangle of its size. Spheres and capsules are exact, if they are
    all their body has to collide with; cylinders become prisms of 32 sides and ellipsoids (and round geoms beside
    others) meshes, all with their corners on the true surface. Meshes are taken as they are, not as their hulls. Mass,
    centre of mass and inertia are MuJoCo's, whatever the mesh. Friction is a geom's sliding coefficient, 0 with condim
    1, and of a body of several the largest. Geoms with contype and conaffinity 0 are left out.

    MuJoCo's time step is not part of a scene: ``ds.Simulator(scene, dt=model.opt.timestep)``.

    Args:
        source: A path to a file MuJoCo can read, its text (which begins with "<"), or a compiled model.
    Raises:
        NotImplementedError: Joints other than free ones, tendons, actuators, equalities, flexes, height fields, contact
            filters and media, by name.
        ValueError: A free or mocap body without a geom to collide with; a plane that is neither horizontal nor of
            finite size; what MuJoCo says of a file it cannot read, and what `Scene.add_body` says.
    Warns: UserWarning, once, where friction is another than MuJoCo's: coefficients that differ, condim 4 and 6.
    """
    model = _compiled(source)
    _mjcf.refuse_what_is_left(model)
    gravity_off = model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    scene = Scene(gravity=np.zeros(3) if gravity_off else model.opt.gravity.copy())
    geoms: list[int] = []
    for group in _mjcf.groups(model):
        geoms += group.geoms
        if group.kind == "static":
            _add_static(scene, model, group)
        else:
            _add_moving(scene, model, group)
    if differences := _mjcf.differences_of_friction(model, geoms):
        warnings.warn(f"mujoco.load: friction is not quite MuJoCo's: {'; '.join(differences)}", stacklevel=2)
    return scene


def from_mjdata(sim: Simulator, model: mujoco.MjModel, data: mujoco.MjData, *, separate: bool = False) -> State:
    """The state of MuJoCo's data: of all free and mocap bodies; what else is in the simulator's scene is as there.

    MuJoCo's contacts are soft, so that bodies at rest overlap a little, and a step refuses a state with meshes that
    cross: for such data there is `separate`.

    Args:
        sim: Of the scene `load` made of this model, to which more may have been added.
        model: As compiled by MuJoCo.
        data: Its qpos, qvel, mocap_pos and mocap_quat are read, so that it need not be forwarded. Mocap bodies have no
            velocity in MuJoCo, and get none.
        separate: Move free bodies out of each other, and out of what does not move, along the normals of MuJoCo's
            contacts; then as `Simulator.separate`. Velocities stay.
    Returns: New float64 tensors, without a batch axis. From here to `to_mjdata` and back nothing changes but rounding,
        unless bodies had to be separated.
    Raises: ValueError for a simulator without a body of this model, or with one whose centre of mass is elsewhere; as
        `Simulator.separate`.
    Gradients: none.
    """
    state = sim.initial_state().to(torch.float64)
    position, orientation = state.position.numpy(), state.orientation.numpy()
    velocity, spin = state.velocity.numpy(), state.angular_velocity.numpy()
    for body, group, center in _matched("from_mjdata", sim, model):
        if group.kind == "kinematic":
            mocap = int(model.body_mocapid[group.root])
            origin, orientation[body] = data.mocap_pos[mocap], data.mocap_quat[mocap]
            position[body] = origin + rotation_matrix(_unit(orientation[body])) @ center
            velocity[body] = spin[body] = 0.0
            continue
        at, moves = _addresses(model, group.root)
        orientation[body] = data.qpos[at + 3 : at + 7]
        turn = rotation_matrix(_unit(orientation[body]))
        arm = turn @ center
        spin[body] = turn @ data.qvel[moves + 3 : moves + 6]
        position[body] = data.qpos[at : at + 3] + arm
        velocity[body] = data.qvel[moves : moves + 3] + np.cross(spin[body], arm)
    if not separate:
        return state
    shifts = _mjcf.shifts_apart(model, data, room=_ROOM * sim.thickness)
    for body, group, _ in _matched("from_mjdata", sim, model):
        position[body] += shifts[group.root]
    return sim.separate(state)


def to_mjdata(sim: Simulator, state: State, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Write a state into MuJoCo's data: qpos and qvel of free bodies, mocap_pos and mocap_quat of mocap bodies.

    All else in the data stays; ``mujoco.mj_forward(model, data)`` brings it up to date.

    Args:
        sim: As for `from_mjdata`.
        state: Without leading axes; float32 is written as float64.
        model: As compiled by MuJoCo.
        data: Written to.
    Raises: ValueError for a state with leading axes or of another scene, and as `from_mjdata`.
    Gradients: none.
    """
    if isinstance(state, State) and state.leading_shape:
        raise ValueError(f"to_mjdata: state must be one state, got leading axes {tuple(state.leading_shape)}; index it")
    matrices = sim.mesh_transform(state.detach().to(torch.float64)).numpy()  # also checks the state
    values = [t.numpy(force=True).astype(np.float64) for t in (state.orientation, state.velocity)]
    orientation, velocity = values
    spin = state.angular_velocity.numpy(force=True).astype(np.float64)
    for body, group, center in _matched("to_mjdata", sim, model):
        turn, origin = matrices[body, :3, :3], matrices[body, :3, 3]
        if group.kind == "kinematic":
            mocap = int(model.body_mocapid[group.root])
            data.mocap_pos[mocap], data.mocap_quat[mocap] = origin, orientation[body]
            continue
        at, moves = _addresses(model, group.root)
        data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = origin, orientation[body]
        data.qvel[moves : moves + 3] = velocity[body] - np.cross(spin[body], turn @ center)
        data.qvel[moves + 3 : moves + 6] = turn.T @ spin[body]


# ---- bodies ----------------------------------------------------------------------------------------------------------


def _compiled(source: Any) -> Any:
    if isinstance(source, mujoco.MjModel):
        return source
    text = os.fspath(source)
    if text.lstrip().startswith("<"):
        return mujoco.MjModel.from_xml_string(text)
    return mujoco.MjModel.from_xml_path(text)


def _add_moving(scene: Scene, model: Any, group: Group) -> None:
    name = _mjcf.body_name(model, group.root)
    where = f"body {name!r}"
    if not group.geoms:
        raise ValueError(f"mujoco.load: {where} has no geom that collides (contype, conaffinity); give it one")
    properties = _mjcf.inertial(model, group.root)
    if group.kind == "kinematic":
        properties = replace(properties, center=np.zeros(3))
    shape = _moving_shape(model, group, properties, where)
    position, orientation = _mjcf.pose_in(model, 0, group.root)
    _add(scene, name, group, shape, position, orientation, _mjcf.friction_of(model, group.geoms))


def _moving_shape(model: Any, group: Group, properties: Inertial, where: str) -> Shape:
    mass, inertia = (properties.mass, properties.inertia) if group.kind == "dynamic" else (None, None)
    if len(group.geoms) == 1 and _mjcf.is_round(model, group.geoms[0]):
        shape = _round_shape(model, group.geoms[0], group.kind, mass, inertia, where)
        pose = _mjcf.geom_pose(model, group.root, group.geoms[0])
        shape = replace(shape, vertices=_mjcf.placed(shape.vertices, pose))
    else:
        parts = [_mjcf.surface(model, geom) for geom in group.geoms]
        poses = [_mjcf.geom_pose(model, group.root, geom) for geom in group.geoms]
        vertices = np.concatenate([_mjcf.placed(part[0], pose) for part, pose in zip(parts, poses)])
        starts = np.cumsum([0, *(len(part[0]) for part in parts)])
        faces = np.concatenate([part[1] + start for part, start in zip(parts, starts)])
        vertices, faces = read_mesh((vertices, faces), where)
        shape = mesh_shape(vertices, faces, None, mass, inertia, group.kind, None, where)
    return replace(shape, center=properties.center)


def _round_shape(model: Any, geom: int, kind: Kind, mass: Any, inertia: Any, where: str) -> Shape:
    """In the geom's frame."""
    points, radius = _mjcf.axis(model, geom), float(model.geom_size[geom, 0])
    # Of the properties only the volume is read: mass and inertia are MuJoCo's, or of no interest.
    volume = np.pi * radius**2 * (4.0 / 3.0 * radius + float(np.linalg.norm(points[-1] - points[0])))
    unit = MassProperties(volume, np.zeros(3), np.eye(3))
    return round_shape(points, radius, unit, None, mass, inertia, kind, where)


def _add_static(scene: Scene, model: Any, group: Group) -> None:
    planes: list[tuple[float, float]] = []  # heights and coefficients of friction
    for geom in group.geoms:
        name = _mjcf.geom_name(model, geom)
        where = f"body {name!r}"
        position, orientation = _mjcf.geom_pose(model, 0, geom)
        friction = _mjcf.sliding_friction(model, geom)
        if model.geom_type[geom] == _mjcf.PLANE:
            if rotation_matrix(orientation)[2, 2] > 1.0 - 1e-12:
                planes.append((float(position[2]), friction))
                continue
            if not model.geom_size[geom, :2].all():
                raise ValueError(
                    f"mujoco.load: plane {name!r} is not horizontal and has no end; give it a size, or make it a box"
                )
        if _mjcf.is_round(model, geom):
            shape = _round_shape(model, geom, "static", None, None, where)
        else:
            vertices, faces = read_mesh(_mjcf.surface(model, geom), where)
            shape = mesh_shape(vertices, faces, None, None, None, "static", None, where)
        _add(scene, name, group, replace(shape, center=np.zeros(3)), position, orientation, friction)
    if planes:
        height, friction = max(planes)
        scene.add_ground(height=height, friction=friction)


def _add(
    scene: Scene,
    name: str,
    group: Group,
    shape: Shape,
    position: FloatArray,
    orientation: FloatArray,
    friction: float,
) -> None:
    where, name = scene._name(name, "body", 0)
    motion = (position, orientation, np.zeros(3), np.zeros(3))
    scene._add(name, where, group.kind, shape, motion, friction, 0.0, "MuJoCo's lengths are taken for metres")


# ---- states ----------------------------------------------------------------------------------------------------------


def _matched(where: str, sim: Simulator, model: Any) -> list[tuple[int, Group, FloatArray]]:
    """The moving bodies of a model: index in the simulator, group, centre of mass in the frame of the group's root."""
    matched = []
    offsets, kinds = sim._packed.mesh_offset, sim._packed.kind
    for group in _mjcf.groups(model):
        if group.kind == "static":
            continue
        name = _mjcf.body_name(model, group.root)
        if name not in sim.body_names:
            raise ValueError(f"{where}: the simulator has no body {name!r}; make its scene by mujoco.load(model)")
        body = sim.body_names.index(name)
        center = _mjcf.inertial(model, group.root).center if group.kind == "dynamic" else np.zeros(3)
        scale = max(float(np.abs(center).max()), 1.0)
        if kinds[body] != (0 if group.kind == "dynamic" else 2) or (
            np.abs(offsets[body] - center).max() > _SAME_CENTER * scale
        ):
            raise ValueError(
                f"{where}: body {name!r} of the simulator is not the one of this model: its kind or centre of mass"
                " differs; make the scene by mujoco.load(model)"
            )
        matched.append((body, group, center))
    return matched


def _addresses(model: Any, body: int) -> tuple[int, int]:
    """Where the free joint of a body begins in qpos and qvel."""
    joint = int(model.body_jntadr[body])
    return int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])


def _unit(q: FloatArray) -> FloatArray:
    return np.asarray(q / np.linalg.norm(q))
