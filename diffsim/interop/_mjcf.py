"""What of a compiled MuJoCo model becomes a body of a scene, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from .._arguments import Kind
from .._mass_properties import FloatArray, IntArray
from .._packed import rotation_matrix

# As plain integers: MuJoCo's enumerators do not equal those of numpy.
PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = SHAPES = [
    int(getattr(mujoco.mjtGeom, f"mjGEOM_{name}"))
    for name in ("PLANE", "SPHERE", "CAPSULE", "ELLIPSOID", "CYLINDER", "BOX", "MESH")
]
_NO_CONTACT = mujoco.mjtDisableBit.mjDSBL_CONTACT, mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
_OTHER_SHAPES = {
    int(mujoco.mjtGeom.mjGEOM_HFIELD): "a height field",
    int(mujoco.mjtGeom.mjGEOM_SDF): "a signed distance field",
}


@dataclass(frozen=True)
class Group:
    """A body of MuJoCo's with all that is welded to it: one body of a scene, or several that never move."""

    root: int  #: the body whose pose is that of all
    kind: Kind
    geoms: tuple[int, ...]  #: those that can touch something


@dataclass(frozen=True)
class Inertial:
    """Mass properties of a group, in the frame of its root."""

    mass: float  #: [kg]
    center: FloatArray  #: of mass, shape (3,) [m]
    inertia: FloatArray  #: about the centre, along the root's axes, shape (3, 3) [kg·m²]


def groups(model: Any) -> Iterator[Group]:
    """By the root's index: the world and all that is welded to it first."""
    owner = model.body_weldid[model.geom_bodyid]
    for root in np.unique(model.body_weldid).tolist():
        kind: Kind = "dynamic"
        if root == 0:
            kind = "static"
        elif model.body_mocapid[root] >= 0:
            kind = "kinematic"
        yield Group(root, kind, tuple(np.flatnonzero((owner == root) & collides(model)).tolist()))


def collides(model: Any) -> Any:
    """Which geoms are there for more than the eye, bool, shape (ngeom,)."""
    return (model.geom_contype != 0) | (model.geom_conaffinity != 0)


def body_name(model: Any, body: int) -> str:
    return str(model.body(body).name) or f"body_{body}"


def geom_name(model: Any, geom: int) -> str:
    """Unique, since a name that is given is, and says whose geom it is."""
    owner = body_name(model, int(model.geom_bodyid[geom]))
    return f"{owner}/{model.geom(geom).name or f'geom_{geom}'}"


def quaternion_product(a: FloatArray, b: FloatArray) -> FloatArray:
    product = np.empty(4)
    mujoco.mju_mulQuat(product, a, b)
    return product


def pose_in(model: Any, root: int, body: int) -> tuple[FloatArray, FloatArray]:
    """Position and quaternion of a body in the frame of one it is welded to, or in the world for root 0."""
    position, quaternion = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    while body != root:
        turn = model.body_quat[body]
        position = model.body_pos[body] + rotation_matrix(turn) @ position
        quaternion = quaternion_product(turn, quaternion)
        body = int(model.body_parentid[body])
    return position, quaternion


def geom_pose(model: Any, root: int, geom: int) -> tuple[FloatArray, FloatArray]:
    """Position and quaternion of a geom in the frame of its group's root."""
    position, quaternion = pose_in(model, root, int(model.geom_bodyid[geom]))
    position = position + rotation_matrix(quaternion) @ model.geom_pos[geom]
    return position, quaternion_product(quaternion, model.geom_quat[geom])


def inertial(model: Any, root: int) -> Inertial:
    """Of all bodies of the group, about their common centre of mass."""
    parts = []
    for body in np.flatnonzero(model.body_weldid == root).tolist():
        position, quaternion = pose_in(model, root, body)
        center = position + rotation_matrix(quaternion) @ model.body_ipos[body]
        axes = rotation_matrix(quaternion_product(quaternion, model.body_iquat[body]))
        parts.append((float(model.body_mass[body]), center, axes @ np.diag(model.body_inertia[body]) @ axes.T))
    if len(parts) == 1:
        return Inertial(*parts[0])
    mass = sum(m for m, _, _ in parts)
    center = sum((m * c for m, c, _ in parts), np.zeros(3)) / mass
    about = np.zeros((3, 3))
    for m, c, own in parts:
        arm = c - center
        about += own + m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return Inertial(mass, center, about)


# ---- friction --------------------------------------------------------------------------------------------------------


def sliding_friction(model: Any, geom: int) -> float:
    """Coulomb's coefficient, 0 without tangential directions (condim 1)."""
    return float(model.geom_friction[geom, 0]) if model.geom_condim[geom] > 1 else 0.0


def friction_of(model: Any, geoms: Sequence[int]) -> float:
    """Of a body with these geoms: it has one coefficient, so the largest, as MuJoCo takes the larger of two."""
    return max(sliding_friction(model, geom) for geom in geoms)


def differences_of_friction(model: Any, geoms: list[int]) -> list[str]:
    """What MuJoCo makes of the friction of these geoms and a scene does not, in words."""
    found = []
    if len({sliding_friction(model, geom) for geom in geoms}) > 1:
        found.append("of two coefficients that differ MuJoCo takes the larger, here their geometric mean acts")
    if any(model.geom_condim[geom] > 3 for geom in geoms):
        found.append("torsional and rolling friction (condim 4 and 6) are left out")
    return found


# ---- overlaps --------------------------------------------------------------------------------------------------------

_SWEEPS = 1000  # over all contacts; a stack of n bodies takes about n²


def shifts_apart(model: Any, data: Any, room: float) -> FloatArray:
    """By how much to move free bodies so that none of MuJoCo's contacts is nearer than `room`, shape (nbody, 3) [m].

    Contact after contact is opened along its normal, by half from both sides or all from the one that is free, until
    none is left to open.
    """
    copy = mujoco.MjData(model)
    copy.qpos[:], copy.mocap_pos[:], copy.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
    mujoco.mj_fwdPosition(model, copy)
    yields = np.where(model.body_dofnum > 0, 1.0, 0.0)
    roots = model.body_weldid[model.geom_bodyid]
    contacts = [
        (int(roots[contact.geom1]), int(roots[contact.geom2]), contact.frame[:3].copy(), float(contact.dist) - room)
        for contact in copy.contact
    ]
    contacts = [contact for contact in contacts if yields[contact[0]] + yields[contact[1]] > 0.0]
    shifts = np.zeros((model.nbody, 3))
    for _ in range(_SWEEPS):
        moved = False
        for a, b, normal, gap in contacts:  # the normal points from a to b
            missing = -(gap + normal @ (shifts[b] - shifts[a]))
            if missing > 0.01 * room:
                push = missing / (yields[a] + yields[b]) * normal
                shifts[a] -= yields[a] * push
                shifts[b] += yields[b] * push
                moved = True
        if not moved:
            break
    return shifts


# ---- surfaces --------------------------------------------------------------------------------------------------------

SEGMENTS = 32  # corners of the polygon that stands for a circle


def is_round(model: Any, geom: int) -> bool:
    """A sphere or a capsule, which a body may be without facets."""
    return model.geom_type[geom] in (SPHERE, CAPSULE)


def axis(model: Any, geom: int) -> FloatArray:
    """The point or the two points a sphere or a capsule surrounds, in the geom's frame, shape (1 or 2, 3)."""
    if model.geom_type[geom] == SPHERE:
        return np.zeros((1, 3))
    half = float(model.geom_size[geom, 1])
    return np.array([[0.0, 0.0, -half], [0.0, 0.0, half]])


def placed(points: FloatArray, pose: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Points of a frame in the one its pose, position and quaternion, is given in."""
    position, quaternion = pose
    return np.asarray(points @ rotation_matrix(quaternion).T + position)


def surface(model: Any, geom: int) -> tuple[FloatArray, IntArray]:
    """A mesh in the geom's frame; that of a round geom has its vertices on the true surface."""
    import trimesh

    from ..shapes import box, icosphere, prism

    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == BOX:
        return box((2.0 * size).tolist())
    if kind in (SPHERE, ELLIPSOID):
        vertices, faces = icosphere(1.0, 3)
        return vertices * (size if kind == ELLIPSOID else size[0]), faces
    if kind == CYLINDER:
        angles = 2.0 * np.pi / SEGMENTS * np.arange(SEGMENTS)
        return prism((size[0] * np.stack([np.cos(angles), np.sin(angles)], axis=1)).tolist(), 2.0 * size[1])
    if kind == CAPSULE:
        capsule: Any = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[SEGMENTS, SEGMENTS])
        capsule.apply_translation(-capsule.bounds.mean(axis=0))
        return np.asarray(capsule.vertices), np.asarray(capsule.faces)
    if kind == PLANE:
        x, y = size[:2]
        corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
        return corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32)
    mesh = int(model.geom_dataid[geom])
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    first_face, face_count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    vertices = model.mesh_vert[first : first + count].astype(np.float64)
    return vertices, model.mesh_face[first_face : first_face + face_count]


# ---- what is refused -------------------------------------------------------------------------------------------------


def refuse_what_is_left(model: Any) -> None:
    """Raise NotImplementedError for the first thing of a model that a scene cannot be."""
    for what in _unknown(model):
        raise NotImplementedError(
            f"mujoco.load: {what} cannot be taken; a scene is of free bodies (freejoint), mocap bodies and bodies that"
            " do not move"
        )


def _unknown(model: Any) -> Iterator[str]:
    types = {int(getattr(mujoco.mjtJoint, f"mjJNT_{name.upper()}")): name for name in ("ball", "slide", "hinge")}
    for joint in range(model.njnt):
        title = f"joint {model.joint(joint).name!r} of body {body_name(model, int(model.jnt_bodyid[joint]))!r}"
        if int(model.jnt_type[joint]) in types:
            yield f"{title}, a {types[int(model.jnt_type[joint])]} joint,"
        dofs = slice(int(model.jnt_dofadr[joint]), int(model.jnt_dofadr[joint]) + 6)
        for field in ("damping", "armature", "frictionloss"):
            if getattr(model, f"dof_{field}")[dofs].any():
                yield f"the {field} of {title}"
    counts = {"tendon": "ntendon", "actuator": "nu", "equality": "neq", "pair": "npair", "exclude": "nexclude"}
    for kind, count in counts.items():
        for index in range(getattr(model, count)):
            yield f"{kind} {getattr(model, kind)(index).name or index!r}"
    if model.nflex:
        yield f"flex {model.flex(0).name!r}"
    for geom in np.flatnonzero(collides(model)).tolist():
        shape = int(model.geom_type[geom])
        if shape not in SHAPES:
            yield f"geom {geom_name(model, geom)!r}, {_OTHER_SHAPES.get(shape, f'of type {shape}')},"
        for field in ("adhesion", "surfacevel"):
            if np.any(getattr(model, f"geom_{field}", np.zeros(model.ngeom))[geom]):
                yield f"the {field} of geom {geom_name(model, geom)!r}"
    for body in np.flatnonzero(model.body_gravcomp).tolist():
        yield f"gravcomp of body {body_name(model, body)!r}"
    if model.opt.density or model.opt.viscosity:
        yield "the medium (option density, viscosity)"
    if model.opt.disableflags & sum(map(int, _NO_CONTACT)):
        yield "a model without contact (flag contact or constraint)"
    yield from _filtered_pairs(model)


def _filtered_pairs(model: Any) -> Iterator[str]:
    """Two geoms whose bits keep them from touching, though one of their bodies is free: here everything collides."""
    geoms = np.flatnonzero(collides(model))
    contype, conaffinity = model.geom_contype[geoms], model.geom_conaffinity[geoms]
    root = model.body_weldid[model.geom_bodyid[geoms]]
    free = model.body_dofnum[root] > 0
    meets = (contype[:, None] & conaffinity[None]) != 0
    apart = ~(meets | meets.T) & (root[:, None] != root[None]) & (free[:, None] | free[None])
    for a, b in np.argwhere(np.triu(apart))[:1].tolist():
        names = (geom_name(model, int(geoms[i])) for i in (a, b))
        yield "contype and conaffinity that keep geoms {!r} and {!r} from touching".format(*names)
