"""Continuous collision detection against ipctk's additive CCD and tight inclusion, on the same queries in one run.

Half of each family's queries are a vertex and a triangle, half two edges, with features of size 1 (1e-6 in "tiny")
and a minimum distance of 1e-3 of that; all start beyond it. One CSV line per family: time per query, the most advances
one of ours took, and of each: misses (an impact not found, or found later than it is), false positives (impacts where
the minimum distance is kept all the way), and how early true impacts are found, as the median part of the way to them
that is lost. What is true is judged by distances at sampled times, refined by bisection.

Ours are timed in one call for all queries of a kind, the passage of the arrays included. ipctk has no such call, so the
time of a query without motion, far apart, is measured in the same loop and taken off; at least 0.01 us is left. Its
methods stop after 2,000 iterations (10 million by default), which is on the safe side. Needs the extra
`bench`.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import ipctk
import numpy as np
from _common import Table, in_turns, make_parser, median_ratio, print_header, repeated
from numpy.typing import NDArray

from diffsim import _core

FloatArray = NDArray[np.float64]

MIN_DISTANCE = 1e-3  # of the features' size
TOLERANCE = 1e-5
MAX_ITERATIONS = 2_000
QUERIES = 50  # of each kind
OUR_REPEATS = 20  # of a call, which takes less than a clock tells
SAMPLES = 200
LEAST_US = 0.01
KINDS = ("vertex_triangle", "edge_edge")
PEERS = ("additive", "inclusion")


@dataclass(frozen=True)
class Queries:
    """Of one kind: four points each, a vertex and a triangle or the ends of two edges, at both ends of the motion."""

    kind: str
    start: FloatArray  # (n, 4, 3)
    end: FloatArray
    scale: float = 1.0

    @property
    def split(self) -> int:
        return 1 if self.kind == "vertex_triangle" else 2

    def distance(self, index: int, time: float) -> float:
        points = (1.0 - time) * self.start[index] + time * self.end[index]
        function = ipctk.point_triangle_distance if self.split == 1 else ipctk.edge_edge_distance
        return float(np.sqrt(function(*points)))


# ---- families --------------------------------------------------------------------------------------------------------


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def rotation(rng: np.random.Generator, angle: float) -> FloatArray:
    axis = rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def near(rng: np.random.Generator, split: int, gap: float) -> FloatArray:
    """Features in planes of constant z, this far apart."""
    if split == 1:
        angles = 2 * np.pi / 3 * (np.arange(3) + rng.uniform(0, 0.5, 3))
        triangle = np.stack([np.cos(angles), np.sin(angles), np.zeros(3)], axis=1)
        return np.concatenate([[[0.0, 0.0, gap]], triangle])
    points = []
    for height in (gap, 0.0):
        angle, part = rng.uniform(0, 6), rng.uniform(0, 1)
        edge = np.array([np.cos(angle), np.sin(angle), 0.0])
        points += [-part * edge, (1 - part) * edge]
        points[-1][2] = points[-2][2] = height
    return np.array(points)


Motion = tuple[FloatArray, FloatArray]


def sliding(rng: np.random.Generator, split: int) -> Motion:
    """Along each other, just above the minimum distance."""
    start = near(rng, split, MIN_DISTANCE + TOLERANCE * log_uniform(rng, 1.5, 100.0))
    end = start.copy()
    end[:split, :2] += log_uniform(rng, 0.1, 10.0) * rng.uniform(-1, 1, 2)
    return start, end


def turning(rng: np.random.Generator, split: int) -> Motion:
    """Together, as one body, on the chords of a turn; nearer by what chords leave of arcs, if at all."""
    start = near(rng, split, MIN_DISTANCE * log_uniform(rng, 1.02, 3.0))
    return start, start @ rotation(rng, rng.uniform(0, 1)).T + rng.uniform(-1, 1, 3)


def grazing(rng: np.random.Generator, split: int) -> Motion:
    """Past each other at a speed of 100, nearest in the middle, 1.5 to 100 tolerances above or below the least."""
    side = 1.0 if rng.random() < 0.5 else -1.0
    middle = near(rng, split, MIN_DISTANCE + side * min(TOLERANCE * log_uniform(rng, 1.5, 100.0), 0.9 * MIN_DISTANCE))
    velocity = rng.uniform(-0.3, 0.3, (4, 3))
    velocity[:split] += (100.0, 50.0, 0.0)
    return middle - 0.5 * velocity, middle + 0.5 * velocity


def near_parallel(rng: np.random.Generator, split: int) -> Motion:
    """Edges turned by 1e-9 to 1e-2 against each other; faces and vertices that move along them but for as much."""
    skew = log_uniform(rng, 1e-9, 1e-2)
    start = near(rng, split, MIN_DISTANCE * log_uniform(rng, 1.1, 10.0))
    if split == 2:
        start[1, :2] = start[0, :2] + (start[3] - start[2])[:2]
    start[1:] += skew * rng.uniform(-1, 1, (3, 3))
    end = start + skew * rng.uniform(-1, 1, (4, 3))
    end[:split] += (*rng.uniform(-1, 1, 2), 0.0)
    return start, end


def fast(rng: np.random.Generator, split: int) -> Motion:
    """Ten thousand times their size, aimed at each other in half of the cases."""
    start = rng.uniform(-1, 1, (4, 3))
    velocity = 1e4 * rng.uniform(-1, 1, 3) + rng.uniform(-1, 1, (4, 3)) * (np.arange(4) < split)[:, None]
    velocity[split:] -= velocity[0]
    aim = rng.uniform(0, 1) if rng.random() < 0.5 else 0.0
    if aim:
        start[:split] += (start + aim * velocity)[-1] - (start + aim * velocity)[0]
    return start, start + velocity


def impacts(rng: np.random.Generator, split: int) -> Motion:
    """Meeting somewhere on the way."""
    start, velocity = rng.uniform(-1, 1, (4, 3)), rng.uniform(-1, 1, (4, 3))
    s, t = rng.uniform(0, 1, 2)
    weights = (1.0, -(1 - s), -s * t, -s * (1 - t)) if split == 1 else (1 - s, s, -(1 - t), -t)
    start[:split] -= np.array(weights) @ (start + rng.uniform(0.1, 1) * velocity)
    return start, start + velocity


def no_impact(rng: np.random.Generator, split: int) -> Motion:
    """Anywhere in a box of their size, moving by as much."""
    start = rng.uniform(-1, 1, (4, 3))
    start[:split] += 1.5 * rng.normal(size=3)
    return start, start + rng.uniform(-0.5, 0.5, (4, 3))


def tiny(rng: np.random.Generator, split: int) -> Motion:
    """Falling together by a thousand times their size, tumbling, one into the other."""
    start = near(rng, split, MIN_DISTANCE * log_uniform(rng, 1.1, 100.0))
    end = start @ rotation(rng, rng.uniform(0, 2)).T + (0.0, 0.0, -1000.0)
    end[:split] += rng.uniform(-1, 1, 3)
    return start, end


Family = Callable[[np.random.Generator, int], Motion]
FAMILIES: dict[str, tuple[Family, float, float]] = {  # with the features' size and their distance from the origin
    "impacts": (impacts, 1.0, 0.0),
    "no_impact": (no_impact, 1.0, 0.0),
    "sliding": (sliding, 1.0, 0.0),
    "turning": (turning, 1.0, 0.0),
    "grazing": (grazing, 1.0, 0.0),
    "near_parallel": (near_parallel, 1.0, 0.0),
    "fast": (fast, 1.0, 0.0),
    "tiny": (tiny, 1e-6, 0.0),
    "far": (impacts, 1.0, 1e4),
}


def make_queries(name: str, kind: str, count: int) -> Queries:
    family, scale, far = FAMILIES[name]
    split = 1 if kind == "vertex_triangle" else 2
    rng = np.random.default_rng(list(FAMILIES).index(name) * 2 + split)
    starts, ends = [], []
    while len(starts) < count:
        start, end = (scale * x @ turn + far for turn in [rotation(rng, 1.0)] for x in family(rng, split))
        if Queries(kind, start[None], end[None]).distance(0, 0.0) > (MIN_DISTANCE + TOLERANCE) * scale:
            starts.append(start)
            ends.append(end)
    return Queries(kind, np.array(starts), np.array(ends), scale)


# ---- who answers -----------------------------------------------------------------------------------------------------


def our_call(queries: Queries) -> Callable[[], tuple[FloatArray, NDArray[np.int64]]]:
    """Of times of impact (n,) and advances (n,)."""
    least, tolerance = MIN_DISTANCE * queries.scale, TOLERANCE * queries.scale
    a0, a1 = (np.ascontiguousarray(x[:, : queries.split]) for x in (queries.start, queries.end))
    b0, b1 = (np.ascontiguousarray(x[:, queries.split :]) for x in (queries.start, queries.end))
    if queries.split == 1:
        vertex = np.concatenate([a0, a1], axis=1)
        return lambda: _core.vertex_polygon_ccd(vertex, b0, b1, least, tolerance)
    return lambda: _core.edge_edge_ccd(a0, a1, b0, b1, least, tolerance)


def peer_calls(queries: Queries, peer: str) -> Callable[[], list[tuple[bool, float]]]:
    if peer == "additive":
        method = ipctk.AdditiveCCD(max_iterations=MAX_ITERATIONS)
    else:
        method = ipctk.TightInclusionCCD(tolerance=TOLERANCE * queries.scale, max_iterations=MAX_ITERATIONS)
    function = getattr(method, "point_triangle_ccd" if queries.split == 1 else "edge_edge_ccd")
    arguments = [(*start, *end, MIN_DISTANCE * queries.scale) for start, end in zip(queries.start, queries.end)]
    return lambda: [function(*those) for those in arguments]


def standing_far_apart(queries: Queries) -> Queries:
    start = near(np.random.default_rng(0), queries.split, 100.0) * queries.scale
    start = np.repeat(start[None], len(queries.start), axis=0)
    return Queries(queries.kind, start, start, queries.scale)


# ---- what is true ----------------------------------------------------------------------------------------------------


def first_impact(queries: Queries, index: int) -> float:
    """The first time at which the distance is the least one, or inf."""
    least = MIN_DISTANCE * queries.scale
    times = np.linspace(0.0, 1.0, SAMPLES + 1)
    distances = [queries.distance(index, time) for time in times]
    for k in range(1, SAMPLES + 1):
        if distances[k] > least and k < SAMPLES and distances[k] <= min(distances[k - 1], distances[k + 1]):
            low, high = times[k - 1], times[k + 1]  # a minimum lies between: narrow it down by thirds
            for _ in range(60):
                third = (high - low) / 3.0
                falls = queries.distance(index, low + third) > queries.distance(index, high - third)
                low, high = (low + third, high) if falls else (low, high - third)
            if queries.distance(index, low) <= least:
                return bisected(queries, index, times[k - 1], low)
        if distances[k] <= least:
            return bisected(queries, index, times[k - 1], times[k])
    return np.inf


def bisected(queries: Queries, index: int, above: float, below: float) -> float:
    for _ in range(60):
        middle = 0.5 * (above + below)
        if queries.distance(index, middle) > MIN_DISTANCE * queries.scale:
            above = middle
        else:
            below = middle
    return below


def judge(true: Sequence[float], found: Sequence[float]) -> dict[str, float]:
    rounding = 1e-9
    hits = [(t, f) for t, f in zip(true, found) if t < np.inf]
    return {
        "misses": sum(f > t + rounding for t, f in hits),
        "false_positives": sum(t == np.inf and f < np.inf for t, f in zip(true, found)),
        "lost": statistics.median(max(t - f, 0.0) / t for t, f in hits) if hits else 0.0,
    }


# ---- the table -------------------------------------------------------------------------------------------------------


def measure(name: str, count: int, rounds: int, clock: Callable[[], float]) -> dict[str, object]:
    sets = [make_queries(name, kind, count) for kind in KINDS]
    calls_of_ours = [our_call(queries) for queries in sets]
    cases: dict[str, Callable[[], object]] = {"ours": lambda: [repeated(call, OUR_REPEATS) for call in calls_of_ours]}
    for peer in PEERS:
        calls = [peer_calls(queries, peer) for queries in sets]
        still = [peer_calls(standing_far_apart(queries), peer) for queries in sets]
        cases[peer] = lambda calls=calls: [call() for call in calls]  # type: ignore[misc]
        cases[f"{peer} still"] = lambda still=still: [call() for call in still]  # type: ignore[misc]
    seconds = in_turns(cases, rounds, clock)
    seconds["ours"] = [time / OUR_REPEATS for time in seconds["ours"]]
    for peer in PEERS:
        least = 1e-6 * LEAST_US * 2 * count
        seconds[peer] = [max(a - b, least) for a, b in zip(seconds[peer], seconds[f"{peer} still"])]
    row: dict[str, object] = {"case": name, "queries": 2 * count}
    true = [first_impact(queries, k) for queries in sets for k in range(count)]
    row["impacts"] = sum(t < np.inf for t in true)
    answers_of_ours = [call() for call in calls_of_ours]
    found = {"ours": [float(t) for toi, _ in answers_of_ours for t in toi]}
    for peer in PEERS:
        answers = [answer for queries in sets for answer in peer_calls(queries, peer)()]
        found[peer] = [toi if hit else np.inf for hit, toi in answers]
    row["most_advances"] = max(int(advances.max()) for _, advances in answers_of_ours)
    for who in ("ours", *PEERS):
        row[f"{who}_us"] = 1e6 * statistics.median(seconds[who]) / (2 * count)
        row |= {f"{who}_{what}": value for what, value in judge(true, found[who]).items()}
    for peer in PEERS:
        row[f"{peer}_to_ours"] = median_ratio(seconds[peer], seconds["ours"])
    return row


def main() -> int:
    options = make_parser(__doc__, rounds=3).parse_args()
    print_header("ipctk", clock=options.clock)
    count, rounds = (3, 1) if options.quick else (QUERIES, options.rounds)
    columns = ["case", "queries", "impacts", "most_advances"]
    columns += [f"{who}_us" for who in ("ours", *PEERS)] + [f"{peer}_to_ours" for peer in PEERS]
    columns += [f"{who}_{what}" for who in ("ours", *PEERS) for what in ("misses", "false_positives", "lost")]
    table = Table(columns)
    for name in FAMILIES:
        table.add(measure(name, count, rounds, options.clock))
    return 0


if __name__ == "__main__":
    sys.exit(main())
