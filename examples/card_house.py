"""A house of cards stands by friction; a marble is thrown so that its top falls to the right, by gradients.

Three levels of frames, two cards each that lean against each other at 65 degrees on top and up to 67 below, with cards
laid across; the coefficient of friction is 0.5. It stands to rounding. Two cards that lean at an angle a push their
feet outwards with less than 1/tan a of what they carry, 0.43 on the ground: with a coefficient of 0.34 the house still
stands, with 0.25 two levels of it slide apart. A ridge bears hardly anything to one side, so that feet have to come
down right on it: at the ends straight over its middle, where two meet each as far from it as a card is thick. So lower
frames, whose feet need room, are a little steeper.

The marble strikes a house of two levels, from the left. The first throw only moves the top. The launch velocity with
which it falls to the right is found by gradient descent through the layer: the loss is half the squared difference
between how far aside the two cards on top are, on the average, while they tip, and how far they shall be. Each step
goes down the gradient as far as a straight line would have to, but not further than a limit, which is halved where a
step made it worse. Launches are tried in one batch, each for itself: five at the house, a little different, and one
that misses, has no gradient at all, and stays where it is. The loss looks early. Later cards lie on cards and every
touch spreads neighbouring throws: 0.1 s on slopes differ in sign from one launch to the next, and from a marble that
meets the lower level, whose cards jam, the descent led nowhere. Why two levels: where cards jam three take seconds a
step, and single steps do not converge.

Cards are 2 % as thick as they are long. With 1 and 5 % the house stands as well, at 5 ms a step.

Writes out/card_house.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _stage import Judge, continued, draw_band, make_parser, of_seeds, report, save_figure, save_results, shift
from torch import Tensor
from tqdm import tqdm

import diffsim as ds
from diffsim.viewer import Camera, Item, draw_items

LEVELS, THROWN_AT = 3, 2  # of the house that is left alone, and of the one that is struck
LONG, WIDE, THICK = 0.2, 0.12, 0.004  # of a card [m]
DENSITY = 300.0  # of a card [kg/m³]
LEAN = math.radians(25.0)  # of the cards on top, from upright
FRICTION, SLIPPERY = 0.5, 0.1  # of everything; with which the house falls by itself
BESIDE = 1e-3  # between what stands side by side [m]
OVERHANG = 0.012  # of a card that is laid across, beyond the ridges [m]
RADIUS, MARBLE = 0.02, 2500.0  # [m], [kg/m³]
THICKNESS = 2e-4  # distance that surfaces keep [m]
DT = 0.005  # [s]

FROM = (-0.3, 0.0, 0.25)  # where the marble is let go [m]
LAUNCH, MISSES = (1.0, 0.05, 0.8), (1.0, 0.05, 2.5)  # at the house, and over it [m/s]
SEEDS = 5  # by default
FLIGHT = 0.25  # when the loss looks [s]
ASIDE = 0.12  # where the top shall be then [m]
REACHED = 0.01  # difference at which the search ends [m]
LIMIT = (
    0.2  # of a step of the search, at first; at 0.4 two of ten first throws step over where the way breaks off [m/s]
)

STANDING, FALLING, LYING = 2.0, 0.1, 0.45  # how long a house stands, slides apart, is followed when struck [s]
SETTLED = 5  # steps in which compression of the contacts comes about
DRIFT = 1e-9  # of the standing house [m]
FALLEN = 0.6  # height of the top's middle at the end, at most, of that at the start
ENERGY_RISE = 1e-3  # in a step, of what the marble brings
GRADIENT_ERROR = 1e-3  # along the gradient, against central differences, relative
EPS = 1e-6  # of those [m/s]


# ---- the scene -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Frame:
    """Two cards that lean against each other: where their feet meet what is below, and what that is the height of."""

    left: float  # [m]
    right: float  # [m]
    base: float  # [m]

    @property
    def lean(self) -> float:
        return math.asin(0.5 * (self.right - self.left) / LONG)

    @property
    def ridge(self) -> float:
        return 0.5 * (self.left + self.right)

    @property
    def top(self) -> float:
        return self.base + LONG * math.cos(self.lean) + THICK * math.sin(self.lean) + THICKNESS


def plan(levels: int) -> list[list[Frame]]:
    """The frames of two or three levels, from the ground.

    Where two feet meet over one ridge each stays beside its middle by the breadth of its card. At the ends feet are
    straight over the ridge. The top has `LEAN`; half the span of the ground's frames is smaller by `less`.
    """
    beside = THICK + 0.5 * BESIDE
    less = 0.5 * levels * beside
    half = LONG * math.sin(LEAN) - less
    middles = 2.0 * (half + beside) * (np.arange(levels) - 0.5 * (levels - 1))
    rows = [[Frame(m - half, m + half, 0.0) for m in middles.tolist()]]
    while len(rows[-1]) > 1:
        below = rows[-1]
        base, last = below[0].top + THICK + THICKNESS, len(below) - 2
        rows.append(
            [
                Frame(a.ridge + beside * (i > 0), b.ridge - beside * (i < last), base)
                for i, (a, b) in enumerate(pairwise(below))
            ]
        )
    return rows


def build_scene(levels: int, friction: float = FRICTION, marble: bool = True) -> ds.Scene:
    scene = ds.Scene()
    scene.add_ground(friction=friction)

    def add(size: tuple[float, float, float], place: Sequence[float], lean: float, name: str) -> None:
        facing = ds.rotation.from_rpy(np.array([0.0, lean, 0.0]))
        card = ds.shapes.box(size)
        scene.add_body(card, density=DENSITY, position=place, orientation=facing, friction=friction, name=name)

    rows = plan(levels)
    for level, row in enumerate(rows):
        for i, frame in enumerate(row):
            out = 0.5 * (LONG * math.sin(frame.lean) + THICK * math.cos(frame.lean) + THICKNESS)
            height = 0.5 * (frame.base + THICKNESS + frame.top)
            for side, name in ((-1, "left"), (1, "right")):
                place = (frame.ridge + side * out, 0.0, height)
                add((THICK, WIDE, LONG), place, -side * frame.lean, f"{name} {level}.{i}")
        for i, (a, b) in enumerate(pairwise(row)):
            low = a.ridge + (-OVERHANG if i == 0 else 0.5 * BESIDE)
            high = b.ridge + (OVERHANG if i == len(row) - 2 else -0.5 * BESIDE)
            place = (0.5 * (low + high), 0.0, a.top + THICKNESS + 0.5 * THICK)
            add((high - low, WIDE, THICK), place, 0.0, f"across {level}.{i}")
    if marble:
        scene.add_sphere(RADIUS, density=MARBLE, position=FROM, friction=friction, name="marble")
    return scene


def top_of(names: Sequence[str], levels: int) -> list[int]:
    """The two cards on top."""
    return [names.index(f"{side} {levels - 1}.0") for side in ("left", "right")]


class Throw:
    """From launch velocities, shape (B, 3), to what becomes of marble and house."""

    def __init__(self) -> None:
        self.scene = build_scene(THROWN_AT)
        self.sim = ds.Simulator(self.scene, dt=DT, thickness=THICKNESS)
        self.steps = round(FLIGHT / DT)
        names = self.sim.body_names
        self.marble = names.index("marble")
        self.top = top_of(names, THROWN_AT)

    def start(self, launches: Tensor) -> ds.State:
        state = self.sim.initial_state(batch=len(launches))
        velocity = state.velocity.index_copy(1, torch.tensor([self.marble]), launches[:, None])
        return state.replace(velocity=velocity)

    def __call__(self, launches: Tensor) -> ds.State:
        return self.sim.rollout(self.start(launches), steps=self.steps)

    def path(self, launch: Tensor) -> list[ds.State]:
        """One throw, state by state from its start, until most lies."""
        start = self.start(launch[None])
        return [start[0], *self.sim.rollout(start, steps=round(LYING / DT))[:, 0]]

    def aside(self, trajectory: ds.State) -> Tensor:
        """How far the cards on top are to the right of where they stood, on the average, at the end [m]."""
        return trajectory.position[-1][:, self.top, 0].mean(dim=1)


# ---- the search ------------------------------------------------------------------------------------------------------


@dataclass
class Way:
    """One launch on its way to a better one."""

    launches: list[Tensor] = field(default_factory=list)  # [m/s]
    aside: list[float] = field(default_factory=list)  # [m]
    limit: float = LIMIT  # [m/s]
    best: int = 0
    slopes: list[Tensor] = field(default_factory=list)  # of aside by the launch velocity [s]

    @property
    def misses(self) -> float:
        return abs(self.aside[self.best] - ASIDE)

    def note(self, launch: Tensor, aside: float, slope: Tensor) -> None:
        self.launches.append(launch)
        self.aside.append(aside)
        self.slopes.append(slope)
        if abs(aside - ASIDE) <= self.misses:
            self.best = len(self.aside) - 1
        else:
            self.limit *= 0.5

    def next(self) -> Tensor:
        """Down the gradient of ½ (aside - ASIDE)²: a straight line is at 0 after (aside - ASIDE)/|slope|."""
        launch, slope = self.launches[self.best], self.slopes[self.best]
        length = float(slope.norm())
        if length == 0.0:
            return launch
        step = (ASIDE - self.aside[self.best]) / length
        return launch + max(-self.limit, min(step, self.limit)) / length * slope


@dataclass
class Search:
    ways: list[Way]  # at the house, one for each seed
    dead: Way  # beside it
    failed_steps: int = 0


def optimise(throw: Throw, launches: Sequence[Tensor], beside: Tensor, iterations: int) -> Search:
    search = Search([Way() for _ in launches], Way())
    wanted = [(way, launch) for way, launch in zip([*search.ways, search.dead], [*launches, beside])]
    with tqdm(total=iterations, desc="throws", unit="batch") as bar:
        for _ in range(iterations):
            batch = torch.stack([launch for _, launch in wanted]).requires_grad_()
            aside = throw.aside(throw(batch))
            (slopes,) = torch.autograd.grad(aside.sum(), batch)
            assert throw.sim.info is not None
            search.failed_steps += throw.sim.info.failed_steps
            for (way, launch), value, slope in zip(wanted, aside.tolist(), slopes):
                way.note(launch, value, slope)
            bar.update()
            bar.write("aside by " + ", ".join(f"{1e3 * way.aside[-1]:6.1f}" for way in search.ways) + " mm")
            ahead = [way for way in search.ways if way.misses >= REACHED]
            if not ahead:
                break
            wanted = [(way, way.next()) for way in (*ahead, search.dead)]
    return search


# ---- checks ----------------------------------------------------------------------------------------------------------


@dataclass
class Stand:
    """What becomes of a house that is left alone."""

    seconds: float
    drift: float  # of any card, once the contacts have settled [m]
    speed: float  # of any card at the end [m/s]
    sinks: float  # of the cards on top until the end [m]
    sticking: int  # contacts, at the end
    slipping: int
    failed_steps: int


def stand(friction: float, seconds: float, levels: int = LEVELS) -> Stand:
    sim = ds.Simulator(build_scene(levels, friction, marble=False), dt=DT, thickness=THICKNESS)
    path = sim.rollout(sim.initial_state(), steps=round(seconds / DT))
    assert sim.info is not None
    moved, info = path.position - path.position[SETTLED - 1], sim.info
    sinks = -float(moved[-1, top_of(sim.body_names, levels), 2].mean())
    drift, speed = float(moved[SETTLED:].abs().max()), float(path.velocity[-1].abs().max())
    return Stand(seconds, drift, speed, sinks, info.sticking, info.slipping, info.failed_steps)


def gradient_error(throw: Throw, launch: Tensor, slope: Tensor) -> float:
    """Of where the top comes to by the launch velocity, along the gradient, against central differences, relative."""
    along = slope / slope.norm()
    with torch.no_grad():
        ahead, behind = throw.aside(throw(torch.stack([launch + EPS * along, launch - EPS * along]))).tolist()
    return float(abs(float(slope.norm()) * 2.0 * EPS / (ahead - behind) - 1.0))


def check(throw: Throw, search: Search, falls: Sequence[ds.State], stands: Stand, slides: Stand) -> bool:
    """Print what must hold and whether it does. `falls`: of the best throw, state by state."""
    results = [
        (
            f"{LEVELS} levels stand for {stands.seconds:g} s: move {stands.drift:.1e} m, end with {stands.speed:.1e}"
            f" m/s; {stands.sticking} contacts stick, {stands.slipping} slip",
            stands.drift < DRIFT and stands.speed < DRIFT and stands.sticking > 0 and stands.slipping == 0,
        ),
        (
            f"with friction {SLIPPERY:g} two cards slide apart: {1e3 * slides.sinks:.1f} mm down in {FALLING:g} s"
            f" ({slides.failed_steps} steps not converged)",
            slides.sinks > 0.01 * LONG,
        ),
        (f"standing, {stands.failed_steps} steps did not converge", stands.failed_steps == 0),
        (f"in the search, {search.failed_steps} steps did not converge", search.failed_steps == 0),
    ]
    way = search.ways[0]
    for name, index in (("first", 0), ("best", way.best)):
        error, slope = gradient_error(throw, way.launches[index], way.slopes[index]), float(way.slopes[index].norm())
        text = f"gradient at the {name} launch: {slope:.2g} m per m/s, error {error:.1e} against central differences"
        results.append((text, slope > 0.0 and error <= GRADIENT_ERROR))
    throws = ", ".join(str(way.best + 1) for way in search.ways)
    ends = ", ".join(f"{1e3 * way.aside[way.best]:.0f}" for way in search.ways)
    text = f"in throw {throws} the top is {ends} mm to the right after {FLIGHT:g} s"
    text += f"; at first it was at most {1e3 * max(way.aside[0] for way in search.ways):.0f} mm"
    results.append((text, all(way.misses < REACHED for way in search.ways)))
    dead = search.dead
    still = all(bool((slope == 0.0).all()) for slope in dead.slopes) and max(map(abs, dead.aside)) < DRIFT
    results.append(("the launch that misses the house has no gradient, and stays", still))
    low = float(falls[-1].position[throw.top, 2].mean() / falls[0].position[throw.top, 2].mean())
    text = f"the house has fallen: its top is at {100.0 * low:.0f} % of its height at the end"
    results.append((text, low < FALLEN))
    energies = [float(throw.sim.kinetic_energy(state) + throw.sim.potential_energy(state)) for state in falls]
    rise, brought = float(np.diff(energies).max()), float(throw.sim.kinetic_energy(falls[0]))
    text = f"energy never rises in a step: at most by {rise:.1e} J of the {brought:.2f} J the marble brings"
    results.append((text, rise <= ENERGY_RISE * brought))
    problems = Judge(throw.scene, throw.sim).count(falls[1:])
    results.append(("nothing passes through anything (ipctk)" + "".join(f"; {p}" for p in problems[:3]), not problems))
    return report(results)


# ---- picture ---------------------------------------------------------------------------------------------------------

CAMERA = Camera(-78.0, 10.0)
COLORS = ((0.86, 0.40, 0.34), (0.95, 0.93, 0.88), (0.45, 0.62, 0.80))  # of cards by level, and between


def items_of(sim: ds.Simulator, state: ds.State) -> list[Item]:
    found = []
    for body, name in enumerate(sim.body_names):
        color = (0.15, 0.17, 0.2)
        if name != "marble":
            color = COLORS[2] if name.startswith("across") else COLORS[int(name.split()[1][0]) % 2]
        found.append(Item(sim.mesh(state, body), color, edges=False))
    return found


def draw(throw: Throw, search: Search, falls: Sequence[ds.State], path: Path) -> None:
    first = search.ways[0]
    with torch.no_grad():
        weak = throw(first.launches[0][None])[:, 0]
    tall = ds.Simulator(build_scene(LEVELS, marble=False), dt=DT, thickness=THICKNESS)
    hit = round(0.55 * FLIGHT / DT)
    shown = (
        (tall, tall.initial_state(), f"{LEVELS} levels stand"),
        (throw.sim, weak[-1], f"first throw, t = {FLIGHT:.2f} s"),
        (throw.sim, falls[hit], f"best throw, t = {hit * DT:.2f} s"),
        (throw.sim, falls[throw.steps], f"best throw, t = {FLIGHT:.2f} s"),
    )

    def fill(figure: Any) -> None:
        grid = figure.subplots(1, 5, width_ratios=(1.0, 1.0, 1.0, 1.0, 0.8))
        for axes, (sim, state, title) in zip(grid, shown):
            draw_items(axes, items_of(sim, state), CAMERA, split=0.01)
            axes.set(xlim=(-0.36, 0.36), ylim=(-0.1, 0.62))
            axes.set_title(title, fontsize=10, color="0.2")
        axes = grid[-1]
        axes.axhline(1e3 * ASIDE, color="0.6", lw=1.0, ls="--")
        aside = 1e3 * continued([way.aside for way in search.ways])
        throws, name = range(1, aside.shape[1] + 1), of_seeds("at the house", len(aside))
        draw_band(axes, throws, aside, "#d9601a", log=False, marker="o", ms=4, label=name)
        axes.plot(throws, 1e3 * np.array(search.dead.aside), "o-", lw=1.6, ms=4, color="#7a4fa3", label="beside it")
        axes.set(xlabel="throw", ylabel="the top is aside by [mm]")
        axes.locator_params(axis="x", integer=True)
        axes.legend(frameon=False, fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.06))
        axes.set_title("by gradients; dashed: wanted", fontsize=10, color="0.2")

    save_figure(path, fill, figsize=(16.0, 3.6))


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    quick = "what stands does so for a quarter of a second, one seed"
    parser = make_parser(__doc__, quick, "of the first throw, to 0.02 m/s: the first")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="how many (default: %(default)s)")
    parser.add_argument("--iterations", type=int, default=10, help="throws, at most (default: %(default)s)")
    parser.add_argument("--friction", type=float, default=FRICTION, help="of the house that is left alone")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    seconds = 0.25 if options.quick else STANDING
    stands, slides = stand(options.friction, seconds), stand(SLIPPERY, FALLING, levels=1)
    throw = Throw()
    seeds = range(options.seed, options.seed + (1 if options.quick else options.seeds))
    first, beside = torch.tensor([LAUNCH, MISSES], dtype=torch.float64)
    launches = [first + first.new_tensor([shift(seed, 0.02), 0.0, 0.0]) for seed in seeds]
    search = optimise(throw, launches, beside, options.iterations)
    best = search.ways[0].launches[search.ways[0].best]
    print(f"launch: {[round(v, 3) for v in best.tolist()]} m/s")
    with torch.no_grad():
        falls = throw.path(best)
    if not options.no_picture:
        draw(throw, search, falls, options.out / "card_house.png")
        found = [
            {"seed": seed, "aside [m]": w.aside, "launches [m/s]": w.launches} for seed, w in zip(seeds, search.ways)
        ]
        save_results(
            options.out / "card_house.json", {"searches": found, "stands": vars(stands), "slides": vars(slides)}
        )
    passed = check(throw, search, falls, stands, slides)
    print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
