"""Recordings to turn around, in a browser or a notebook: by k3d, bodies moved by matrices and cloth by vertices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .._extras import require
from ._draw import Camera
from ._recording import Color, Part, Recording

_FIELD_OF_VIEW = 40.0  # [degrees]
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
        plot += _drawable(k3d, part, keys)
    return plot


def html_page(recording: Recording, camera: Camera, speed: float, where: str) -> str:
    """A page that needs no other file and no network."""
    plot = make_plot(recording, camera, speed, 512, where)
    page: str = plot.get_snapshot(9, additional_js_code=_PLAY)
    return page


def _drawable(k3d: Any, part: Part, keys: list[str]) -> Any:
    mesh = k3d.mesh(
        part.vertices.astype(np.float32),
        part.faces.astype(np.uint32),
        color=_packed(part.color),
        flat_shading=not part.smooth,
        side="double" if part.two_sided else "front",
        name=part.name,
    )
    if len(keys) > 1 and part.poses is not None:
        mesh.model_matrix = dict(zip(keys, part.poses.astype(np.float32)))
    elif part.poses is not None:
        mesh.model_matrix = part.poses[0].astype(np.float32)
    elif len(keys) > 1 and part.nodes is not None:
        mesh.vertices = dict(zip(keys, part.nodes.astype(np.float32)))
    return mesh


def _packed(color: Color) -> int:
    red, green, blue = (round(255.0 * c) for c in color)
    return red << 16 | green << 8 | blue
