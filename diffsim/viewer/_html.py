"""Recordings to turn around, in a browser or a notebook: by k3d, bodies moved by matrices and cloth by vertices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._extras import require
from ._arrow import WIDTH, scales, turns, unit_arrow
from ._draw import Camera
from ._recording import ARROWS, Color, Part, Recording

_FIELD_OF_VIEW = 40.0  # [degrees]
_CHANGES = 0.8  # of the time from one frame to the next: until then arrows stay as they are
# Leaves of all controls those of time, and plays.
_PLAY = """
const animation = K3DInstance.timeSeriesAnimationGUI;
if (animation) {
    const controls = animation.parent;
    controls.controllers.forEach((controller) => controller.hide());
    controls.folders.forEach((folder) => { if (folder !== animation) folder.hide(); });
    controls.open();
    animation.open();
    K3DInstance.startAutoPlay();
}
"""


def make_plot(recording: Recording, camera: Camera, speed: float, height: int, where: str) -> Any:
    """The k3d plot of a recording."""
    k3d = require("k3d", "viewer", where)
    plot = k3d.plot(
        height=height,
        camera_auto_fit=False,
        camera_mode="orbit",
        camera_fov=_FIELD_OF_VIEW,
        grid_visible=False,
        axes_helper=0.0,
        time_speed=speed,
        background_color=_packed((1.0, 1.0, 1.0)),
    )
    plot.camera_up_axis = "z"
    distance = 0.62 * recording.size / math.tan(math.radians(0.5 * _FIELD_OF_VIEW))
    eye = recording.centre + distance * camera.axes()[2]
    plot.camera = [*eye.tolist(), *recording.centre.tolist(), 0.0, 0.0, 1.0]
    keys = [f"{time:.9g}" for time in recording.times]
    for part in [*recording.parts, *([] if recording.ground is None else [recording.ground])]:
        plot += _drawable(k3d, part, keys, recording.opacity)
    if recording.arrows is not None and any(len(a.starts) for a in recording.arrows):
        plot += _arrows(k3d, recording)
    return plot


def html_page(recording: Recording, camera: Camera, speed: float, where: str) -> str:
    """A page that needs no other file and no network."""
    plot = make_plot(recording, camera, speed, 512, where)
    page: str = plot.get_snapshot(9, additional_js_code=_PLAY)
    return page


def _drawable(k3d: Any, part: Part, keys: list[str], opacity: float) -> Any:
    mesh = k3d.mesh(
        part.vertices.astype(np.float32),
        part.faces.astype(np.uint32),
        color=_packed(part.color),
        flat_shading=not part.smooth,
        side="double" if part.two_sided else "front",
        opacity=opacity,
        name=part.name,
    )
    if len(keys) > 1 and part.poses is not None:
        mesh.model_matrix = dict(zip(keys, part.poses.astype(np.float32)))
    elif part.poses is not None:
        mesh.model_matrix = part.poses[0].astype(np.float32)
    elif len(keys) > 1 and part.nodes is not None:
        mesh.vertices = dict(zip(keys, part.nodes.astype(np.float32)))
    return mesh


def _arrows(k3d: Any, recording: Recording) -> Any:
    """All arrows as one mesh: vectors of k3d's own know no time.

    The player goes linearly from one frame to the next, but there is nothing between two contacts: each frame's arrows
    stay until shortly before the next.
    """
    starts, vectors = recording.arrows_in_slots()
    vertices, faces = unit_arrow()
    sized = vertices * scales(vectors, WIDTH * recording.size)[:, :, None]
    placed = sized @ turns(vectors).swapaxes(-1, -2) + starts[:, :, None]
    placed = placed.reshape(len(starts), -1, 3).astype(np.float32)
    faces = faces + len(vertices) * np.arange(starts.shape[1])[:, None, None]
    mesh = k3d.mesh(
        placed[0],
        faces.reshape(-1, 3).astype(np.uint32),
        color=_packed(ARROWS),
        flat_shading=True,
        name="contact forces",
    )
    times = recording.times
    if len(times) > 1:
        holds = times[:-1] + _CHANGES * np.diff(times)
        keys = [f"{time:.9g}" for time in (*times, *holds)]
        mesh.vertices = dict(zip(keys, (*placed, *placed[:-1])))
    return mesh


def _packed(color: Color) -> int:
    red, green, blue = (round(255.0 * c) for c in color)
    return red << 16 | green << 8 | blue
