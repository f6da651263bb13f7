"""Recordings for the Rerun viewer (.rrd)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .._extras import require
from ._recording import ARROWS, FloatArray, Part, Recording


def write_rrd(recording: Recording, path: Path) -> None:
    """Bodies as meshes with a transform for each frame, cloth as a mesh for each; on the timeline "time"."""
    rerun = require("rerun", "rerun", "viewer.record")
    stream = rerun.RecordingStream("diffsim")
    stream.save(str(path))
    stream.log("world", rerun.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    parts = [*recording.parts, *([] if recording.ground is None else [recording.ground])]
    for part in parts:
        if part.nodes is None:
            stream.log(f"world/{part.name}", _mesh(rerun, part, part.vertices, recording.opacity), static=True)
    for index, time in enumerate(recording.times):
        stream.set_time("time", duration=float(time))
        for part in parts:
            if part.nodes is not None:
                stream.log(f"world/{part.name}", _mesh(rerun, part, part.nodes[index], recording.opacity))
            elif part.poses is not None:
                pose = part.poses[index]
                stream.log(f"world/{part.name}", rerun.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        if recording.arrows is not None:
            arrows, color = recording.arrows[index], [round(255.0 * c) for c in ARROWS]
            drawn = rerun.Arrows3D(origins=arrows.starts, vectors=arrows.vectors, colors=color)
            stream.log("world/contact_forces", drawn)
    stream.flush()
    stream.disconnect()


def _mesh(rerun: Any, part: Part, vertices: FloatArray, opacity: float) -> Any:
    color = [round(255.0 * c) for c in (*part.color, opacity)]
    return rerun.Mesh3D(
        vertex_positions=vertices.astype(np.float32),
        triangle_indices=part.faces.astype(np.uint32),
        albedo_factor=color,
    )
