"""Do bodies penetrate? Judged without diffsim's own collision code: by ipctk, winding numbers and numpy."""

from __future__ import annotations

from itertools import combinations

import ipctk
import numpy as np
import torch
from numpy.typing import NDArray

import diffsim as ds

FloatArray = NDArray[np.float64]

# Contacts push from the rest distance on, the sum of the margins, and give way by less than this fraction of the
# thickness. With default margins that is when bare meshes meet.
DEEPEST_COMPRESSION = 1.0


def segment_distance(a: FloatArray, b: FloatArray) -> FloatArray:
    """Distance between segments, shapes (..., 2, 3) [m]; zero length is fine."""
    u, v, w = a[..., 1, :] - a[..., 0, :], b[..., 1, :] - b[..., 0, :], a[..., 0, :] - b[..., 0, :]
    uu, uv, vv, uw, vw = ((x * y).sum(-1) for x, y in ((u, u), (u, v), (v, v), (u, w), (v, w)))
    tiny = np.finfo(np.float64).tiny

    def at(s: FloatArray, t: FloatArray) -> FloatArray:
        return np.asarray(np.linalg.norm(w + s[..., None] * u - t[..., None] * v, axis=-1))

    determinant = uu * vv - uv * uv
    s = np.clip((uv * vw - vv * uw) / np.maximum(determinant, tiny), 0.0, 1.0)
    t = np.clip((uv * s + vw) / np.maximum(vv, tiny), 0.0, 1.0)
    s = np.clip((uv * t - uw) / np.maximum(uu, tiny), 0.0, 1.0)
    found = at(s, t)
    for end in (0.0, 1.0):  # parallel segments: one end is among the closest points
        fixed = np.full_like(s, end)
        found = np.minimum(found, at(fixed, np.clip((uv * fixed + vw) / np.maximum(vv, tiny), 0.0, 1.0)))
        found = np.minimum(found, at(np.clip((uv * fixed - uw) / np.maximum(uu, tiny), 0.0, 1.0), fixed))
    return found


def point_triangle_distance(point: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distance of one point from triangles, shapes (3,) and (n, 3, 3) [m]."""
    a, b, c = triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    beside = [(np.cross(q - p, point - p) * normal).sum(1) for p, q in ((a, b), (b, c), (c, a))]
    above = np.abs(((point - a) * normal).sum(1))
    edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)
    to_edges = segment_distance(np.broadcast_to(point, (2, 3)), edges).min(axis=1)
    return np.asarray(np.where(np.min(beside, axis=0) >= 0.0, above, to_edges))


def axis_distance(axis: FloatArray, triangles: FloatArray) -> float:
    """Distance of a segment from triangles that it does not cross, shapes (2, 3) and (n, 3, 3) [m]."""
    edges = np.stack([triangles, np.roll(triangles, -1, axis=1)], axis=2)
    found = [segment_distance(axis, edges).min(), *(point_triangle_distance(x, triangles).min() for x in axis)]
    return float(min(found))


def winding_number(point: FloatArray, triangles: FloatArray) -> float:
    """How often a closed surface goes around a point: 1 inside, 0 outside."""
    corners = triangles - point
    a, b, c = corners.transpose(1, 0, 2)
    la, lb, lc = np.linalg.norm(corners, axis=2).T
    volume = (a * np.cross(b, c)).sum(1)
    angle = la * lb * lc + (a * b).sum(1) * lc + (b * c).sum(1) * la + (c * a).sum(1) * lb
    return float(2.0 * np.arctan2(volume, angle).sum() / (4.0 * np.pi))


class PenetrationCheck:
    """Finds bodies of a scene that are in each other, or in the ground. Bodies that do not yield may overlap."""

    def __init__(self, scene: ds.Scene, thickness: float) -> None:
        p = self._packed = scene.pack(thickness)
        ends, face_ends = np.cumsum(p.vertex_count), np.cumsum(p.face_count)
        self._vertices = [slice(end - count, end) for end, count in zip(ends, p.vertex_count)]
        self._faces = [p.faces[end - count : end] for end, count in zip(face_ends, p.face_count)]
        self._radius = [np.linalg.norm(p.vertices[v], axis=1).max() + m for v, m in zip(self._vertices, p.margin)]
        self._round = [i for i, count in enumerate(p.face_count) if count == 0]
        self._meshes = [i for i, count in enumerate(p.face_count) if count > 0]
        self._collision_meshes: dict[tuple[int, ...], ipctk.CollisionMesh] = {}
        self._dynamic = np.asarray(p.kind == 0)

    def problems(self, sim: ds.Simulator, state: ds.State) -> list[str]:
        """What is wrong with one state, in words; empty if all is well."""
        p = self._packed
        with torch.no_grad():
            world = sim.vertices(state).numpy()
        names, found = p.names, []
        if self._intersect(self._meshes, world):
            found += [
                f"ipctk: {names[i]} and {names[j]} intersect"
                for i, j in combinations(self._meshes, 2)
                if (self._dynamic[i] or self._dynamic[j]) and self._intersect([i, j], world)
            ]
        if p.has_ground:
            for i, name in enumerate(names):
                distance = world[self._vertices[i], 2].min() - p.ground_height
                if self._dynamic[i] and distance < self._least(p.margin[i], p.ground_margin):
                    found.append(f"{name} is {distance:g} m above the ground")
        centre = state.position.detach().numpy()
        for i in range(len(names)):
            for j in range(i):
                if not (self._dynamic[i] or self._dynamic[j]):
                    continue
                if np.linalg.norm(centre[i] - centre[j]) > self._radius[i] + self._radius[j] + p.thickness:
                    continue
                found += self._pair(i, j, world)
        return found

    def _intersect(self, bodies: list[int], world: FloatArray) -> bool:
        if len(bodies) < 2:
            return False
        key = tuple(bodies)
        if key not in self._collision_meshes:
            faces = np.concatenate([self._faces[i] + self._vertices[i].start for i in bodies])
            self._collision_meshes[key] = ipctk.CollisionMesh(self._packed.vertices, ipctk.edges(faces), faces)
        return bool(ipctk.has_intersections(self._collision_meshes[key], world))

    def _least(self, margin_a: float, margin_b: float) -> float:
        total = margin_a + margin_b
        return float(total - DEEPEST_COMPRESSION * min(total, self._packed.thickness))

    def _pair(self, i: int, j: int, world: FloatArray) -> list[str]:
        p, found = self._packed, []
        for a, b in ((i, j), (j, i)):
            if len(self._faces[b]):
                # Surfaces that do not cross: one corner tells whether the whole body is inside.
                winding = winding_number(world[self._vertices[a].start], self._triangles(b, world))
                if winding > 0.5:
                    found.append(f"{p.names[a]} is inside {p.names[b]}")
        if i in self._round or j in self._round:
            distance, least = self._distance(i, j, world), self._least(p.margin[i], p.margin[j])
            if distance < least:
                found.append(f"{p.names[i]} and {p.names[j]}: {distance:g} m between their axes, less than {least:g} m")
        return found

    def _triangles(self, body: int, world: FloatArray) -> FloatArray:
        return np.asarray(world[self._vertices[body]][self._faces[body]])

    def _distance(self, i: int, j: int, world: FloatArray) -> float:
        """Between bare meshes, points or segments, one of which has no faces."""
        if i not in self._round:
            i, j = j, i
        axis = world[self._vertices[i]][[0, -1]]
        if j in self._round:
            return float(segment_distance(axis, world[self._vertices[j]][[0, -1]]))
        return axis_distance(axis, self._triangles(j, world))


class CrossingCheck:
    """Whether triangles of bodies and cloths cross, a node is in the ground, or a sphere or capsule in a cloth.

    Bodies that do not yield may cross each other.
    """

    def __init__(self, scene: ds.Scene, thickness: float) -> None:
        p = self._packed = scene.pack(thickness)
        body_first = np.cumsum(p.vertex_count) - p.vertex_count
        self._first_node = int(sum(p.vertex_count))
        node_first = np.cumsum(p.node_count) - p.node_count + self._first_node
        faces = p.faces.reshape(-1, 3) + np.repeat(body_first, p.face_count)[:, None]
        owner = np.repeat(np.arange(len(p.names)), p.face_count)
        self._triangles = p.triangles + np.repeat(node_first, p.triangle_count)[:, None]
        yielding = np.asarray(p.kind)[owner] == 0
        moving = np.concatenate([faces[yielding], self._triangles])
        rest = np.concatenate([p.vertices, p.node_rest])
        self._meshes = []
        for body in np.unique(owner[~yielding]) if not yielding.all() else [-1]:
            together = np.concatenate([moving, faces[owner == body]]).astype(np.int32)
            self._meshes.append(ipctk.CollisionMesh(rest, ipctk.edges(together), together))
        self._round = [
            (body, slice(first, first + count))
            for body, (first, count) in enumerate(zip(body_first, p.vertex_count))
            if p.face_count[body] == 0
        ]

    def problems(self, sim: ds.Simulator, state: ds.State) -> list[str]:
        """What is wrong with one state, in words; empty if all is well."""
        p, found = self._packed, []
        with torch.no_grad():
            world = sim.vertices(state).numpy()
        if not np.isfinite(world).all():
            return ["not finite"]
        if any(ipctk.has_intersections(mesh, world) for mesh in self._meshes):
            found.append("ipctk: surfaces intersect")
        nodes = world[self._first_node :]
        free = np.asarray(p.pinned) == 0
        if p.has_ground and nodes[free, 2].min(initial=np.inf) <= p.ground_height:
            found.append(f"a node is {nodes[free, 2].min() - p.ground_height:g} m above the ground")
        for body, vertices in self._round:
            distance = axis_distance(world[vertices][[0, -1]], world[self._triangles])
            # Contact gives way by less than the thickness, of which the cloth's margin is half.
            if distance < p.margin[body] - 0.5 * p.thickness:
                found.append(f"{p.names[body]} is {distance:g} m from a triangle, less than its radius")
        return found
