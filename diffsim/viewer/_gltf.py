"""Animated glTF 2.0 (.glb): a node with a track of poses for each body, morph targets for each cloth.

Written here, since what writes meshes to glTF (trimesh) leaves out their motion.
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..rotation import from_matrix
from ._arrow import WIDTH, scales, turns, unit_arrow
from ._recording import ARROWS, Color, FloatArray, Part, Recording

_FLOAT, _UINT32 = 5126, 5125
_TYPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4"}
# glTF's y axis points up: x, y, z of ours are x, -z, y there.
_Z_UP = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # quaternion x, y, z, w


class _Builder:
    """The document, and the bytes its accessors read."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.document: dict[str, list[Any]] = {
            name: [] for name in ("nodes", "meshes", "materials", "accessors", "bufferViews")
        }
        self.samplers: list[dict[str, Any]] = []
        self.channels: list[dict[str, Any]] = []

    def append(self, kind: str, entry: dict[str, Any]) -> int:
        self.document[kind].append(entry)
        return len(self.document[kind]) - 1

    def accessor(self, values: NDArray[Any], bounds: bool = False) -> int:
        """Of an array whose first axis counts elements: float32, or uint32 for indices."""
        component = _UINT32 if values.dtype == np.uint32 else _FLOAT
        values = np.ascontiguousarray(values, dtype=np.uint32 if component == _UINT32 else np.float32)
        view = {"buffer": 0, "byteOffset": len(self.data), "byteLength": values.nbytes}
        self.data += values.tobytes()
        entry: dict[str, Any] = {
            "bufferView": self.append("bufferViews", view),
            "componentType": component,
            "count": len(values),
            "type": _TYPES[values.shape[1:]],
        }
        if bounds:
            entry["min"], entry["max"] = np.atleast_1d(values.min(0)).tolist(), np.atleast_1d(values.max(0)).tolist()
        return self.append("accessors", entry)

    def animate(self, node: int, path: str, times: int, values: NDArray[Any], kind: str = "LINEAR") -> None:
        self.samplers.append({"input": times, "output": self.accessor(values), "interpolation": kind})
        self.channels.append({"sampler": len(self.samplers) - 1, "target": {"node": node, "path": path}})


def write_glb(recording: Recording, path: Path, speed: float) -> None:
    """Write all frames; viewers go linearly from one to the next."""
    builder = _Builder()
    times = builder.accessor(recording.times / speed, bounds=True)
    parts = [*recording.parts, *([] if recording.ground is None else [recording.ground])]
    children = [_add(builder, part, times, recording.opacity) for part in parts]
    children += _add_arrows(builder, recording, times)
    root = builder.append("nodes", {"name": "scene, z up", "rotation": _Z_UP, "children": children})
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "diffsim"},
        "scene": 0,
        "scenes": [{"nodes": [root]}],
        "buffers": [{"byteLength": len(builder.data)}],
        **builder.document,
    }
    if builder.channels:
        document["animations"] = [{"samplers": builder.samplers, "channels": builder.channels}]
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(builder.data), 0x004E4942) + builder.data  # always a multiple of 4 bytes
    path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)


def _add(builder: _Builder, part: Part, times: int, opacity: float) -> int:
    """A node with the part's mesh, and its motion."""
    frames = builder.document["accessors"][times]["count"]
    vertices, faces = part.vertices, part.faces
    primitive: dict[str, Any] = {
        "attributes": {"POSITION": builder.accessor(vertices, bounds=True)},
        "indices": builder.accessor(faces.reshape(-1).astype(np.uint32)),
        "material": builder.append("materials", _material(part.color, opacity, part.two_sided)),
    }
    if part.smooth:  # without normals viewers shade flat
        primitive["attributes"]["NORMAL"] = builder.accessor(_normals(vertices, faces))
    mesh: dict[str, Any] = {"name": part.name, "primitives": [primitive]}
    morphs = part.nodes is not None and frames > 1
    if part.nodes is not None and morphs:
        primitive["targets"] = [{"POSITION": builder.accessor(x - vertices, bounds=True)} for x in part.nodes[1:]]
        mesh["weights"] = [0.0] * (frames - 1)
    node = builder.append("nodes", {"name": part.name, "mesh": builder.append("meshes", mesh)})
    if part.poses is not None:
        turns, places = _quaternions(part.poses[:, :3, :3]), part.poses[:, :3, 3]
        builder.document["nodes"][node].update(rotation=turns[0].tolist(), translation=places[0].tolist())
        if frames > 1:
            builder.animate(node, "rotation", times, turns)
            builder.animate(node, "translation", times, places)
    if morphs:  # the first frame is the mesh itself, each other one wholly its target
        builder.animate(node, "weights", times, np.eye(frames)[:, 1:].reshape(-1))
    return node


def _add_arrows(builder: _Builder, recording: Recording, times: int) -> list[int]:
    """Nodes with one arrow each, which jump from frame to frame, and are of no size where a frame has fewer."""
    starts, vectors = recording.arrows_in_slots()
    if not vectors.size:
        return []
    vertices, faces = unit_arrow()
    primitive = {
        "attributes": {"POSITION": builder.accessor(vertices, bounds=True)},
        "indices": builder.accessor(faces.reshape(-1).astype(np.uint32)),
        "material": builder.append("materials", _material(ARROWS, 1.0, False)),
    }
    mesh = builder.append("meshes", {"name": "contact force", "primitives": [primitive]})
    sizes, nodes = scales(vectors, WIDTH * recording.size), []
    for slot in range(starts.shape[1]):
        turn = _quaternions(turns(vectors[:, slot]))
        now = {"translation": starts[0, slot], "rotation": turn[0], "scale": sizes[0, slot]}
        node = {"name": f"contact force {slot}", "mesh": mesh, **{key: value.tolist() for key, value in now.items()}}
        nodes.append(builder.append("nodes", node))
        if len(starts) > 1:
            for path, values in (("translation", starts[:, slot]), ("rotation", turn), ("scale", sizes[:, slot])):
                builder.animate(nodes[-1], path, times, values, "STEP")
    return nodes


def _material(color: Color, opacity: float, two_sided: bool) -> dict[str, Any]:
    linear = [float(c) for c in np.asarray(color) ** 2.2]  # glTF's factors are not gamma-coded
    surface = {"baseColorFactor": [*linear, opacity], "metallicFactor": 0.0, "roughnessFactor": 0.6}
    mode = {} if opacity == 1.0 else {"alphaMode": "BLEND"}
    return {"pbrMetallicRoughness": surface, "doubleSided": two_sided, **mode}


def _normals(vertices: FloatArray, faces: NDArray[Any]) -> FloatArray:
    """Unit normals of the vertices, weighted by area."""
    corners = vertices[faces]
    of_faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], of_faces)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return np.asarray(np.where(length > 0.0, normals / np.maximum(length, 1e-300), [0.0, 0.0, 1.0]))


def _quaternions(rotations: FloatArray) -> FloatArray:
    """x, y, z, w of rotation matrices (frames, 3, 3), neighbours on the same side of the sphere."""
    turns = np.array(from_matrix(rotations))[:, [1, 2, 3, 0]]
    for index in range(1, len(turns)):
        if turns[index] @ turns[index - 1] < 0.0:
            turns[index] *= -1.0
    return np.asarray(turns)
