"""An arrow as a mesh."""

from __future__ import annotations

from typing import Any

import numpy as np

from ._recording import FloatArray

WIDTH = 0.012  # of a head, of what a recording shows
_SIDES, _SHAFT, _NECK = 4, 0.35, 0.65  # radius of the shaft over the head's; where the head begins


def unit_arrow() -> tuple[FloatArray, Any]:
    """Along z from the origin, of length 1, its head of width 1: vertices (n, 3) and faces (m, 3)."""
    angles = np.arange(_SIDES) * 2.0 * np.pi / _SIDES
    circle = 0.5 * np.stack([np.cos(angles), np.sin(angles), np.zeros(_SIDES)], axis=1)
    neck = [0.0, 0.0, _NECK]
    vertices = np.concatenate([_SHAFT * circle, _SHAFT * circle + neck, circle + neck, [[0.0, 0.0, 1.0]]])
    faces = []
    for a in range(_SIDES):
        b = (a + 1) % _SIDES
        for ring in (0, _SIDES):  # the shaft, then the lower side of the head
            faces += [[a + ring, b + ring, b + ring + _SIDES], [a + ring, b + ring + _SIDES, a + ring + _SIDES]]
        faces.append([a + 2 * _SIDES, b + 2 * _SIDES, 3 * _SIDES])
    return vertices, np.array(faces)


def turns(vectors: FloatArray) -> FloatArray:
    """Rotations of z into the directions of vectors, shapes (..., 3) and (..., 3, 3); of no vector, none."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    z = np.where(length > 0.0, vectors / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])
    x = np.cross(np.where(np.abs(z[..., 1:2]) < 0.9, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]), z)
    x /= np.linalg.norm(x, axis=-1, keepdims=True)
    return np.stack([x, np.cross(z, x), z], axis=-1)


def scales(vectors: FloatArray, width: float) -> FloatArray:
    """Of a unit arrow across, across and along to the length of each vector, and of none where that is zero."""
    length = np.linalg.norm(vectors, axis=-1)
    across = np.where(length > 0.0, width, 0.0)
    return np.stack([across, across, length], axis=-1)
