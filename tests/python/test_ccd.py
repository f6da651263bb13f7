"""Continuous collision detection against ipctk, planted impacts and sampled distances: never late, never a miss."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from diffsim import _core

ipctk = pytest.importorskip("ipctk")

FloatArray = NDArray[np.float64]

PAIRS = 2000  # of each kind
TOLERANCE = 1e-6  # of impacts, as an absolute distance at positions of size one [m]
# Distances of points of size one that move by one are exact to a few ulps of that, here 4.
ROUNDING = 1e-15
SAMPLES = np.linspace(0.0, 1.0, 6)
MOST_ITERATIONS = 60


@dataclass(frozen=True)
class Pair:
    """Four points at both ends of a step: vertex and triangle, or the ends of two edges."""

    category: str
    start: FloatArray  # (4, 3)
    end: FloatArray
    impact: float | None  # a time at which they touch for sure
    scale: float  # of positions and motions


CATEGORIES = (
    "random",
    "planted",
    "at a corner",
    "sliding",
    "parallel",
    "at rest",
    "fast",
    "far away",
    "sliver",
    "close",
)


def vertex_triangle_weights(rng: np.random.Generator, corner: bool) -> FloatArray:
    weights = rng.dirichlet(np.ones(3))
    if corner:  # of the triangle, or a point on its rim
        weights = np.eye(3)[rng.integers(3)] if rng.random() < 0.5 else np.roll([0.0, *rng.dirichlet(np.ones(2))], 1)
    return np.array([1.0, *(-weights)])


def edge_edge_weights(rng: np.random.Generator, corner: bool) -> FloatArray:
    s, t = rng.random(2)
    if corner:
        s = float(rng.integers(2))
        t = float(rng.integers(2)) if rng.random() < 0.5 else t
    return np.array([1.0 - s, s, -(1.0 - t), -t])


def make_pair(rng: np.random.Generator, category: str, weights: Callable[..., FloatArray]) -> Pair:
    """A pair whose features meet at `impact` if the category says so: `weights` @ points is their offset there."""
    scale, impact = 1.0, None
    start, motion = rng.uniform(-1, 1, (4, 3)), rng.uniform(-1, 1, (4, 3))
    if category == "far away":
        start += 1000.0 * rng.normal(size=3)
        scale = 1000.0
    if category == "fast":
        motion *= 1e4
        scale = 1e4
    if category == "sliver":
        start[3] = start[2] + 1e-4 * rng.normal(size=3)
    if category == "parallel":  # edges, or vertex and face that move in one plane
        direction = rng.normal(size=3)
        start[1] = start[0] + direction
        start[3] = start[2] + direction * rng.uniform(0.3, 2.0)
        motion = np.repeat(motion[:2], 2, axis=0)
    if category == "at rest":
        motion[:] = 0.0
    if category == "sliding":  # without coming nearer: every motion lies in a common plane
        start[:, 2] = np.array([0.02, 0.0, 0.0, 0.0]) if weights is vertex_triangle_weights else [0.02, 0.02, 0.0, 0.0]
        motion[:, 2] = 0.0
    if category in ("planted", "at a corner", "fast", "far away", "sliver", "close"):
        impact = float(rng.random())
        w = weights(rng, category == "at a corner")
        if category == "close":  # and away again: a graze
            motion *= 1e-3
        # Shift the first feature so that the two meet at the impact.
        count = 1 if weights is vertex_triangle_weights else 2
        start[:count] -= w @ (start + impact * motion)
    return Pair(category, start, start + motion, impact, scale)


def vertex_triangle_toi(pair: Pair, min_distance: float, tolerance: float) -> float:
    vertex = np.ascontiguousarray([[pair.start[0], pair.end[0]]])
    start, end = np.ascontiguousarray(pair.start[None, 1:]), np.ascontiguousarray(pair.end[None, 1:])
    toi, iterations = _core.vertex_polygon_ccd(vertex, start, end, min_distance, tolerance)
    assert iterations[0] <= MOST_ITERATIONS
    return float(toi[0])


def edge_edge_toi(pair: Pair, min_distance: float, tolerance: float) -> float:
    ends = (pair.start[:2], pair.end[:2], pair.start[2:], pair.end[2:])
    toi, iterations = _core.edge_edge_ccd(*(np.ascontiguousarray(x[None]) for x in ends), min_distance, tolerance)
    assert iterations[0] <= MOST_ITERATIONS
    return float(toi[0])


def distance(kind: str, pair: Pair, time: float) -> float:
    points = pair.start + time * (pair.end - pair.start)
    function = ipctk.point_triangle_distance if kind == "vertex-triangle" else ipctk.edge_edge_distance
    return float(np.sqrt(function(*points)))


KINDS = {
    "vertex-triangle": (vertex_triangle_weights, vertex_triangle_toi, "point_triangle_ccd"),
    "edge-edge": (edge_edge_weights, edge_edge_toi, "edge_edge_ccd"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_never_late_never_a_miss(kind: str) -> None:
    weights, toi_of, name = KINDS[kind]
    # The iteration limit only makes ipctk give up early, on the safe side; grazing pairs would take it seconds.
    ipc = getattr(ipctk.TightInclusionCCD(tolerance=TOLERANCE, max_iterations=2_000), name)
    rng = np.random.default_rng(0)
    planted = found = early = missed_by_ipc = 0
    for index in range(PAIRS):
        category = CATEGORIES[index % len(CATEGORIES)]
        pair = make_pair(rng, category, weights)
        tolerance, rounding = TOLERANCE * pair.scale, ROUNDING * pair.scale
        toi = toi_of(pair, 0.0, tolerance)
        text = f"{category} pair {index}: {toi}"
        if pair.impact is not None:
            planted += 1
            assert toi <= pair.impact, text
        # Until then they are apart, judged by distances at sampled times. ...
        until = min(toi, 1.0)
        for time in until * SAMPLES[:-1]:
            assert toi == 0.0 or distance(kind, pair, time) > 0.5 * tolerance - 10 * rounding, text
        if np.isfinite(toi):
            # ... and then they nearly touch: a stub that says 0 fails here.
            found += 1
            assert 0.0 <= toi <= 1.0
            early += distance(kind, pair, toi) > 1.01 * tolerance + 10 * rounding
            assert distance(kind, pair, toi) <= 10 * tolerance, text
        hit, ipc_toi = ipc(*pair.start, *pair.end)
        if hit and not np.isfinite(toi):
            # ipctk stays clear of impacts by a margin of its own, so it also stops for near misses: is this one?
            near = min(distance(kind, pair, t) for t in np.clip(ipc_toi + np.linspace(-0.01, 0.3, 60), 0.0, 1.0))
            assert near > 0.5 * tolerance, text
        missed_by_ipc += np.isfinite(toi) and not hit and distance(kind, pair, toi) < 0.1 * tolerance
    assert planted >= 0.5 * PAIRS
    assert planted <= found < PAIRS
    assert missed_by_ipc == 0
    assert early <= 1e-3 * PAIRS  # those that graze may run out of iterations, which is safe


@pytest.mark.parametrize("kind", KINDS)
def test_keeps_a_minimum_distance(kind: str) -> None:
    weights, toi_of, _ = KINDS[kind]
    rng = np.random.default_rng(1)
    found = 0
    for index in range(2000):
        pair = make_pair(rng, CATEGORIES[index % len(CATEGORIES)], weights)
        least = float(10.0 ** rng.uniform(-4, -1)) * pair.scale
        tolerance = 0.01 * least
        toi = toi_of(pair, least, tolerance)
        if distance(kind, pair, 0.0) <= least:
            assert toi == 0.0
            continue
        for time in min(toi, 1.0) * SAMPLES:
            assert distance(kind, pair, time) >= least - 10 * ROUNDING * pair.scale
        if np.isfinite(toi):
            found += 1
            assert distance(kind, pair, toi) <= least + 1.01 * tolerance
    assert found >= 500


@pytest.mark.parametrize("kind", KINDS)
def test_does_not_depend_on_names_or_place(kind: str) -> None:
    """Renamed vertices and rigid motions of the whole pair move the time of impact by its tolerance at most."""
    weights, toi_of, _ = KINDS[kind]
    renamed = [0, 2, 3, 1] if kind == "vertex-triangle" else [2, 3, 1, 0]
    rng = np.random.default_rng(2)
    found = 0
    for _ in range(500):
        pair = make_pair(rng, "planted", weights)
        toi = toi_of(pair, 0.0, TOLERANCE)
        q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
        shift = rng.normal(size=3)
        moved = Pair("moved", pair.start @ q.T + shift, pair.end @ q.T + shift, None, 1.0)
        other = Pair("renamed", pair.start[renamed], pair.end[renamed], None, 1.0)
        for changed in (moved, other):
            again = toi_of(changed, 0.0, TOLERANCE)
            assert np.isfinite(again)
            assert abs(distance(kind, pair, min(again, 1.0)) - distance(kind, pair, toi)) <= 2 * TOLERANCE
        found += toi > 0.0
    assert found >= 450


def test_closed_forms_of_impacts() -> None:
    """A vertex falls on a square, and one edge on another: both bounds."""
    square = np.array([[[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]])
    for height, speed in ((0.5, 1.0), (0.1, 3.0), (2.0, 2.5), (1e-3, 1e3)):
        exact = height / speed
        falling = np.array([[[0.2, -0.3, height], [0.2, -0.3, height - speed]]])
        (toi,), _ = _core.vertex_polygon_ccd(falling, square, square, 0.0, 1e-9)
        assert exact - 1e-9 / speed <= toi <= exact
        a0 = np.array([[[-1.0, 0.1, height], [1.0, 0.1, height]]])
        b = np.array([[[0.3, -1.0, 0.0], [0.3, 1.0, 0.0]]])
        (toi,), _ = _core.edge_edge_ccd(a0, a0 - [0, 0, speed], b, b, 0.0, 1e-9)
        assert exact - 1e-9 / speed <= toi <= exact
    beside = np.array([[[1.5, 0.0, 1.0], [1.5, 0.0, -1.0]]])
    (toi,), _ = _core.vertex_polygon_ccd(beside, square, square, 0.0, 1e-9)
    assert toi == np.inf
