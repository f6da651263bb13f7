"""Films (.mp4) and moving pictures (.gif, .webp): frames drawn by matplotlib."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .._extras import require
from ._draw import Camera, frame, item_of, paint, paint_arrows, split_faces
from ._recording import Part, Recording

_DPI = 100.0
_SPLIT = 0.06  # of the box that everything stays in
_PAD = 0.04

Pixels = NDArray[np.uint8]


def write_film(
    recording: Recording,
    path: Path,
    fps: float,
    camera: Camera,
    size: tuple[int, int],
    tell: Callable[[int], object],
) -> None:
    """All frames of the recording, at `fps`."""
    if path.suffix == ".mp4":
        ffmpeg = require("imageio_ffmpeg", "viewer", "viewer.record")  # before the frames are drawn
        width, height = (n + n % 2 for n in size)  # as the codec wants it
        writer = ffmpeg.write_frames(str(path), (width, height), fps=fps, macro_block_size=2, quality=7)
        writer.send(None)
        try:
            for pixels in _frames(recording, camera, (width, height), tell):
                writer.send(np.ascontiguousarray(pixels))
        finally:
            writer.close()
        return
    image = require("PIL.Image", "viewer", "viewer.record")
    pictures = (image.fromarray(pixels) for pixels in _frames(recording, camera, size, tell))
    if path.suffix == ".gif":
        pictures = (picture.quantize(96, dither=image.Dither.NONE) for picture in pictures)
    first = next(pictures)
    first.save(path, save_all=True, append_images=pictures, duration=round(1000.0 / fps), loop=0)


def _frames(
    recording: Recording, camera: Camera, size: tuple[int, int], tell: Callable[[int], object]
) -> Iterator[Pixels]:
    """RGB pictures of shape (height, width, 3)."""
    where = "viewer.record"
    figures = require("matplotlib.figure", "viewer", where)
    agg = require("matplotlib.backends.backend_agg", "viewer", where)
    figure = figures.Figure(figsize=(size[0] / _DPI, size[1] / _DPI), dpi=_DPI)
    canvas = agg.FigureCanvasAgg(figure)
    parts = [_split(part, _SPLIT * recording.size) for part in recording.parts]
    ground = None if recording.ground is None else float(recording.ground.vertices[0, 2])
    corners = camera.project(np.array(list(product(*recording.bounds.T))))[:, :2]
    pad = _PAD * recording.size
    low, high = corners.min(axis=0) - pad, corners.max(axis=0) + pad
    low, high = _widened(low, high, size)
    axes: Any = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    for index, time in enumerate(recording.times):
        axes.clear()
        items = [item_of(part, index) for part in parts]
        paint(axes, items, [(item.mesh.vertices, item.mesh.faces) for item in items], camera, ground)
        if recording.arrows is not None:
            paint_arrows(axes, recording.arrows[index], camera)
        frame(axes, low, high)
        figure.patch.set_facecolor(axes.get_facecolor())
        axes.text(0.015, 0.02, f"{time:.2f} s", transform=axes.transAxes, color="0.45", fontsize=9)
        canvas.draw()
        yield np.asarray(canvas.buffer_rgba())[..., :3].copy()
        tell(1)


def _split(part: Part, longest: float) -> Part:
    """The part with its long triangles split, once for all frames."""
    if part.nodes is not None:
        return part
    vertices, faces = split_faces(part.vertices, part.faces, longest)
    return replace(part, vertices=vertices, faces=faces)


def _widened(low: Any, high: Any, size: tuple[int, int]) -> tuple[Any, Any]:
    """The rectangle of the picture's shape around a rectangle."""
    span = np.maximum(high - low, 1e-9)
    scale = float((span / np.asarray(size)).max())
    middle, half = 0.5 * (low + high), 0.5 * scale * np.asarray(size)
    return middle - half, middle + half
