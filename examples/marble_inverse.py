"""An inverse problem: roll a marble over a stretched sheet to a target, with least force; gradients against CMA-ES.

A sheet of rubber is stretched by five percent between four corners. A light marble is let fall onto its middle and is
pushed for two seconds by a horizontal force that may change at each of 50 steps: 100 unknowns. Wanted is the least
force that takes it to a target; the objective is the squared distance from there in the end, plus the squared force.

Three searches from no force at all see the same objective: gradient descent with a constant step, L-BFGS, and CMA-ES
(`cma`), which gets a hundred times as many simulations as descent has iterations. Each is run for a target from each
seed, five by default. (After Fig. 7 of Qiao et al., ICML 2020: the sheet's size, marble, gravity
and time step are theirs. That marble, of 8 cm radius and 4.2 g, is as light as a toy balloon; their descent had
momentum, which only delays it.)

Writes out/marble_inverse.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
"""

from __future__ import annotations

import contextlib
import math
import sys
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _stage import (
    FloatArray,
    Judge,
    draw_band,
    make_parser,
    needed,
    report,
    save_figure,
    save_results,
    weight_errors,
)
from torch import Tensor
from tqdm import tqdm

import diffsim as ds
from diffsim.viewer import Camera, Item, draw_items

cma = needed("cma")

SIDE, NODES, MIDDLE = 1.0, 9, (-0.52, 0.50)  # of the sheet [m]
STRETCHED = 1.05  # times its length at rest
YOUNG, THICK, DENSITY, DAMPING = 2.0e6, 1.0e-3, 374.0, 0.02  # [Pa], [m], [kg/m³], [s]
RADIUS, MASS, START = 0.08, 0.0042, (-0.48, 0.49, 0.10)  # of the marble [m], [kg]
GRAVITY, DT, STEPS = 4.0, 0.04, 50
NEAR, FAR = 0.15, 0.30  # of targets from the sheet's middle [m]
WEIGHT = 20.0  # of the squared force, summed over the steps [m²/N²]
STEP = 8.0e-5  # of gradient descent [N²/m²]
ITERATIONS = 4  # of gradient descent; CMA-ES has TIMES as many simulations
TIMES = 100
SEEDS = 5  # by default
SPREAD = 0.03  # of CMA-ES's first guesses, in units of sqrt(STEP), in which the solutions are about as large

CONVERGED = 1.10  # times the least objective that any search found
ARRIVES = 0.01  # from the target, at the end [m]
GRADIENT_ERROR = 1e-5  # against central differences, relative
LAST, BALANCE = 10, 1e-3  # steps at the end over which forces are added up; what they may be off, relative


# ---- the problem -----------------------------------------------------------------------------------------------------


class Table:
    """The sheet and the marble: from forces to where the marble is after two seconds."""

    def __init__(self) -> None:
        vertices, faces = ds.shapes.sheet(SIDE, NODES)
        corners = [0, NODES - 1, NODES * (NODES - 1), NODES * NODES - 1]
        rubber = ds.ClothMaterial.isotropic(YOUNG, THICK, DENSITY, damping=DAMPING)
        self.scene = ds.Scene(gravity=(0.0, 0.0, -GRAVITY))
        self.scene.add_cloth(
            (vertices, faces), rubber, pinned=corners, rest=vertices / STRETCHED, position=(*MIDDLE, 0.0), name="sheet"
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ds.UnitsWarning)  # 2 kg/m³ is meant
            self.scene.add_sphere(RADIUS, mass=MASS, position=START, name="marble")
        self.sim = ds.Simulator(self.scene, dt=DT)
        self.start = self.sim.initial_state()
        self.failed_steps = 0

    def run(self, force: Tensor) -> ds.State:
        """All states for horizontal forces of shape (STEPS, 2), or (STEPS, batch, 2) [N]."""
        force = torch.nn.functional.pad(force, (0, 1))  # no vertical one
        start = self.start if force.ndim == 2 else self.sim.initial_state(batch=force.shape[1])
        trajectory = self.sim.rollout(start, ds.Control(force=force.unsqueeze(-2)), STEPS)
        assert self.sim.info is not None
        self.failed_steps += self.sim.info.failed_steps
        return trajectory


@dataclass
class Problem:
    table: Table
    target: Tensor  # (2,) [m]

    def objective(self, unknowns: Tensor) -> Tensor:
        """Of forces in units of sqrt(STEP), shape (STEPS, 2) or (STEPS, batch, 2)."""
        force = math.sqrt(STEP) * unknowns
        off = self.table.run(force).position[-1, ..., 0, :2] - self.target
        result: Tensor = off.square().sum(-1) + WEIGHT * force.square().sum((0, -1))
        return result


def make_problem(table: Table, seed: int) -> Problem:
    generator = np.random.default_rng(seed)
    angle, distance = generator.uniform(0.0, 2.0 * math.pi), generator.uniform(NEAR, FAR)
    place = (MIDDLE[0] + distance * math.cos(angle), MIDDLE[1] + distance * math.sin(angle))
    return Problem(table, torch.tensor(place, dtype=torch.float64))


# ---- three searches --------------------------------------------------------------------------------------------------


@dataclass
class Search:
    name: str
    objectives: list[float] = field(default_factory=list)  # one per simulation
    seconds: list[float] = field(default_factory=list)  # of the processor, when it was known
    best: Tensor = field(default_factory=lambda: torch.zeros(STEPS, 2, dtype=torch.float64))  # unknowns
    begin: float = field(default_factory=time.process_time)

    def note(self, unknowns: Tensor, objective: float, seconds: float | None = None) -> None:
        if not self.objectives or objective < min(self.objectives):
            self.best = unknowns.detach().clone()
        self.objectives.append(objective)
        self.seconds.append(time.process_time() - self.begin if seconds is None else seconds)

    @property
    def falling(self) -> FloatArray:
        """The least objective so far."""
        return np.minimum.accumulate(np.array(self.objectives))


def by_descent(problem: Problem, iterations: int, tell: Callable[[int], object]) -> Search:
    search = Search("gradient descent")
    unknowns = torch.zeros(STEPS, 2, dtype=torch.float64, requires_grad=True)
    for _ in range(iterations):
        objective = problem.objective(unknowns)
        (gradient,) = torch.autograd.grad(objective, unknowns)
        search.note(unknowns, objective.item())
        unknowns = (unknowns - gradient).detach().requires_grad_()
        tell(1)
    with torch.no_grad():
        search.note(unknowns, problem.objective(unknowns).item())
    return search


class BudgetSpentError(Exception):
    """Ends a search from within its line search."""


def by_lbfgs(problem: Problem, budget: int, tell: Callable[[int], object]) -> Search:
    unknowns = torch.zeros(STEPS, 2, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([unknowns], max_iter=budget, line_search_fn="strong_wolfe")  # the first imports much
    search = Search("L-BFGS")

    def closure() -> Tensor:
        if len(search.objectives) == budget:
            raise BudgetSpentError
        optimizer.zero_grad()
        objective = problem.objective(unknowns)
        objective.backward()
        search.note(unknowns, objective.item())
        tell(1)
        return objective

    with contextlib.suppress(BudgetSpentError):
        optimizer.step(closure)
    return search


def by_cma(problem: Problem, budget: int, seed: int, tell: Callable[[int], object]) -> Search:
    """Simulates a generation at once, as a batch: the same numbers in less time."""
    search = Search("CMA-ES")
    options = {"seed": seed + 1, "verbose": -9, "maxfevals": budget}
    strategy = cma.CMAEvolutionStrategy(np.zeros(2 * STEPS), SPREAD, options)
    while len(search.objectives) < budget:
        asked = strategy.ask()
        unknowns = torch.tensor(np.array(asked)).reshape(-1, STEPS, 2).transpose(0, 1)
        before = time.process_time() - search.begin
        with torch.no_grad():
            objectives = problem.objective(unknowns.contiguous()).tolist()
        after = time.process_time() - search.begin
        strategy.tell(asked, objectives)
        count = min(len(objectives), budget - len(search.objectives))
        for index in range(count):
            moment = before + (after - before) * (index + 1) / len(objectives)
            search.note(unknowns[:, index], objectives[index], moment)
        tell(count)
    return search


@dataclass
class Trial:
    """One target, and what the searches made of it."""

    problem: Problem
    descent: Search
    lbfgs: Search
    evolution: Search

    @property
    def searches(self) -> tuple[Search, Search, Search]:
        return self.descent, self.lbfgs, self.evolution


def run_trials(table: Table, seeds: Sequence[int], iterations: int, times: int) -> list[Trial]:
    trials = []
    refined = 3 * iterations  # simulations of L-BFGS, to know where descent should arrive
    total = len(seeds) * (iterations + refined + times * iterations)
    with tqdm(total=total, desc="simulations", unit="run") as bar:
        for seed in seeds:
            problem = make_problem(table, seed)
            descent = by_descent(problem, iterations, bar.update)
            lbfgs = by_lbfgs(problem, refined, bar.update)
            trials.append(Trial(problem, descent, lbfgs, by_cma(problem, times * iterations, seed, bar.update)))
    return trials


# ---- checks ----------------------------------------------------------------------------------------------------------


def gradient_error(problem: Problem, unknowns: Tensor, seed: int = 0, eps: float = 1e-4) -> float:
    """Of the directional derivative along a random direction, against central differences, relative."""
    direction = torch.randn(STEPS, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    point = unknowns.detach().clone().requires_grad_()
    (gradient,) = torch.autograd.grad(problem.objective(point), point)
    with torch.no_grad():
        up, down = (problem.objective(unknowns + sign * eps * direction).item() for sign in (1.0, -1.0))
    exact = float((gradient * direction).sum())
    return abs(exact - (up - down) / (2.0 * eps)) / abs(exact)


def check(table: Table, trials: Sequence[Trial], iterations: int) -> bool:
    """Print what must hold and whether it does."""
    results: list[tuple[str, bool]] = []
    errors = [gradient_error(t.problem, torch.zeros(STEPS, 2, dtype=torch.float64)) for t in trials]
    results.append(
        (f"gradients at no force: at most {max(errors):.1e} from central differences", max(errors) < GRADIENT_ERROR)
    )
    least = [min(min(s.objectives) for s in t.searches) for t in trials]
    excess = [t.descent.objectives[-1] / best for t, best in zip(trials, least)]
    text = f"after {iterations} iterations descent is at most {max(excess):.3f} times the least objective found"
    results.append((f"{text} (at most {CONVERGED:g})", max(excess) <= CONVERGED))
    ratio = [min(t.evolution.objectives) / t.descent.objectives[-1] for t in trials]
    count = len(trials[0].evolution.objectives)
    text = f"after {count} simulations CMA-ES is still {min(ratio):.1f} to {max(ratio):.1f} times above that"
    results.append((text, min(ratio) > 1.0))
    fell = [t.descent.objectives[0] / t.descent.objectives[-1] for t in trials]
    results.append((f"the objective fell {min(fell):.0f} to {max(fell):.0f} times", min(fell) > 10.0))

    no_force = torch.zeros(STEPS, 2, dtype=torch.float64)
    states = [table.start, *table.run(no_force).detach()]
    drives = dict.fromkeys(range(STEPS - LAST, STEPS), ds.Control())
    off = weight_errors(table.sim, states, drives, {0: MASS}, GRAVITY)[0]
    text = f"without force, in the last {LAST} steps the sheet carries the marble's weight, to {off:.1e}"
    results.append((text, off <= BALANCE))

    ends, found = [], []
    judge = Judge(table.scene, table.sim)
    for trial in trials:
        states = table.run(math.sqrt(STEP) * trial.descent.best).detach()
        ends.append(float((states.position[-1, 0, :2] - trial.problem.target).norm()))
        found += judge.count(states)
    text = f"the marble ends at most {1e3 * max(ends):.1f} mm from its target (at most {1e3 * ARRIVES:g})"
    results.append((text, max(ends) <= ARRIVES))
    results.append(("nothing passes through anything (ipctk)" + "".join(f"; {f}" for f in found[:3]), not found))
    results.append((f"{table.failed_steps} steps did not converge, of all simulations", table.failed_steps == 0))
    return report(results)


# ---- picture ---------------------------------------------------------------------------------------------------------


def draw(table: Table, trials: Sequence[Trial], path: Path) -> None:
    def fill(figure: Any) -> None:
        left, middle, right = figure.subplots(1, 3, width_ratios=(1.3, 1.0, 1.0))
        trial, camera = trials[0], Camera(-60.0, 38.0)
        states = table.run(math.sqrt(STEP) * trial.descent.best).detach()
        shown = (0, 20, 34, STEPS - 1)
        items = [Item(table.sim.mesh(states[-1], 1), (0.50, 0.66, 0.80), alpha=0.95, two_sided=True, edges=True)]
        for index in shown:
            alpha = 0.3 + 0.7 * index / shown[-1]
            items.append(Item(table.sim.mesh(states[index], 0), (0.93, 0.55, 0.25), alpha=alpha))
        draw_items(left, items, camera, shadows=False)
        height = float(states.position[-1, 0, 2])
        path_dots = camera.project(states.position[:, 0].numpy())
        left.plot(path_dots[:, 0], path_dots[:, 1], color="#b3261e", lw=1.2, zorder=5)
        goal = camera.project([*trial.problem.target.tolist(), height])
        left.plot(goal[0], goal[1], "x", ms=9, mew=2, color="0.1", zorder=6)
        left.set_title("the marble's way to the cross, after descent", fontsize=10, color="0.2")
        for axes, over in ((middle, "simulations"), (right, "seconds of the processor")):
            for k, color in enumerate(("#d9601a", "#2e7d32", "#1f5fa8")):
                curve(axes, [t.searches[k] for t in trials], color, axes is right)
            axes.set(xlabel=over, xscale="log", yscale="log")
            axes.tick_params(axis="x", which="minor", labelbottom=False)
        middle.set_ylabel("objective [m²], mean ± one standard deviation")
        middle.legend(frameon=False, fontsize=9, loc="center")
        middle.set_title(f"{len(trials)} targets, one of each seed", fontsize=10, color="0.2")

    save_figure(path, fill, figsize=(13.0, 4.2))


def summary(trials: Sequence[Trial]) -> dict[str, Any]:
    """For a file of results: the targets, the forces of descent, and what was searched for each."""
    found: dict[str, Any] = {
        "targets [m]": [trial.problem.target for trial in trials],
        "forces [N]": [math.sqrt(STEP) * trial.descent.best for trial in trials],
    }
    for searches in zip(*(trial.searches for trial in trials)):
        found[searches[0].name] = [{"objectives [m²]": s.objectives, "seconds": s.seconds} for s in searches]
    return found


def curve(axes: Any, searches: Sequence[Search], color: str, over_seconds: bool) -> None:
    """Mean and standard deviation of the least objective so far, over the targets."""
    length = min(len(s.objectives) for s in searches)
    falling = np.array([s.falling[:length] for s in searches])
    x = np.mean([s.seconds[:length] for s in searches], axis=0) if over_seconds else np.arange(1, length + 1)
    draw_band(axes, x, falling, color, marker="." if length < 30 else "", label=searches[0].name)


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    parser = make_parser(__doc__, "two targets, and a tenth of CMA-ES's simulations", "of the first target")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="how many targets (default: %(default)s)")
    parser.add_argument("--iterations", type=int, default=ITERATIONS, help="of descent (default: %(default)s)")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    seeds, times = (min(options.seeds, 2), TIMES // 10) if options.quick else (options.seeds, TIMES)
    table = Table()
    trials = run_trials(table, range(options.seed, options.seed + seeds), options.iterations, times)
    for searches in zip(*(t.searches for t in trials)):
        least = [min(s.objectives) for s in searches]
        seconds = np.mean([s.seconds[-1] for s in searches])
        count = len(searches[0].objectives)
        spread = f"{np.mean(least):.2e} ± {np.std(least):.0e} m²"
        print(f"{searches[0].name}: {spread} after {count} simulations, {seconds:.1f} s")
    if not options.no_picture:
        draw(table, trials, options.out / "marble_inverse.png")
        save_results(options.out / "marble_inverse.json", summary(trials))
    passed = check(table, trials, options.iterations)
    print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
