"""Distances and containment for points, segments and triangles, vectorised. No gradients: for checks at set-up only."""

from __future__ import annotations

import numpy as np

from ._mass_properties import FloatArray

_CHUNK = 1 << 14  # point-triangle pairs held at a time: their intermediate results fit into the cache


def winding_number(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """How often a closed surface winds around each point: 1 inside, 0 outside, for surfaces oriented outwards.

    Args:
        points: Shape (n, 3).
        triangles: Corners, shape (m, 3, 3).
    Returns: Shape (n,).
    """
    result = np.empty(len(points))
    corners = np.ascontiguousarray(triangles.transpose(1, 2, 0))  # by corner and coordinate: long rows are fast
    rows = max(1, _CHUNK // max(1, len(triangles)))
    for begin in range(0, len(points), rows):
        a, b, c = corners[:, :, None] - points[begin : begin + rows].T[None, :, :, None]
        la, lb, lc = np.sqrt(_dot(a, a)), np.sqrt(_dot(b, b)), np.sqrt(_dot(c, c))
        # Solid angle Ω of a triangle seen from the origin:
        # tan(Ω/2) = a·(b × c) / (|a||b||c| + (a·b)|c| + (b·c)|a| + (c·a)|b|)
        numerator = (
            a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) + a[2] * (b[0] * c[1] - b[1] * c[0])
        )
        denominator = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
        result[begin : begin + rows] = np.arctan2(numerator, denominator).sum(axis=1) / (2.0 * np.pi)
    return result


def _dot(u: FloatArray, v: FloatArray) -> FloatArray:
    """Of vectors whose coordinates are the leading axis."""
    return np.asarray(u[0] * v[0] + u[1] * v[1] + u[2] * v[2])


def point_triangle_distance(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distance of points (..., 3) to triangles (..., 3, 3) that broadcast against each other, shape (...)."""
    a, b, c = triangles[..., 0, :], triangles[..., 1, :], triangles[..., 2, :]
    normal = np.cross(b - a, c - a)
    height = np.einsum("...i,...i->...", points - a, normal) / np.linalg.norm(normal, axis=-1)
    inside = np.ones(height.shape, dtype=bool)
    edges = np.full(height.shape, np.inf)
    for p, q in ((a, b), (b, c), (c, a)):
        inside &= np.einsum("...i,...i->...", np.cross(normal, q - p), points - p) >= 0.0
        edges = np.minimum(edges, _point_segment_distance(points, p, q))
    return np.where(inside, np.abs(height), edges)


def _point_segment_distance(points: FloatArray, p: FloatArray, q: FloatArray) -> FloatArray:
    edge, offset = q - p, points - p
    length_sq = np.einsum("...i,...i->...", edge, edge)
    t = np.einsum("...i,...i->...", offset, edge) / np.where(length_sq > 0.0, length_sq, 1.0)
    return np.asarray(np.linalg.norm(offset - np.clip(t, 0.0, 1.0)[..., None] * edge, axis=-1))


def segment_segment_distance(p0: FloatArray, p1: FloatArray, q0: FloatArray, q1: FloatArray) -> FloatArray:
    """Distance of segments p0-p1 and q0-q1; either may be a single point. Shapes (..., 3) broadcast; result (...)."""
    u, v, w = p1 - p0, q1 - q0, p0 - q0
    uu, uv, vv = (np.einsum("...i,...i->...", x, y) for x, y in ((u, u), (u, v), (v, v)))
    uw, vw = np.einsum("...i,...i->...", u, w), np.einsum("...i,...i->...", v, w)
    safe_uu, safe_vv = np.where(uu > 0.0, uu, 1.0), np.where(vv > 0.0, vv, 1.0)
    cross_sq = uu * vv - uv * uv
    # The closest points of the two lines if they are not parallel; then, clamped, the best on each for the other. For
    # parallel segments any start is as good as another once both ends have been tried.
    best = np.full(np.broadcast_shapes(uu.shape, vv.shape, uw.shape), np.inf)
    interior = np.where(cross_sq > 0.0, (uv * vw - vv * uw) / np.where(cross_sq > 0.0, cross_sq, 1.0), 0.0)
    for start in (np.clip(interior, 0.0, 1.0), np.zeros_like(uu), np.ones_like(uu)):
        t = np.clip((vw + uv * start) / safe_vv, 0.0, 1.0)
        s = np.clip((uv * t - uw) / safe_uu, 0.0, 1.0)
        gap = w + s[..., None] * u - t[..., None] * v
        best = np.minimum(best, np.linalg.norm(gap, axis=-1))
    return best


def segment_triangle_distance(p0: FloatArray, p1: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distance of one segment (3,), (3,), possibly a single point, to each of the triangles (m, 3, 3); shape (m,)."""
    best = np.minimum(point_triangle_distance(p0, triangles), point_triangle_distance(p1, triangles))
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    for q0, q1 in ((a, b), (b, c), (c, a)):
        best = np.minimum(best, segment_segment_distance(p0, p1, q0, q1))
    # The segment pierces the triangle when its ends lie on different sides and the line passes all edges on one side.
    normal = np.cross(b - a, c - a)
    h0, h1 = np.einsum("fi,fi->f", p0 - a, normal), np.einsum("fi,fi->f", p1 - a, normal)
    crossing = h0 * h1 < 0.0
    s = np.where(crossing, h0 / np.where(crossing, h0 - h1, 1.0), 0.0)
    point = p0 + s[:, None] * (p1 - p0)
    for q0, q1 in ((a, b), (b, c), (c, a)):
        crossing &= np.einsum("fi,fi->f", np.cross(normal, q1 - q0), point - q0) >= 0.0
    return np.where(crossing, 0.0, best)


def distance_to_surface(points: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distance of each point (n, 3) to the nearest of the triangles (m, 3, 3), shape (n,)."""
    low, high = triangles.min(axis=1), triangles.max(axis=1)
    result = np.empty(len(points))
    rows = max(1, _CHUNK // max(1, len(triangles)))
    for begin in range(0, len(points), rows):
        some = points[begin : begin + rows, None]
        # No further than the nearest corner: only triangles whose box comes that near are measured.
        bound_sq = np.square(triangles[:, 0] - some).sum(axis=-1).min(axis=1, keepdims=True)
        gap = np.maximum(np.maximum(low - some, some - high), 0.0)
        point, triangle = np.nonzero(np.square(gap).sum(axis=-1) <= bound_sq)
        distance = point_triangle_distance(some[point, 0], triangles[triangle])
        result[begin : begin + rows] = np.minimum.reduceat(distance, np.searchsorted(point, np.arange(len(some))))
    return result
