"""The contact forces of a trajectory's steps, as arrows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from .._arguments import positive
from .._check import check_instance
from .._inputs import Controls
from ..simulator import Simulator
from ..state import Control, State
from ._recording import Arrows, FloatArray, IntArray, Recording

_CHUNK = 64  # steps taken again at a time, as one batch
# By default an arrow is as long as this part of the scene where the force is larger than in 90 of 100 contacts, and at
# most so long: an impact pushes hundreds of times as hard as what rests.
_USUAL, _LONGEST = 0.15, 0.5
_SHORTEST = 1e-3  # of the scene: nobody sees it


def with_forces(
    where: str,
    recording: Recording,
    sim: Simulator,
    states: State,
    frames: IntArray,
    controls: Controls,
    force_scale: float | None,
) -> Recording:
    """The recording with arrows: of the step that ends in each frame, and for the first state of the step from there.

    Args:
        where: Who is asking, for error messages.
        recording: Of those frames.
        sim: What stepped the states; takes the steps again.
        states: All of the trajectory, with one leading axis.
        frames: Indices of the states that are shown.
        controls: See `record`.
        force_scale: Length of an arrow by its force [m/N]. Default: so that they can be seen.
    """
    if force_scale is not None:
        force_scale = positive(force_scale, f"{where}: force_scale", "m/N")
    begins = np.maximum(np.asarray(frames) - 1, 0)
    driving = _driving(where, controls, states.leading_shape[0])
    info = sim.__dict__["_info"]  # looking at steps should not change what the simulator says of its last one
    try:
        found = []
        for first in range(0, len(begins), _CHUNK):
            found += _forces(sim, states, begins[first : first + _CHUNK], driving)
    finally:
        sim.__dict__["_info"] = info
    sizes = np.linalg.norm(np.concatenate([vectors for _, vectors in found]), axis=1)
    longest = np.inf
    if force_scale is None:
        usual = float(np.percentile(sizes, 90.0)) if sizes.any() else 1.0
        force_scale, longest = _USUAL * recording.size / usual, _LONGEST * recording.size
    arrows = [_drawn(*each, force_scale, longest, _SHORTEST * recording.size) for each in found]
    ends = [point for a in arrows for point in (a.starts, a.starts + a.vectors)]
    bounds = np.concatenate([recording.bounds, *ends])
    return replace(recording, arrows=arrows, bounds=np.stack([bounds.min(axis=0), bounds.max(axis=0)]))


def _driving(where: str, controls: Controls, states: int) -> list[Control] | Control | None:
    """Of the step taken from each state but the last, or the same of all."""
    if controls is None:
        return None
    if isinstance(controls, (list, tuple)):
        each = list(controls)
    else:
        check_instance(where, "controls", controls, Control, "be None, a diffsim.Control or a sequence of them")
        assert isinstance(controls, Control)
        axes = {name: t.ndim - 2 for name, t in controls.__dict__.items() if t is not None}
        for name, axis_count in axes.items():
            if axis_count > 1:
                raise ValueError(
                    f"{where}: controls.{name} must have no axis in front but time, got shape"
                    f" {tuple(getattr(controls, name).shape)}; of a batch take one scene"
                )
        if 1 not in axes.values():
            return controls
        count = max(getattr(controls, name).shape[0] for name, axis_count in axes.items() if axis_count)
        whole = controls._map(lambda t: t.expand(count, *t.shape[-2:]))
        each = list(whole)
    if len(each) not in (states, states - 1):
        raise ValueError(
            f"{where}: controls must have an entry for each of the {states} states, of the step that ended there, or"
            f" one for each of the {states - 1} steps between them, got {len(each)}"
        )
    if len(each) == states > 1:
        each = each[1:]
    return each or None


def _forces(
    sim: Simulator, states: State, begins: IntArray, driving: list[Control] | Control | None
) -> list[tuple[FloatArray, FloatArray]]:
    """Where contact pushes what can move, and how hard, (k, 3) each, in the steps from those states."""
    control = Control.stack([driving[k] for k in begins]) if isinstance(driving, list) else driving
    with torch.no_grad():
        contacts = sim.contacts(states[torch.from_numpy(begins)], control)
    packed = sim._packed
    movable = np.array([*(kind == 0 for kind in packed.kind), *(True for _ in packed.cloth_names), False])
    objects, scene = contacts.objects.numpy(), contacts.scene.numpy()
    position, force = contacts.position.numpy(), contacts.force.numpy()
    scenes, points, pushes = [], [], []
    for side, sign in enumerate((1.0, -1.0)):
        keep = movable[objects[:, side]]
        scenes.append(scene[keep])
        points.append(position[keep])
        pushes.append(sign * force[keep])
    of_scene, point, push = (np.concatenate(column) for column in (scenes, points, pushes))
    return [(point[of_scene == k], push[of_scene == k]) for k in range(len(begins))]


def _drawn(points: FloatArray, forces: FloatArray, scale: float, longest: float, shortest: float) -> Arrows:
    vectors = scale * forces
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    vectors *= np.minimum(1.0, longest / np.maximum(length, 1e-300))
    seen = length[:, 0] > shortest
    return Arrows(points[seen], vectors[seen])
