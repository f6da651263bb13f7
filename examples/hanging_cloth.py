"""What a cloth is made of, from how it hangs: stretch and bend stiffness by gradients, against CMA-ES.

A strip of soft cloth is clamped at one end, held out level, and hangs over: near the clamp its bending stiffness shows,
further down its weight stretches it. Its nodes are observed with 1 mm of noise. From a stretch stiffness five times too
large and a bend stiffness eight times too small, L-BFGS follows the gradient that comes back through the simulator;
CMA-ES (`cma`) gets the same number of simulations. Both see the same loss: the sum of squared distances from the
observed nodes, in units of the noise; and the same two unknowns, logarithms of the stiffnesses squeezed into a range of
plausible ones. All is done for five draws of the noise, with five seeds of CMA-ES.

To find the resting shape the strip is let go and a few steps of three seconds are taken: implicit Euler with such
steps is a relaxation. A simulation starts from the rest shape of the first guess.

Writes out/hanging_cloth.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
The resting shape is judged by the elastica: stiffnesses read off it by the balance of forces and moments, without the
simulator.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _stage import (
    FloatArray,
    Judge,
    continued,
    draw_band,
    make_parser,
    needed,
    of_seeds,
    report,
    save_figure,
    save_results,
)
from torch import Tensor
from tqdm import tqdm

import diffsim as ds
from diffsim.viewer import Camera, Item, draw_items

cma = needed("cma")

LENGTH, WIDTH, HEIGHT = 0.8, 0.1, 1.0  # of the strip, and of its clamp over the ground [m]
NODES, QUICK_NODES = (33, 5), (17, 3)  # along and across
DENSITY, SHEAR, DAMPING = 0.2, 30.0, 0.02  # [kg/m²], [N/m], [s]
GRAVITY = 9.81
NOISE = 1.0e-3  # of each coordinate [m]
TRUTH = (60.0, 5.0e-3)  # stretch [N/m], bend [N·m]
GUESS = (300.0, 6.0e-4)
DT = 3.0  # [s]
STEPS = 5  # of a simulation
RELAX = 8  # steps, to find the rest shape of the first guess from the flat strip
RANGE = 30.0  # stiffnesses are looked for from the guess's 30th part to 30 times the guess
BUDGET = 24  # simulations for each method
SEEDS = 5  # by default

RESTING = 1e-5  # largest speed of a node at the end [m/s]
GRADIENT_ERROR = 1e-5  # against central differences, relative
ERRORS = 4.0  # of the stiffnesses, in standard errors
STRETCH_READ, BEND_READ = 0.03, 0.05  # what the elastica may be off on this mesh, relative
EXCESS = 0.1  # of the loss over its minimum: at most this part of CMA-ES's


# ---- the strip -------------------------------------------------------------------------------------------------------


class Strip(torch.nn.Module):
    """From the logarithms of stretch and bend stiffness to where the nodes come to rest."""

    def __init__(self, nodes: tuple[int, int] = NODES) -> None:
        super().__init__()
        self.nodes = nodes
        vertices, faces = ds.shapes.sheet((LENGTH, WIDTH), nodes)
        vertices = vertices + np.array([0.5 * LENGTH, 0.0, 0.0])  # from x = 0
        self.clamped = vertices[:, 0] < 1.01 * LENGTH / (nodes[0] - 1)  # two columns: place and direction
        material = ds.ClothMaterial(DENSITY, GUESS[0], SHEAR, GUESS[1], DAMPING)
        self.scene = ds.Scene(gravity=(0.0, 0.0, -GRAVITY))
        self.scene.add_cloth((vertices, faces), material, pinned=self.clamped, position=(0, 0, HEIGHT), name="strip")
        self.sim = ds.Simulator(self.scene, dt=DT)
        self.failed_steps = 0
        self.start = self.sim.initial_state()
        relaxed = self.run(torch.log(torch.tensor(GUESS, dtype=torch.float64)), RELAX)
        self.start = relaxed[-1].replace(node_velocity=torch.zeros_like(relaxed.node_velocity[-1]))

    def forward(self, steps: int) -> ds.State:
        trajectory = self.sim.rollout(self.start, None, steps)
        assert self.sim.info is not None
        self.failed_steps += self.sim.info.failed_steps
        return trajectory

    def run(self, logs: Tensor, steps: int = STEPS) -> ds.State:
        stretch, bend = torch.exp(logs)
        parameters = {"sim.cloth_stretch": stretch[None], "sim.cloth_bend": bend[None]}
        result: ds.State = torch.func.functional_call(self, parameters, (steps,))
        return result


@dataclass
class Problem:
    """An observed shape, and how far others are from it."""

    strip: Strip
    observed: Tensor

    def loss(self, logs: Tensor) -> Tensor:
        """Squared distance from the observation over its noise's variance: about one per coordinate at the truth."""
        end = self.strip.run(logs).node_position[-1]
        distance: Tensor = (end - self.observed)[~self.strip.clamped]
        loss: Tensor = (distance / NOISE).square().sum()
        return loss

    @property
    def freedom(self) -> int:
        """How many numbers are observed."""
        return 3 * int((~self.strip.clamped).sum())


def observe(strip: Strip, truth: Sequence[float], seed: int = 0) -> Problem:
    end = strip.run(torch.log(torch.tensor(truth, dtype=torch.float64))).node_position[-1]
    noise = torch.randn(end.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return Problem(strip, end + NOISE * noise)


# ---- two searches ----------------------------------------------------------------------------------------------------


def logarithms(unknowns: Tensor) -> Tensor:
    """Of stretch and bend, within RANGE of the guess; 0 is the guess."""
    return torch.log(torch.tensor(GUESS, dtype=torch.float64)) + np.log(RANGE) * torch.tanh(unknowns / np.log(RANGE))


@dataclass
class Search:
    name: str
    losses: list[float] = field(default_factory=list)  # one per simulation
    best: Tensor = field(default_factory=lambda: torch.log(torch.tensor(GUESS, dtype=torch.float64)))
    forward_seconds: float = 0.0
    backward_seconds: float = 0.0

    def note(self, logs: Tensor, loss: float) -> None:
        if not self.losses or loss < min(self.losses):
            self.best = logs.detach().clone()
        self.losses.append(loss)

    @property
    def values(self) -> list[float]:
        """Stretch [N/m] and bend [N·m]."""
        return [float(x) for x in torch.exp(self.best)]

    @property
    def falling(self) -> FloatArray:
        """The best loss so far."""
        return np.minimum.accumulate(np.array(self.losses))


class BudgetSpentError(Exception):
    """Ends a search from within its line search."""


def by_gradient(problem: Problem, budget: int, tell: Callable[[], object]) -> Search:
    search = Search("L-BFGS, gradients through the simulator")
    unknowns = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.LBFGS([unknowns], max_iter=budget, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        if len(search.losses) == budget:
            raise BudgetSpentError
        optimizer.zero_grad()
        begin = time.perf_counter()
        logs = logarithms(unknowns)
        loss = problem.loss(logs)
        middle = time.perf_counter()
        loss.backward()
        search.forward_seconds += middle - begin
        search.backward_seconds += time.perf_counter() - middle
        search.note(logs, loss.item())
        tell()
        return loss

    with contextlib.suppress(BudgetSpentError):
        optimizer.step(closure)
    return search


def by_cma(problem: Problem, budget: int, tell: Callable[[], object], seed: int = 1) -> Search:
    search = Search("CMA-ES")
    strategy = cma.CMAEvolutionStrategy([0.0, 0.0], 1.5, {"seed": seed, "verbose": -9, "maxfevals": budget})
    while len(search.losses) < budget:
        asked = strategy.ask()
        losses = []
        for unknowns in asked[: budget - len(search.losses)]:
            begin = time.perf_counter()
            logs = logarithms(torch.tensor(unknowns, dtype=torch.float64))
            losses.append(problem.loss(logs).item())
            search.forward_seconds += time.perf_counter() - begin
            search.note(logs, losses[-1])
            tell()
        if len(losses) == len(asked):
            strategy.tell(asked, losses)
    return search


@dataclass
class Trial:
    """One draw of the noise, and what the searches made of it."""

    seed: int
    problem: Problem
    gradient: Search
    evolution: Search

    @property
    def lead(self) -> tuple[float, float]:
        """How far the least loss of each search is above the lower of both."""
        ours, theirs = min(self.gradient.losses), min(self.evolution.losses)
        return ours - min(ours, theirs), theirs - min(ours, theirs)


def run_trials(strip: Strip, seeds: Sequence[int], budget: int) -> list[Trial]:
    trials = []
    with tqdm(total=2 * budget * len(seeds), desc="simulations", unit="run") as bar:
        for seed in seeds:
            problem = observe(strip, TRUTH, seed)
            gradient = by_gradient(problem, budget, bar.update)
            trials.append(Trial(seed, problem, gradient, by_cma(problem, budget, bar.update, seed + 1)))
    return trials


# ---- checks ----------------------------------------------------------------------------------------------------------


def read_off(position: Tensor, nodes: tuple[int, int]) -> tuple[float, float]:
    """Stretch [N/m] and bend [N·m] of a resting strip by the elastica, from the mean over its width.

    What hangs below a section pulls at it: the tension is S (e + e²/2) (1 + e) for the strain e in St. Venant and
    Kirchhoff's law, and turns it: bend κ is the moment of the weight below. Each as the quotient of two integrals.
    """
    across = np.full(nodes[1], 1.0)
    across[[0, -1]] = 0.5
    grid = position.reshape(nodes[1], nodes[0], 3).numpy()
    line = np.average(grid, axis=0, weights=across)[1:, [0, 2]]  # from the clamp's end
    spacing = LENGTH / (nodes[0] - 1)
    edges = np.diff(line, axis=0)
    lengths = np.linalg.norm(edges, axis=1)
    strain = lengths / spacing - 1.0
    # Weight per width at the nodes; the last one carries half an interval.
    weight = np.full(len(line), DENSITY * GRAVITY * spacing)
    weight[-1] *= 0.5
    below = np.cumsum(weight[::-1])[::-1]  # at node i and further
    tension = below[1:] * -edges[:, 1] / lengths
    stretch = tension.sum() / ((strain + 0.5 * strain**2) * (1.0 + strain)).sum()
    # Of all that hangs beyond node i, about node i; a positive turn leads downwards.
    x = line[:, 0]
    moment = np.array([(weight[i:] * (x[i:] - x[i])).sum() for i in range(1, len(x) - 1)])
    angle = np.unwrap(np.arctan2(-edges[:, 1], edges[:, 0]))
    curvature = np.diff(angle) / spacing
    bend = (moment * curvature).sum() / (curvature * curvature).sum()
    return float(stretch), float(bend)


def standard_errors(problem: Problem, logs: Tensor, step: float = 1e-4) -> tuple[FloatArray, FloatArray]:
    """Of the logarithms, from the noise; and the gradient of the loss. By central differences of the simulation."""
    columns = []
    free = ~problem.strip.clamped
    for k in range(2):
        shift = torch.zeros(2, dtype=torch.float64)
        shift[k] = step
        up, down = (problem.strip.run(logs + sign * shift).node_position[-1][free] for sign in (1.0, -1.0))
        columns.append(((up - down) / (2.0 * step * NOISE)).flatten().numpy())
    jacobian = np.stack(columns, axis=1)
    end = problem.strip.run(logs).node_position[-1][free]
    residual = ((end - problem.observed[free]) / NOISE).flatten().numpy()
    return np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))), 2.0 * jacobian.T @ residual


def check(trials: Sequence[Trial]) -> bool:
    """Print what must hold and whether it does."""
    problem, results = trials[0].problem, list[tuple[str, bool]]()
    strip = problem.strip
    guess, truth = (torch.log(torch.tensor(x, dtype=torch.float64)) for x in (GUESS, TRUTH))

    resting = strip.run(truth)
    speed = float(resting.node_velocity[-1].norm(dim=1).max())
    results.append((f"the strip is at rest in the end: no node is faster than {speed:.1e} m/s", speed < RESTING))
    for name, read, true, bound in zip(
        ("stretch", "bend"), read_off(resting.node_position[-1], strip.nodes), TRUTH, (STRETCH_READ, BEND_READ)
    ):
        off = abs(read / true - 1.0)
        text = f"{name} read off its shape by the elastica: {read:.4g}, {100.0 * off:.1f} % from the truth"
        results.append((f"{text} (at most {100.0 * bound:.0f} %)", off <= bound))

    logs = guess.clone().requires_grad_()
    (exact,) = torch.autograd.grad(problem.loss(logs), logs)
    _, differences = standard_errors(problem, guess)
    off = float(np.abs(exact.numpy() - differences).max() / np.abs(differences).max())
    results.append((f"gradient at the guess: {off:.1e} from central differences, relative", off < GRADIENT_ERROR))

    offs = np.array(
        [(t.gradient.best - truth).numpy() / standard_errors(t.problem, t.gradient.best)[0] for t in trials]
    )
    for k, name in enumerate(("stretch", "bend")):
        listed = ", ".join(f"{100.0 * (t.gradient.values[k] / TRUTH[k] - 1.0):+.2f}" for t in trials)
        off = float(np.abs(offs[:, k]).max())
        text = f"{name} found: {listed} % from the truth, at most {off:.1f} times what the noise makes of it"
        results.append((f"{text} (at most {ERRORS:g})", off <= ERRORS))
    per_number = np.array([min(t.gradient.losses) for t in trials]) / problem.freedom
    listed, spread = ", ".join(f"{x:.3f}" for x in per_number), 4.0 * (2.0 / problem.freedom) ** 0.5
    text = f"what is left is noise: loss {listed} per observed number (1 ± {spread:.3f})"
    results.append((text, bool((np.abs(per_number - 1.0) < spread).all())))

    times = [min(t.evolution.losses) / min(t.gradient.losses) for t in trials]
    text = f"after {len(trials[0].evolution.losses)} simulations CMA-ES is {min(times):.2g} to {max(times):.2g} times"
    text += f" above L-BFGS after at most {max(len(t.gradient.losses) for t in trials)}"
    results.append((text, all(ours <= EXCESS * theirs for ours, theirs in (t.lead for t in trials))))
    crossings = Judge(strip.scene, strip.sim).count(strip.run(trials[0].gradient.best).detach())
    text = "the strip does not cross itself (ipctk)" + "".join(f"; {crossing}" for crossing in crossings[:3])
    results.append((text, not crossings))
    results.append((f"{strip.failed_steps} steps did not converge, of all simulations", strip.failed_steps == 0))
    return report(results)


# ---- picture ---------------------------------------------------------------------------------------------------------


def draw(trials: Sequence[Trial], path: Path) -> None:
    problem = trials[0].problem
    strip = problem.strip
    guess = torch.log(torch.tensor(GUESS, dtype=torch.float64))

    def fill(figure: Any) -> None:
        left, right = figure.subplots(1, 2, width_ratios=(0.7, 1.5))
        camera = Camera(-50.0, 16.0)
        items = []
        for logs, color in ((guess, (0.80, 0.80, 0.82)), (trials[0].gradient.best, (0.50, 0.66, 0.80))):
            mesh = strip.sim.mesh(strip.run(logs)[-1].detach(), 0)
            items.append(Item(mesh, color, alpha=0.9, two_sided=True, edges=True))
        draw_items(left, items, camera, shadows=False)
        dots = camera.project(problem.observed.numpy())
        left.plot(dots[:, 0], dots[:, 1], ".", ms=2.5, color="#b3261e", zorder=5)
        left.set_title("grey: the guess; blue: found; red: observed", fontsize=10, color="0.2")
        for searches, color in zip(zip(*((t.gradient, t.evolution) for t in trials)), ("#1f5fa8", "#d9601a")):
            falling = continued([s.falling for s in searches]) / problem.freedom
            count, name = np.arange(1, falling.shape[1] + 1), of_seeds(searches[0].name, len(searches))
            draw_band(right, count, falling, color, marker=".", label=name)
        right.axhline(1.0, color="0.7", lw=0.8, ls=":")
        right.set(xlabel="simulations", ylabel="least loss so far, per observed number", yscale="log")
        right.set_title("mean and standard deviation; dotted: the noise", fontsize=10, color="0.2")
        right.legend(frameon=False, fontsize=9)

    save_figure(path, fill, figsize=(10.5, 4.6))


def summary(trials: Sequence[Trial]) -> dict[str, Any]:
    """For a file of results."""
    return {
        searches[0].name: [
            {"seed": t.seed, "losses": s.losses, "stretch [N/m] and bend [N·m]": s.values}
            for t, s in zip(trials, searches)
        ]
        for searches in zip(*((t.gradient, t.evolution) for t in trials))
    }


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    quick = f"{QUICK_NODES[0]} x {QUICK_NODES[1]} nodes, one seed"
    parser = make_parser(__doc__, quick, "of the noise, and of CMA-ES: the first")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="how many (default: %(default)s)")
    parser.add_argument("--budget", type=int, default=BUDGET, help="simulations of each method (default: %(default)s)")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    budget = options.budget
    strip = Strip(QUICK_NODES if options.quick else NODES)
    print(f"{strip.nodes[0]} x {strip.nodes[1]} nodes, {STEPS} steps of {DT:g} s; {budget} simulations for each method")
    trials = run_trials(strip, range(options.seed, options.seed + (1 if options.quick else options.seeds)), budget)
    for search in (s for t in trials for s in (t.gradient, t.evolution)):
        stretch, bend = search.values
        count = len(search.losses)
        seconds = f"{1e3 * search.forward_seconds / count:.0f} ms"
        if search.backward_seconds:
            seconds += f" + {1e3 * search.backward_seconds / count:.0f} ms backward"
        print(f"{search.name}: stretch {stretch:.4g} N/m, bend {bend:.4g} N·m, {seconds} per simulation")
    if not options.no_picture:
        draw(trials, options.out / "hanging_cloth.png")
        save_results(options.out / "hanging_cloth.json", summary(trials))
    passed = check(trials)
    print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
