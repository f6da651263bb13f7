"""Train a policy through the physics, data-parallel over scenes: `torchrun --nproc_per_node 2 train_distributed.py`.

A ball strikes another, which shall be at a given place after 0.6 s, a different one in every scene. A small network
sees the place and chooses the velocity of the striker; the loss is the squared distance, and its gradient comes back
to the network through the collision. Network and simulator are one module, `Policy`, which
`torch.nn.parallel.DistributedDataParallel` takes as it takes any other: every process plays its share of the scenes,
one batch per call, and the gradients are averaged between processes (gloo). With plain python, one process plays them
all, to the same result but for rounding. Five policies are trained, one after the other, from five seeds.

Writes out/train_distributed.png and .json and checks itself: the exit code says whether all that `check` looks at
holds.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.distributed
from _stage import draw_band, make_parser, of_seeds, report, save_figure, save_results
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from tqdm import tqdm

import diffsim as ds

DT, STEPS = 0.02, 30
RADIUS, GAP = 0.05, 0.1  # of both balls; between them at first [m]
SCENES = 32  # per iteration, over all processes
TESTS = 64  # scenes no network was trained on
NEAREST, FARTHEST, WIDEST = 0.3, 0.8, math.radians(25.0)  # where targets are, seen from the ball that is struck
RATE, ITERATIONS, QUICK_ITERATIONS, SEEDS = 0.01, 300, 200, 5

FALL = 100.0  # the mean squared distance must fall by this
HIT = 0.95  # part of the test scenes in which the ball must have been struck
GRADIENT_ERROR = 1e-5  # against central differences, relative
MOMENTUM_ERROR = 1e-9  # of what the striker brings
SAME_GRADIENT = 1e-10  # between one process with all scenes and several with a part each, relative


# ---- scenes ----------------------------------------------------------------------------------------------------------


def build_scene() -> ds.Scene:
    """Two balls on smooth ground."""
    scene = ds.Scene()
    scene.add_ground()
    for name, x in (("striker", -2.0 * RADIUS - GAP), ("ball", 0.0)):
        scene.add_sphere(RADIUS, density=1000.0, position=(x, 0.0, RADIUS), name=name)
    return scene


def targets(count: int, seed: int) -> Tensor:
    """Places for the ball, (count, 2) [m]."""
    generator = torch.Generator().manual_seed(seed)
    u, v = torch.rand(2, count, generator=generator, dtype=torch.float64)
    distance, angle = NEAREST + (FARTHEST - NEAREST) * u, WIDEST * (2.0 * v - 1.0)
    return torch.stack([distance * angle.cos(), distance * angle.sin()], dim=-1)


def first_scenes(seed: int) -> int:
    """The seed of the targets of the first iteration; the next follow."""
    return 100_000 * seed


class Policy(nn.Module):
    """From targets (B, 2) to where the ball is in the end (B, 2): network and physics."""

    def __init__(self, seed: int = 0) -> None:
        super().__init__()
        torch.manual_seed(seed)  # the same in every process
        layers = nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 32), nn.Tanh(), nn.Linear(32, 2)
        self.network = nn.Sequential(*layers).double()
        with torch.no_grad():
            self.network[-1].weight.mul_(0.1)
            self.network[-1].bias.copy_(torch.tensor([1.5, 0.0]))  # straight ahead: who misses learns nothing
        self.sim = ds.Simulator(build_scene(), dt=DT)
        self.start = self.sim.initial_state()
        self.failed_steps = 0

    def forward(self, target: Tensor) -> Tensor:
        seen = (target - target.new_tensor([0.5 * (NEAREST + FARTHEST), 0.0])) / (0.5 * (FARTHEST - NEAREST))
        launch = nn.functional.pad(self.network(seen), (0, 1))  # along the ground
        velocity = torch.stack([launch, torch.zeros_like(launch)], dim=1)
        trajectory = self.sim.rollout(self.start.replace(velocity=velocity), None, STEPS)
        assert self.sim.info is not None
        self.failed_steps += self.sim.info.failed_steps
        return trajectory.position[-1, :, 1, :2]


def squared_distance(reached: Tensor, target: Tensor) -> Tensor:
    """Mean over scenes."""
    return (reached - target).square().sum(-1).mean()


# ---- training --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Share:
    """Which process this is, of how many."""

    rank: int = 0
    count: int = 1

    def part(self, scenes: Tensor) -> Tensor:
        """This process's scenes. All parts have the same size, so that the mean of means is the mean of all."""
        assert len(scenes) % self.count == 0
        return scenes.chunk(self.count)[self.rank]

    def mean(self, value: Tensor) -> Tensor:
        """Over processes."""
        value = value.detach().clone()
        if self.count > 1:
            torch.distributed.all_reduce(value)
        return value / self.count


@contextmanager
def processes() -> Iterator[Share]:
    """What torchrun says, or one process."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1:
        yield Share()
        return
    if SCENES % count:
        raise SystemExit(f"error: {SCENES} scenes cannot be shared equally between {count} processes")
    torch.distributed.init_process_group("gloo")
    try:
        yield Share(torch.distributed.get_rank(), count)
    finally:
        torch.distributed.destroy_process_group()


def gradient(policy: nn.Module) -> Tensor:
    """Of the network, as one vector."""
    return torch.cat([p.grad.flatten() for p in policy.parameters() if p.grad is not None])


@dataclass
class Training:
    policy: Policy
    share: Share
    seed: int
    first_gradient: Tensor  # as the processes averaged it
    losses: list[float] = field(default_factory=list)  # mean over all scenes


def train(share: Share, iterations: int, seed: int = 0) -> Training:
    policy = Policy(seed)
    module: nn.Module = policy if share.count == 1 else DistributedDataParallel(policy)
    optimiser = torch.optim.Adam(policy.network.parameters(), lr=RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, iterations)
    training = Training(policy, share, seed, torch.empty(0))
    for iteration in tqdm(range(iterations), desc=f"training, seed {seed}", unit="iteration", disable=share.rank > 0):
        target = share.part(targets(SCENES, seed=first_scenes(seed) + iteration))
        optimiser.zero_grad()
        loss = squared_distance(module(target), target)
        loss.backward()
        if iteration == 0:
            training.first_gradient = gradient(policy).clone()
        optimiser.step()
        schedule.step()
        training.losses.append(float(share.mean(loss)))
    if share.rank == 0:
        ends = (f"{loss**0.5:.4f} m" for loss in (training.losses[0], training.losses[-1]))
        print(f"seed {seed}, root of the mean squared distance: {' to '.join(ends)}")
    return training


# ---- checks ----------------------------------------------------------------------------------------------------------


def reference_gradient(seed: int) -> Tensor:
    """The first gradient by one process with all scenes."""
    policy, target = Policy(seed), targets(SCENES, seed=first_scenes(seed))
    squared_distance(policy(target), target).backward()
    return gradient(policy)


def gradient_error(seed: int) -> float:
    """Of the first loss along a random direction of the weights, against central differences, relative."""
    policy, target = Policy(seed), targets(SCENES, seed=first_scenes(seed))
    weights = list(policy.network.parameters())
    generator = torch.Generator().manual_seed(seed)
    direction = [torch.randn(w.shape, generator=generator, dtype=w.dtype) for w in weights]
    exact = torch.autograd.grad(squared_distance(policy(target), target), weights)
    slope = sum(float((g * d).sum()) for g, d in zip(exact, direction))
    values, nudge = [], 1e-7
    with torch.no_grad():
        for sign in (1.0, -2.0):  # there, and from there to the other side
            for w, d in zip(weights, direction):
                w.add_(d, alpha=sign * nudge)
            values.append(float(squared_distance(policy(target), target)))
    return abs((values[0] - values[1]) / (2.0 * nudge) / slope - 1.0)


def evaluate(policy: Policy) -> tuple[float, float]:
    """Mean squared distance [m²] and part of the balls struck, in scenes not trained on."""
    target = targets(TESTS, seed=-1)
    with torch.no_grad():
        reached = policy(target)
    return float(squared_distance(reached, target)), float((reached.norm(dim=-1) > 0.5 * NEAREST).double().mean())


def momentum_error(policy: Policy) -> float:
    """Of balls of one mass: by how much the sum of their velocities changes when one strikes the other, relative."""
    launch = torch.tensor([[1.5, 0.1, 0.0], [0.0, 0.0, 0.0]], dtype=torch.float64)  # a little aside
    with torch.no_grad():
        ends = policy.sim.rollout(policy.start.replace(velocity=launch), None, STEPS).velocity[-1]
    assert float(ends[1].norm()) > 0.1  # it was struck
    return float((ends.sum(0) - launch[0]).norm() / launch[0].norm())


def spread_of_weights(training: Training) -> float:
    """Between processes."""
    weights = torch.cat([p.detach().flatten() for p in training.policy.network.parameters()])
    return float((training.share.mean(weights) - weights).abs().max())


def check(trainings: Sequence[Training]) -> bool:
    """True if all holds; every process has to call it."""
    share, seeds = trainings[0].share, [t.seed for t in trainings]
    expected = [reference_gradient(seed) for seed in seeds]
    error = max(float((t.first_gradient - e).norm() / e.norm()) for t, e in zip(trainings, expected))
    differences = max(map(gradient_error, seeds))
    changed = momentum_error(trainings[0].policy)
    spread = max(map(spread_of_weights, trainings))
    before = [evaluate(Policy(seed))[0] for seed in seeds]
    after, struck = zip(*(evaluate(t.policy) for t in trainings))
    fell = [b / a for b, a in zip(before, after)]
    failed = sum(t.policy.failed_steps for t in trainings)
    listed, hit = ", ".join(f"{x:.0f}" for x in fell), ", ".join(f"{100.0 * x:.0f}" for x in struck)
    holds = [
        (f"gradient of {share.count} process(es) equals that of one to {error:.1e}", error <= SAME_GRADIENT),
        (f"and central differences to {differences:.1e}", differences <= GRADIENT_ERROR),
        (f"a strike keeps the momentum, to {changed:.1e}", changed <= MOMENTUM_ERROR),
        (f"processes have the same weights (spread {spread:.1e})", spread == 0.0),
        (f"every step converged ({failed} did not)", failed == 0),
        (f"{hit} % of {TESTS} new balls were struck", min(struck) >= HIT),
        (f"mean squared distance to {TESTS} new targets fell {listed} times", min(fell) >= FALL),
    ]
    return report(holds) if share.rank == 0 else all(holds for _, holds in holds)


# ---- picture ---------------------------------------------------------------------------------------------------------


def draw(trainings: Sequence[Training], path: Path) -> None:
    target = targets(TESTS, seed=-1)
    with torch.no_grad():
        reached = trainings[0].policy(target)
    losses = np.sqrt([t.losses for t in trainings])

    def fill(figure: Any) -> None:
        left, right = figure.subplots(1, 2)
        label = of_seeds("mean and standard deviation", len(trainings))
        draw_band(left, np.arange(losses.shape[1]), losses, "#1f5fa8", lw=1.2, label=label)
        left.set(xlabel="iteration", ylabel="root of mean squared distance [m]", yscale="log")
        left.grid(True, alpha=0.3)
        left.legend(frameon=False)
        right.plot(*target.T, "o", ms=9, mfc="none", mec="#0a7d33", label="target")
        right.plot(*reached.T, ".", ms=6, color="#b03a2e", label="ball")
        right.plot([0.0, -2.0 * RADIUS - GAP], [0.0, 0.0], "o", ms=12, color="0.7")
        right.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="scenes not trained on")
        right.legend()

    save_figure(path, fill, figsize=(10.0, 4.0))


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    quick = f"one seed, {QUICK_ITERATIONS} iterations"
    parser = make_parser(__doc__, quick, "of the network and its scenes: the first")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="how many (default: %(default)s)")
    parser.add_argument("--iterations", type=int, default=ITERATIONS, help="of training (default: %(default)s)")
    parser.add_argument("--gradient", type=Path, help="file for the gradient of the first iteration (torch.save)")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    with processes() as share:
        iterations = min(options.iterations, QUICK_ITERATIONS) if options.quick else options.iterations
        seeds = range(options.seed, options.seed + (1 if options.quick else options.seeds))
        trainings = [train(share, iterations, seed) for seed in seeds]
        if options.gradient is not None and share.rank == 0:
            torch.save(trainings[0].first_gradient, options.gradient)
        if not options.no_picture and share.rank == 0:
            draw(trainings, options.out / "train_distributed.png")
            results = {"seeds": list(seeds), "mean squared distances [m²]": [t.losses for t in trainings]}
            save_results(options.out / "train_distributed.json", results)
        passed = check(trainings)
        if share.rank == 0:
            verdict, seconds = "passed" if passed else "FAILED", time.perf_counter() - begin
            print(f"{verdict} in {seconds:.0f} s, {share.count} process(es)")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
