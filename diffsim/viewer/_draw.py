"""Still pictures by matplotlib: flat-shaded triangles, sorted from far to near."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from .._extras import require
from .._inputs import Controls
from ..simulator import Simulator
from ..state import State
from ._forces import with_forces
from ._recording import ARROWS, Arrows, FloatArray, Part, as_trajectory, make_recording

LIGHT = np.array([-0.35, -0.55, 1.0]) / np.linalg.norm([-0.35, -0.55, 1.0])
_BACKGROUND, _SHADOW = np.array([0.955, 0.955, 0.965]), np.array([0.86, 0.86, 0.885])
# Triangles longer than this part of the picture are split, so that sorting them by their middles is right.
_SPLIT = 0.05
# Of lines between triangles of cloth; of those that close seams, so wide that nothing shines through from behind [pt].
_EDGE, _SEAM = 0.25, 0.6
_PAD = 0.06  # around what is drawn, of its longer side


@dataclass(frozen=True)
class Camera:
    """Orthographic, looking from these angles: azimuth about z from the x axis, elevation above the xy plane [degrees].

    Recordings that can be turned (.html) start from there, in perspective.
    """

    azimuth: float = -60.0
    elevation: float = 20.0

    def axes(self) -> FloatArray:
        """Unit vectors to the right, up and towards the camera, in world axes, shape (3, 3), a row each."""
        ca, sa, ce, se = (f(math.radians(x)) for x in (self.azimuth, self.elevation) for f in (math.cos, math.sin))
        return np.array([[-sa, ca, 0.0], [-ca * se, -sa * se, ce], [ca * ce, sa * ce, se]])

    def project(self, points: ArrayLike) -> FloatArray:
        """World points, shape (..., 3), to (right, up, towards the camera), same shape [m]."""
        return np.asarray(np.asarray(points) @ self.axes().T)


@dataclass(frozen=True)
class Item:
    """A mesh to draw: what `Simulator.mesh` returns, or anything else with `vertices` in world axes and `faces`.

    Args:
        mesh: Closed, its faces outwards, unless `two_sided`.
        color: Red, green and blue from 0 to 1.
        alpha: Opacity.
        two_sided: Seen from both sides, as cloth is.
        edges: Whether the lines between triangles show.
    """

    mesh: Any
    color: Sequence[float]
    alpha: float = 1.0
    two_sided: bool = False
    edges: bool = False


def draw_items(
    axes: Any,
    items: Sequence[Item],
    camera: Camera | None = None,
    *,
    shadows: bool = True,
    ground_height: float = 0.0,
    split: float | None = None,
) -> None:
    """Draw meshes into matplotlib axes, whose limits they set.

    Args:
        axes: Of matplotlib.
        items: All that shall hide each other: what is drawn later lies on top.
        camera: Default: `Camera()`.
        shadows: Whether things throw shadows on the ground.
        ground_height: Where that is [m].
        split: Triangles longer than this are split [m], since each is drawn wholly before or behind another. Default: a
            twentieth of the picture.
    """
    camera = camera or Camera()
    corners = [camera.project(item.mesh.vertices)[:, :2] for item in items]
    low, high = np.min([c.min(axis=0) for c in corners], axis=0), np.max([c.max(axis=0) for c in corners], axis=0)
    longer = float((high - low).max())
    pieces = [_pieces(item, _SPLIT * longer if split is None else split) for item in items]
    paint(axes, items, pieces, camera, ground_height if shadows else None)
    pad = _PAD * longer
    frame(axes, low - pad, high + pad)


def paint(
    axes: Any,
    items: Sequence[Item],
    pieces: Sequence[tuple[FloatArray, Any]],
    camera: Camera,
    ground_height: float | None,
) -> None:
    """Put shadows, if there is a ground, and the sorted triangles of (vertices, faces) of each item into the axes."""
    collections = require("matplotlib.collections", "viewer", "diffsim.viewer")
    triangles, fills, lines = [], [], []
    for item, (vertices, faces) in zip(items, pieces, strict=True):
        if ground_height is not None:
            above = np.maximum(vertices[:, 2:] - ground_height, 0.0)
            fall = camera.project(vertices - above * LIGHT / LIGHT[2])[:, :2]
            axes.add_collection(
                collections.PolyCollection(fall[faces], facecolors=_SHADOW, edgecolors=_SHADOW, lw=0.3, zorder=1)
            )
        triangle, fill, line = _shaded(item, vertices[faces], camera)
        triangles.append(triangle)
        fills.append(fill)
        lines.append(line)
    triangle, fill, line = (np.concatenate(parts) for parts in (triangles, fills, lines))
    order = np.argsort(triangle[..., 2].mean(axis=1), kind="stable")
    widths = np.where((line == fill).all(axis=1), _SEAM, _EDGE)[order]
    axes.add_collection(
        collections.PolyCollection(
            triangle[order][..., :2],
            facecolors=fill[order],
            edgecolors=line[order],
            lw=widths,
            joinstyle="round",
            zorder=2,
        )
    )


def frame(axes: Any, low: FloatArray, high: FloatArray) -> None:
    """Limits, and nothing but the picture."""
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", facecolor=_BACKGROUND)
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)


def paint_arrows(axes: Any, arrows: Arrows, camera: Camera, alpha: float = 1.0) -> None:
    """Put contact forces into the axes, over everything."""
    if len(arrows.starts):
        starts, vectors = camera.project(arrows.starts), camera.project(arrows.vectors)
        axes.quiver(
            *starts[:, :2].T,
            *vectors[:, :2].T,
            angles="xy",
            scale_units="xy",
            scale=1.0,
            width=0.004,
            color=ARROWS,
            alpha=alpha,
            zorder=3,
        )


def split_faces(vertices: FloatArray, faces: Any, longest: float) -> tuple[FloatArray, Any]:
    """The mesh with its long triangles split."""
    import trimesh

    subdivide: Any = trimesh.remesh.subdivide_to_size
    vertices, faces = subdivide(np.asarray(vertices), np.asarray(faces), longest)
    return vertices, faces


def _pieces(item: Item, longest: float) -> tuple[FloatArray, Any]:
    # Cloth is fine enough, and where its edges show they should be its own.
    if item.two_sided:
        return np.asarray(item.mesh.vertices), np.asarray(item.mesh.faces)
    return split_faces(item.mesh.vertices, item.mesh.faces, longest)


def _shaded(item: Item, corners: FloatArray, camera: Camera) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Visible triangles (n, 3, 3) as the camera sees them, and their colours with alpha, of areas and of lines."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    facing = camera.project(normals)[:, 2]
    if item.two_sided:
        normals[facing < 0.0] *= -1.0
        visible = np.ones(len(corners), bool)
    else:
        visible = facing > 0.0
    normals = normals[visible]
    brightness = 0.45 + 0.4 * np.clip(normals @ LIGHT, 0.0, 1.0) + 0.15 * np.clip(normals[:, 2], 0.0, 1.0)
    shade = np.clip(brightness[:, None] * np.asarray(item.color)[:3] * 1.08, 0.0, 1.0)
    alphas = np.full((len(shade), 1), item.alpha)
    # Lines of the area's colour close the seams between triangles; half-transparent ones would show as a net.
    seams = alphas if item.edges or item.alpha == 1.0 else 0.0 * alphas
    fill = np.concatenate([shade, alphas], axis=1)
    line = np.concatenate([shade * (0.75 if item.edges else 1.0), seams], axis=1)
    return camera.project(corners)[visible], fill, line


def picture(
    sim: Simulator,
    trajectory: State | Sequence[State],
    path: str | Path | None = None,
    *,
    count: int = 6,
    times: Sequence[float] | None = None,
    camera: Camera | None = None,
    colors: Mapping[Any, Sequence[float]] | None = None,
    contacts: bool = False,
    controls: Controls = None,
    force_scale: float | None = None,
    axes: Any = None,
    size: tuple[float, float] = (6.4, 4.0),
) -> Any:
    """Several moments of a trajectory in one picture, the earlier ones paler.

    Args:
        sim: What stepped the states.
        trajectory: One state, or states with a leading time axis and no batch axis, or a sequence of single states,
            `sim.dt` apart.
        path: File to write, of any kind matplotlib knows. Default: none.
        count: How many moments, evenly spaced from the first state to the last.
        times: Moments, after the first state [s]; takes the place of `count`. Each shows the nearest state.
        camera: Default: `Camera()`.
        colors: Red, green and blue from 0 to 1 by name or handle, of objects that shall not have the default colour.
        contacts: Whether to show contact forces, as arrows over everything else; see `record`.
        controls: What drove the steps, for contacts; see `record`.
        force_scale: Length of an arrow by its force [m/N]; see `record`.
        axes: Of matplotlib, to draw into. Default: those of a new figure.
        size: Of that figure [inches].
    Returns: The matplotlib figure.
    Raises: TypeError, ValueError for states that are not of this scene, or a batch; ModuleNotFoundError, with the
        command that mends it, without matplotlib.
    """
    where = "viewer.picture"
    figures = require("matplotlib.figure", "viewer", where)
    states = as_trajectory(where, sim, trajectory)
    steps = states.leading_shape[0]
    wanted = np.linspace(0, steps - 1, count) if times is None else np.asarray(times, dtype=np.float64) / sim.dt
    frames = np.unique(np.clip(np.round(wanted).astype(int), 0, steps - 1))
    recording = make_recording(where, sim, states, frames, colors)
    if contacts:
        recording = with_forces(where, recording, sim, states, frames, controls, force_scale)
    camera = camera or Camera()
    items = []
    alphas = 1.0 - 0.72 * np.linspace(1.0, 0.0, len(frames)) if len(frames) > 1 else np.ones(1)
    for index, alpha in enumerate(alphas.tolist()):
        for part in recording.parts:
            still = part.poses is None and part.nodes is None
            if still and index:
                continue
            items.append(item_of(part, index, alpha=1.0 if still else alpha))
    figure = figures.Figure(figsize=size, layout="constrained") if axes is None else axes.figure
    ground = None if recording.ground is None else float(recording.ground.vertices[0, 2])
    if axes is None:
        axes = figure.add_subplot()
    draw_items(axes, items, camera, shadows=ground is not None, ground_height=ground or 0.0)
    for arrows, alpha in zip(recording.arrows or [], alphas.tolist()):
        paint_arrows(axes, arrows, camera, alpha)
        _widen(axes, camera.project(np.concatenate([arrows.starts, arrows.starts + arrows.vectors]))[:, :2])
    if path is not None:
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        _save(figure, path, None)
    figure._repr_png_ = lambda: _png(figure)  # notebooks ask for it; pyplot, which draws there else, is not involved
    return figure


def _widen(axes: Any, points: FloatArray) -> None:
    """So that the picture shows these, too."""
    low, high = np.transpose([axes.get_xlim(), axes.get_ylim()])
    low, high = np.min([low, *points], axis=0), np.max([high, *points], axis=0)
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _save(figure: Any, target: Any, kind: str | None) -> None:
    figure.savefig(target, format=kind, dpi=110, bbox_inches="tight", pad_inches=0.08)


def _png(figure: Any) -> bytes:
    buffer = io.BytesIO()
    _save(figure, buffer, "png")
    return buffer.getvalue()


@dataclass(frozen=True)
class Mesh:
    vertices: FloatArray
    faces: Any


def item_of(part: Part, frame: int, alpha: float = 1.0) -> Item:
    return Item(Mesh(part.at(frame), part.faces), part.color, alpha, part.two_sided, edges=part.nodes is not None)
