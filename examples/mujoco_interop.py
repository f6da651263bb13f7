"""Forces for MuJoCo by gradients from here: three cubes on smooth ground that shall end up side by side.

As Fig. 10 of Qiao et al. 2020. The scene is MuJoCo's: an MJCF text with cubes of half size 0.25, 0.2 and 0.1 m at
x = -1, 0 and 1. Forces push the two outer cubes for 0.6 s; the middle one moves only where another pushes it. MuJoCo
simulates, in steps of 2 ms with its own contacts, and tells where the cubes end; the loss is the sum of squared
distances to where they should be, and a little of the squared forces. What MuJoCo has no gradient for is how the ends
depend on the forces: the layer loads the same model, takes the state from MuJoCo's data, makes the same forces into a
trajectory of steps of 20 ms, and carries the loss's derivative with respect to MuJoCo's end positions back to the
forces. Plain gradient descent, at most 10 steps, to five meeting places.

The original pushes all three cubes, to places apart. Here the middle cube is not driven, so that the gradient has to
come through contact, and the places are side by side. Between the cubes and MuJoCo's ground there is no friction
(condim 1), as here.

Writes out/mujoco_interop.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _stage import (
    FloatArray,
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

mujoco = needed("mujoco")

HALF_SIZES = (0.25, 0.2, 0.1)  # [m]
STARTS = (-1.0, 0.0, 1.0)  # x of the centres [m]
DRIVEN = (0, 2)  # the cubes that forces act on
DENSITY = 1000.0  # [kg/m³]
DT, STEPS, SUBSTEPS = 0.02, 30, 10  # of the layer; MuJoCo makes SUBSTEPS steps in each of ours [s]
MEETING, SPREAD = 0.15, 0.03  # where the middle cube shall be, and how far seeds move that [m]
WEIGHT = 1e-7  # of squared accelerations in the loss [s⁴]
RATE = 0.7  # of the step that would end a search without contact

GRADIENT_STEPS, SEEDS = 10, 5
REACHED = 0.01  # of every cube from its place [m]
ALIGNED, LENGTH = 0.99, 0.15  # cosine of, and relative difference in length to, MuJoCo's central differences


# ---- MuJoCo's scene --------------------------------------------------------------------------------------------------


def build_model() -> Any:
    bodies = "".join(
        f'<body name="cube {i}" pos="{x} 0 {half}"><freejoint/>'
        f'<geom type="box" size="{half} {half} {half}" density="{DENSITY}" condim="1"/></body>'
        for i, (half, x) in enumerate(zip(HALF_SIZES, STARTS))
    )
    ground = '<geom type="plane" size="0 0 1" condim="1"/>'
    option = f'<option timestep="{DT / SUBSTEPS}"/>'
    return mujoco.MjModel.from_xml_string(f"<mujoco>{option}<worldbody>{ground}{bodies}</worldbody></mujoco>")


def places(seed: int) -> FloatArray:
    """Where the cubes shall be, touching each other, shape (3, 2) [m]."""
    middle = MEETING + SPREAD * np.random.default_rng(seed).uniform(-1.0, 1.0)
    left, half, right = HALF_SIZES
    return np.array([[middle - half - left, 0.0], [middle, 0.0], [middle + half + right, 0.0]])


class Task:
    """One problem in both simulators. Controls are accelerations of the driven cubes, shape (STEPS, 2, 2) [m/s²]."""

    def __init__(self, seed: int) -> None:
        self.seed = seed
        self.model = build_model()
        self.sim = ds.Simulator(ds.interop.mujoco.load(self.model), dt=DT)
        self.cubes = [self.sim.body_names.index(f"cube {i}") for i in range(3)]
        self.places = places(seed)
        data = mujoco.MjData(self.model)
        # MuJoCo's cubes begin on the ground; the layer wants a little room between surfaces.
        self.start = self.sim.separate(ds.interop.mujoco.from_mjdata(self.sim, self.model, data))
        # Squared length of d(end)/d(accelerations) of a free cube: the curvature of the loss is twice that.
        self.response = sum((DT * DT * (STEPS - k)) ** 2 for k in range(STEPS))

    def forces(self, accelerations: Tensor) -> Tensor:
        """On all bodies, shape (STEPS, n_bodies, 3) [N]."""
        driven = [self.cubes[i] for i in DRIVEN]
        flat = accelerations * self.sim.mass.detach()[driven, None]
        forces = flat.new_zeros(STEPS, len(self.sim.body_names), 3)
        return forces.index_copy(1, torch.tensor(driven), torch.nn.functional.pad(flat, (0, 1)))

    def in_mujoco(self, accelerations: Tensor) -> ds.State:
        """Where MuJoCo's simulation ends."""
        data = mujoco.MjData(self.model)
        bodies = [self.model.body(name).id for name in self.sim.body_names]
        for force in self.forces(accelerations.detach()).numpy():
            data.xfrc_applied[bodies, :3] = force
            mujoco.mj_step(self.model, data, SUBSTEPS)
        return ds.interop.mujoco.from_mjdata(self.sim, self.model, data)

    def misses(self, end: ds.State) -> FloatArray:
        """From each cube's place to the cube, shape (3, 2) [m]."""
        return np.asarray(end.position[self.cubes, :2].numpy() - self.places)

    def loss(self, accelerations: Tensor) -> float:
        """MuJoCo's [m²]."""
        effort = WEIGHT * float(accelerations.detach().square().sum())
        return float((self.misses(self.in_mujoco(accelerations)) ** 2).sum()) + effort

    def gradient(self, accelerations: Tensor, misses: FloatArray) -> Tensor:
        """Of MuJoCo's loss, by the layer's derivative of the end with respect to the forces."""
        driven = accelerations.detach().requires_grad_()
        end = self.sim.rollout(self.start, ds.Control(force=self.forces(driven)), STEPS).position[-1]
        (effort,) = torch.autograd.grad(WEIGHT * driven.square().sum(), driven)
        upstream = torch.zeros_like(end)
        upstream[self.cubes, :2] = torch.from_numpy(2.0 * misses)
        return torch.autograd.grad(end, driven, upstream)[0] + effort


# ---- search ----------------------------------------------------------------------------------------------------------


@dataclass
class Search:
    """What each iterate was; the last one is the result."""

    accelerations: list[Tensor] = field(default_factory=list)
    gradients: list[Tensor] = field(default_factory=list)  # of all iterates but the last
    losses: list[float] = field(default_factory=list)  # MuJoCo's [m²]
    farthest: list[float] = field(default_factory=list)  # of the cubes from their places, in MuJoCo [m]
    failed_steps: int = 0  # of the layer


def descend(task: Task, steps: int) -> Search:
    search, accelerations = Search(), torch.zeros(STEPS, len(DRIVEN), 2, dtype=torch.float64)
    with tqdm(total=steps, desc="gradient steps", unit="step") as bar:
        for step in range(steps + 1):
            misses = task.misses(task.in_mujoco(accelerations))
            search.accelerations.append(accelerations)
            search.losses.append(float((misses**2).sum() + WEIGHT * accelerations.square().sum()))
            search.farthest.append(float(np.linalg.norm(misses, axis=1).max()))
            bar.write(f"step {step:2d}: loss {search.losses[-1]:.3e} m², farthest {1e3 * search.farthest[-1]:6.1f} mm")
            if step == steps or search.farthest[-1] < REACHED:
                return search
            search.gradients.append(task.gradient(accelerations, misses))
            assert task.sim.info is not None
            search.failed_steps += task.sim.info.failed_steps
            accelerations = accelerations - RATE / (2.0 * task.response) * search.gradients[-1]
            bar.update()
    return search


# ---- checks ----------------------------------------------------------------------------------------------------------


def differences(task: Task, accelerations: Tensor) -> Tensor:
    """The gradient of MuJoCo's loss by central differences: two simulations for every number."""
    gradient, nudge = torch.zeros_like(accelerations), 1e-2
    with tqdm(total=gradient.numel(), desc="MuJoCo's differences", leave=False) as bar:
        for index in np.ndindex(*gradient.shape):
            ends = []
            for sign in (1.0, -1.0):
                moved = accelerations.clone()
                moved[index] += sign * nudge
                ends.append(task.loss(moved))
            gradient[index] = (ends[0] - ends[1]) / (2.0 * nudge)
            bar.update()
    return gradient


def check(tasks: Sequence[Task], searches: Sequence[Search]) -> bool:
    """Print what must hold and whether it does."""
    steps, farthest = max(len(s.gradients) for s in searches), max(s.farthest[-1] for s in searches)
    listed = ", ".join(str(len(s.gradients)) for s in searches)
    text = f"after {listed} gradient steps all cubes of MuJoCo's are within {1e3 * farthest:.1f} mm of their places"
    results = [(text, steps <= GRADIENT_STEPS and farthest < REACHED)]
    ends = (t.in_mujoco(s.accelerations[-1]).position[t.cubes[1], 0].item() for t, s in zip(tasks, searches))
    middle = min(ends)
    results.append((f"the middle cube, which no force acts on, was pushed by {middle:.3f} m at least", middle > 0.1))
    failed = sum(s.failed_steps for s in searches)
    results.append((f"{failed} steps of the layer did not converge", failed == 0))
    task, search = tasks[0], searches[0]
    # The last iterates are near the optimum, where a gradient is small and two simulators need not agree on it.
    touching = next((i for i in range(1, len(search.gradients)) if _through_contact(task, search, i)), 0)
    for name, index in (("free of contact", 0), ("through contact", touching)):
        expected, found = differences(task, search.accelerations[index]), search.gradients[index]
        cosine = float((expected * found).sum() / (expected.norm() * found.norm()))
        length = float(found.norm() / expected.norm())
        text = f"gradient {name} (step {index}) against MuJoCo's differences: cosine {cosine:.4f}, length {length:.3f}"
        results.append((text, cosine >= ALIGNED and abs(length - 1.0) <= LENGTH))
    results.append(("a gradient that came through contact was compared", touching > 0))
    return report(results)


def _through_contact(task: Task, search: Search, index: int) -> bool:
    """Whether the middle cube was moved by that iterate."""
    return bool(task.in_mujoco(search.accelerations[index]).position[task.cubes[1], 0].abs() > 0.02)


# ---- picture ---------------------------------------------------------------------------------------------------------

COLORS = ((0.50, 0.66, 0.80), (0.93, 0.55, 0.25), (0.55, 0.72, 0.50))


def draw(tasks: Sequence[Task], searches: Sequence[Search], path: Path) -> None:
    """MuJoCo's cubes at the start and the end of the first search, and all searches."""
    task, search = tasks[0], searches[0]

    def fill(figure: Any) -> None:
        grid = figure.add_gridspec(2, 2, width_ratios=(1.25, 1.0))
        end = task.in_mujoco(search.accelerations[-1])
        for row, (state, title) in enumerate(((task.start, "start"), (end, "MuJoCo, t = 0.6 s"))):
            axes = figure.add_subplot(grid[row, 0])
            items = [Item(task.sim.mesh(state, cube), color) for cube, color in zip(task.cubes, COLORS)]
            camera = Camera(-70.0, 22.0)
            draw_items(axes, items, camera)
            axes.set_title(title, fontsize=10, color="0.2")
            marks = camera.project([[x, -half, 0.0] for (x, _), half in zip(task.places, HALF_SIZES)])
            axes.plot(marks[:, 0], marks[:, 1], "^", ms=6, color="#0a7d33", zorder=4)
            axes.set(xlim=(-1.35, 1.3), ylim=(-0.45, 0.9))
        axes = figure.add_subplot(grid[:, 1])
        farthest = 1e3 * continued([s.farthest for s in searches])
        label = of_seeds("mean and standard deviation", len(searches))
        draw_band(axes, np.arange(farthest.shape[1]), farthest, "#b03a2e", marker="o", label=label)
        axes.axhline(1e3 * REACHED, color="0.7", lw=1.0)
        axes.set(xlabel="gradient steps", ylabel="farthest cube from its place, in MuJoCo [mm]", yscale="log")
        axes.legend(frameon=False)
        axes.grid(True, alpha=0.3)

    save_figure(path, fill, figsize=(11.0, 4.6))


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    parser = make_parser(__doc__, "one seed", "of where the cubes shall meet: the first")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="how many (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=GRADIENT_STEPS, help="gradient steps (default: %(default)s)")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    tasks = [Task(options.seed + i) for i in range(1 if options.quick else options.seeds)]
    searches = [descend(task, options.steps) for task in tasks]
    if not options.no_picture:
        draw(tasks, searches, options.out / "mujoco_interop.png")
        results = {
            "seeds": [task.seed for task in tasks],
            "losses [m²]": [search.losses for search in searches],
            "farthest [m]": [search.farthest for search in searches],
        }
        save_results(options.out / "mujoco_interop.json", results)
    passed = check(tasks, searches)
    print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
