"""Recordings by the suffix of their file, and in a notebook."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .._arguments import positive
from .._check import check_count
from .._inputs import Controls
from .._progress import progress_bar
from ..simulator import Simulator
from ..state import State
from ._draw import Camera
from ._film import write_film
from ._forces import with_forces
from ._gltf import write_glb
from ._html import html_page, make_plot
from ._recording import IntArray, as_trajectory, make_recording
from ._rerun import write_rrd

_FILMS = (".mp4", ".gif", ".webp")
_SUFFIXES = (".html", ".glb", *_FILMS, ".rrd")
_FPS = {".gif": 20.0, ".webp": 20.0, ".mp4": 25.0}
_TURNABLE_FPS = 60.0  # of recordings whose player goes smoothly from one frame to the next
_LONG = 50  # frames of a film that take a while to draw


def record(
    sim: Simulator,
    trajectory: State | Sequence[State],
    path: str | Path,
    *,
    speed: float = 1.0,
    fps: float | None = None,
    colors: Mapping[Any, Sequence[float]] | None = None,
    camera: Camera | None = None,
    contacts: bool = False,
    controls: Controls = None,
    force_scale: float | None = None,
    size: tuple[int, int] = (800, 500),
    progress: bool | None = None,
) -> Path:
    """Write what happened in a simulation into a file, of a kind that its suffix says.

    * ``.html``: one file for any browser, without network, to play, to scrub through and to turn around (by k3d).
    * ``.glb``: an animated glTF 2.0 file for Blender, Unity, web pages and others (needs no package).
    * ``.rrd``: for the Rerun viewer (``pip install 'mesh-diffsim[rerun]'``).
    * ``.mp4``, ``.gif``, ``.webp``: a film (by matplotlib; what interlocks may be drawn in the wrong order).

    Spheres and capsules are shown with facets, everything else with its mesh; margins and thickness are not drawn.

    Args:
        sim: What stepped the states.
        trajectory: One state, or states with a leading time axis and no batch axis, or a sequence of single states,
            `sim.dt` apart; the first is shown at time 0. `Simulator.rollout` leaves out the state it starts from.
        path: File to write; folders above it are made.
        speed: How many seconds of the simulation pass in one of the recording (.rrd: it is set in the player).
        fps: Frames per second of the recording. Each shows the nearest state. Default: 25, in .gif and .webp 20; all
            states, but at most 60, where the player goes smoothly from one to the next (.html, .glb) or picks
            its own (.rrd).
        colors: Red, green and blue from 0 to 1 by name or handle, of objects that shall not have the default colour.
        camera: Where a film is seen from, and a page at first. Default: `Camera()`.
        contacts: Whether to show contact forces: an arrow from where a contact pushes, for each object that can move.
            In a frame they are those of the step that ended there, which is taken again by `sim.contacts`; before the
            first state nothing is known, and it shows those of the step from it. Objects become half transparent;
            films draw arrows over everything instead.
        controls: What drove the steps, if anything did: one Control that was held, or a sequence or leading axis of
            them, with one for each state (what `rollout` was given for the trajectory it returned) or for each step
            between two states. Only contacts ask for it.
        force_scale: Length of an arrow by its force [m/N]. Default: as fits the scene; impacts, whose force is large,
            are cut at half its size.
        size: Of a film [pixels].
        progress: Whether to show a bar. Default: for films of more than 50 frames.
    Returns: The path.
    Raises: ValueError for another suffix, states that are not of this scene, or a batch; TypeError for arguments of the
        wrong type; ModuleNotFoundError, with the command that mends it, for a package that is missing.
    """
    where = "viewer.record"
    path = Path(path)
    if path.suffix not in _SUFFIXES:
        raise ValueError(f"{where}: path must end in one of {', '.join(_SUFFIXES)}, got {str(path)!r}")
    speed = positive(speed, f"{where}: speed", "s per s")
    film = path.suffix in _FILMS
    states = as_trajectory(where, sim, trajectory)
    rate = positive(_FPS.get(path.suffix, _TURNABLE_FPS) if fps is None else fps, f"{where}: fps", "1/s")
    frames = _frames(states.leading_shape[0], sim.dt * rate / speed)
    if not film:
        frames = np.unique(frames)
    recording = make_recording(where, sim, states, frames, colors)
    if contacts:
        recording = with_forces(where, recording, sim, states, frames, controls, force_scale)
    camera = camera or Camera()
    path.parent.mkdir(parents=True, exist_ok=True)
    if film:
        width, height = (check_count(where, "size", n) for n in size)
        shown = len(frames) > _LONG if progress is None else progress
        with progress_bar(len(frames), shown, path.name, "frame") as tell:
            write_film(recording, path, rate, camera, (width, height), tell)
    elif path.suffix == ".glb":
        write_glb(recording, path, speed)
    elif path.suffix == ".rrd":
        write_rrd(recording, path)
    else:
        path.write_text(html_page(recording, camera, speed, where), encoding="utf-8")
    return path


def show(
    sim: Simulator,
    trajectory: State | Sequence[State],
    *,
    speed: float = 1.0,
    colors: Mapping[Any, Sequence[float]] | None = None,
    camera: Camera | None = None,
    contacts: bool = False,
    controls: Controls = None,
    force_scale: float | None = None,
    height: int = 420,
) -> Any:
    """Show a trajectory in a notebook, to play and to turn around.

    Args:
        sim: As for `record`, like all that is not said here.
        trajectory: As for `record`.
        speed: As for `record`.
        colors: As for `record`.
        camera: As for `record`.
        contacts: As for `record`.
        controls: As for `record`.
        force_scale: As for `record`.
        height: Of the picture [pixels].
    Returns: An object that a notebook displays when it is the last of a cell.
    Raises: As `record`.
    """
    where = "viewer.show"
    states = as_trajectory(where, sim, trajectory)
    frames = np.unique(_frames(states.leading_shape[0], sim.dt * _TURNABLE_FPS / speed))
    recording = make_recording(where, sim, states, frames, colors)
    if contacts:
        recording = with_forces(where, recording, sim, states, frames, controls, force_scale)
    return make_plot(recording, camera or Camera(), speed, height, where)


def _frames(states: int, frames_per_state: float) -> IntArray:
    """Indices of the states that a recording shows, the first and the last among them."""
    count = max(round((states - 1) * frames_per_state), 1) + 1
    return np.minimum(np.round(np.arange(count) / frames_per_state).astype(np.int64), states - 1)
