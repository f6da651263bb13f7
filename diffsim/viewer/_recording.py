"""A trajectory as meshes that move: what all kinds of files are written from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from .. import _energies
from ..simulator import Simulator
from ..state import State

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.integer[Any]]
Color = tuple[float, float, float]

_CLOTH: Color = (0.50, 0.66, 0.80)
_STILL: Color = (0.72, 0.72, 0.75)  # static and kinematic bodies
_GROUND: Color = (0.95, 0.95, 0.97)
ARROWS: Color = (0.75, 0.08, 0.35)
_SEEN_THROUGH = 0.5
_BODIES: tuple[Color, ...] = (
    (0.93, 0.55, 0.25),
    (0.36, 0.60, 0.42),
    (0.48, 0.40, 0.66),
    (0.85, 0.38, 0.40),
    (0.30, 0.58, 0.70),
    (0.80, 0.66, 0.26),
)


@dataclass(frozen=True)
class Part:
    """The surface of one object over all frames: a mesh with a pose for each, or with vertices for each."""

    name: str
    vertices: FloatArray  #: body frame, or with `nodes` those of the first frame, shape (n, 3) [m]
    faces: IntArray  #: shape (m, 3)
    color: Color
    poses: FloatArray | None = None  #: body to world, shape (frames, 4, 4); None: see `nodes`
    nodes: FloatArray | None = None  #: world, shape (frames, n, 3) [m]; None without `poses`: it stands still
    smooth: bool = False  #: a curved surface whose triangles should not be seen
    two_sided: bool = False

    def at(self, frame: int) -> FloatArray:
        """World vertices in one frame, shape (n, 3)."""
        if self.nodes is not None:
            return np.asarray(self.nodes[frame])
        if self.poses is None:
            return self.vertices
        return np.asarray(self.vertices @ self.poses[frame, :3, :3].T + self.poses[frame, :3, 3])


@dataclass(frozen=True)
class Arrows:
    """The contact forces in one frame: an arrow for each push on an object that can move."""

    starts: FloatArray  #: world, shape (k, 3) [m]
    vectors: FloatArray  #: as long as they are drawn, shape (k, 3) [m]


@dataclass(frozen=True)
class Recording:
    """All objects of a scene over some frames of a trajectory."""

    times: FloatArray  #: of the frames, the first state's being 0, shape (frames,) [s]
    parts: list[Part]
    ground: Part | None
    bounds: FloatArray  #: lowest and highest corner of the box all parts and arrows stay in, shape (2, 3) [m]
    arrows: list[Arrows] | None = None  #: of each frame; None: nobody asked for them

    @property
    def centre(self) -> FloatArray:
        """Of the box [m]."""
        return np.asarray(self.bounds.mean(axis=0))

    @property
    def size(self) -> float:
        """Diagonal of the box [m]."""
        return float(np.linalg.norm(self.bounds[1] - self.bounds[0]))

    @property
    def opacity(self) -> float:
        """Of objects: arrows begin at their surfaces and go into them."""
        return 1.0 if self.arrows is None else _SEEN_THROUGH

    def arrows_in_slots(self) -> tuple[FloatArray, FloatArray]:
        """Starts and vectors of shape (frames, n, 3) for the most arrows of a frame; zero where there are fewer."""
        arrows = self.arrows or []
        starts = np.zeros((len(arrows), max((len(a.starts) for a in arrows), default=0), 3))
        vectors = np.zeros_like(starts)
        for frame, a in enumerate(arrows):
            starts[frame, : len(a.starts)], vectors[frame, : len(a.starts)] = a.starts, a.vectors
        return starts, vectors


def as_trajectory(where: str, sim: Simulator, trajectory: State | Sequence[State]) -> State:
    """One state with exactly one leading axis, time, cut from the graph and in float64."""
    if not isinstance(trajectory, State):
        states = list(trajectory)
        for state in states:
            sim._check_state(where, state)
        if not states:
            raise ValueError(f"{where}: trajectory has no states")
        trajectory = State(*(torch.stack(column) for column in zip(*(s.__dict__.values() for s in states))))
    sim._check_state(where, trajectory)
    leading = torch.broadcast_shapes(*(t.shape[:-2] for t in trajectory.__dict__.values()))
    if len(leading) > 1:
        raise ValueError(
            f"{where}: trajectory must have one leading axis, time, got {tuple(leading)}; of a batch take one scene: "
            "trajectory[:, 0]"
        )
    if leading == (0,):
        raise ValueError(f"{where}: trajectory has no states")
    axes = leading or (1,)
    return trajectory.detach().to(torch.float64)._map(lambda t: t.expand(*axes, *t.shape[-2:]))


def make_recording(
    where: str,
    sim: Simulator,
    trajectory: State | Sequence[State],
    frames: Sequence[int] | IntArray | None = None,
    colors: Mapping[Any, Any] | None = None,
) -> Recording:
    """Some frames of a trajectory, by default all."""
    states = as_trajectory(where, sim, trajectory)
    chosen = np.arange(states.leading_shape[0]) if frames is None else np.asarray(frames)
    states = states[torch.from_numpy(chosen)]
    given = _colors_by_object(where, sim, colors)
    packed = sim._packed
    bodies, nodes = len(packed.names), len(packed.node_position)
    origin = torch.zeros(bodies, 3, dtype=torch.float64)  # there body axes are world axes
    still = State(origin, node_position=torch.zeros(nodes, 3, dtype=torch.float64))
    poses = _energies.pose_matrix(states).numpy()
    parts = []
    for body, name in enumerate(packed.names):
        mesh = sim.mesh(still, body)
        moves = bool(np.ptp(poses[:, body], axis=0).any())
        color = _STILL if packed.kind[body] else _BODIES[body % len(_BODIES)]
        vertices = np.asarray(mesh.vertices)
        if not moves:
            vertices = vertices @ poses[0, body, :3, :3].T + poses[0, body, :3, 3]
        parts.append(
            Part(
                name,
                vertices,
                np.asarray(mesh.faces),
                given.get(body, color),
                poses=np.ascontiguousarray(poses[:, body]) if moves else None,
                smooth=packed.face_count[body] == 0,
                two_sided=not mesh.is_watertight,
            )
        )
    ends = np.cumsum(packed.node_count)
    triangles = np.split(packed.triangles, np.cumsum(packed.triangle_count)[:-1])
    for cloth, name in enumerate(packed.cloth_names):
        x = states.node_position[:, ends[cloth] - packed.node_count[cloth] : ends[cloth]].numpy()
        color = given.get(bodies + cloth, _CLOTH)
        parts.append(Part(name, x[0], triangles[cloth], color, nodes=x, smooth=True, two_sided=True))
    bounds = _bounds(parts, len(chosen))
    ground = _ground(float(packed.ground_height), bounds) if packed.has_ground else None
    return Recording(np.asarray(chosen * sim.dt, dtype=np.float64), parts, ground, bounds)


def _colors_by_object(where: str, sim: Simulator, colors: Mapping[Any, Any] | None) -> dict[int, Color]:
    """From names, handles or indices (bodies first) to indices."""
    names = [*sim.body_names, *sim.cloth_names]
    result = {}
    for key, value in (colors or {}).items():
        if isinstance(key, str):
            if key not in names:
                raise ValueError(f"{where}: colors: no object is named {key!r}; there are {', '.join(names)}")
            index = names.index(key)
        else:
            index = sim._object(where, key)
        rgb = np.asarray(value, dtype=np.float64)
        if rgb.shape != (3,) or rgb.min() < 0.0 or rgb.max() > 1.0:
            raise ValueError(f"{where}: colors: {key!r} must have red, green and blue from 0 to 1, got {value!r}")
        result[index] = (float(rgb[0]), float(rgb[1]), float(rgb[2]))
    return result


def _bounds(parts: Sequence[Part], frames: int) -> FloatArray:
    """Of all that is ever there. The first, the last and some frames between them serve: it is for the camera."""
    some = np.unique(np.linspace(0, frames - 1, 60).astype(int))
    boxes = []
    for part in parts:
        seen = some if part.poses is not None or part.nodes is not None else some[:1]
        for frame in seen:
            x = part.at(int(frame))
            boxes.append((x.min(axis=0), x.max(axis=0)))
    if not boxes:
        return np.array([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]])
    low, high = (np.stack(column) for column in zip(*boxes))
    return np.stack([low.min(axis=0), high.max(axis=0)])


def _ground(height: float, bounds: FloatArray) -> Part:
    pad = 0.15 * max(float((bounds[1] - bounds[0]).max()), 1e-9)
    (x0, y0), (x1, y1) = bounds[0, :2] - pad, bounds[1, :2] + pad
    corners = np.array([[x0, y0, height], [x1, y0, height], [x1, y1, height], [x0, y1, height]])
    return Part("ground", corners, np.array([[0, 1, 2], [0, 2, 3]]), _GROUND, two_sided=True)
