"""Random scenes, simulated and differentiated: no NaN, no penetration, and how often a step did not converge.

    python tests/fuzz.py --scenes 200 --steps 300 --seed 0

Each scene has ten bodies, convex and not, that fall on each other, every second time between four walls. Scene k of
seed S is the same whatever the number of scenes: `--first k --scenes 1` runs it alone.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import diffsim as ds

sys.path.insert(0, str(Path(__file__).parent / "python"))
from penetration import PenetrationCheck

DT = 0.01
WALL = 0.1  # [m]


@dataclass(frozen=True)
class Outcome:
    problems: list[str]
    failed_steps: int
    contacts: int  # in the last step
    seconds: float
    gradient: float  # largest entry


def add_random_body(scene: ds.Scene, rng: np.random.Generator, position: list[float], size: float, kind: str) -> None:
    """A body within a ball of radius size around its mesh's origin."""
    orientation = rng.normal(size=4)
    velocity, spin = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    if kind != "static":
        speed = 2.0 if kind == "dynamic" else 0.3
        velocity, spin = tuple(speed * rng.normal(size=3)), tuple(speed * rng.normal(size=3))
    options: dict[str, Any] = {
        "density": float(10.0 ** rng.uniform(2.0, 4.0)),
        "position": position,
        "orientation": orientation,
        "velocity": velocity,
        "angular_velocity": spin,
        "kind": kind,
    }
    a, b = rng.uniform(0.3, 1.0, size=2)
    shape = rng.choice(["box", "tetrahedron", "l_shape", "u_channel", "torus", "icosphere", "sphere", "capsule"])
    if shape == "sphere":
        scene.add_sphere(size * a, **options)
    elif shape == "capsule":
        radius = 0.5 * size * a
        scene.add_capsule(radius, 2.0 * (size - radius), **options)
    else:
        vertices, faces = {
            "box": lambda: ds.shapes.box((1.0, a, b)),
            "tetrahedron": lambda: ds.shapes.tetrahedron(),
            "l_shape": lambda: ds.shapes.l_shape(1.0, 0.5 * a, b),
            "u_channel": lambda: ds.shapes.u_channel(1.0, b, 1.0, 0.3 * a),
            "torus": lambda: ds.shapes.torus(1.0, 0.5 * a, 8, 5),
            "icosphere": lambda: ds.shapes.icosphere(1.0, 1),
        }[shape]()
        vertices = vertices * (size / np.linalg.norm(vertices, axis=1).max())
        scene.add_body((vertices, faces), **options)


def random_scene(seed: int, index: int, bodies: int) -> ds.Scene:
    rng = np.random.default_rng([seed, index])
    scene = ds.Scene()
    scene.add_ground()
    half = 1.0
    if index % 2:
        for axis in (0, 1):
            for side in (-1.0, 1.0):
                extents, position = [2.0 * half, 2.0 * half, 6.0], [0.0, 0.0, 3.2]
                extents[axis], position[axis] = WALL, side * (half + 0.5 * WALL + 0.01)  # walls apart
                scene.add_body(ds.shapes.box(extents), kind="static", position=position)
    kinds = ["dynamic"] * bodies
    if index % 4 >= 2:
        kinds[0] = "static" if index % 8 >= 4 else "kinematic"
    placed: list[tuple[np.ndarray, float]] = []
    height = 1.0
    while len(placed) < bodies:
        size = rng.uniform(0.15, 0.45)
        centre = rng.uniform([-half + 0.5, -half + 0.5, 0.5], [half - 0.5, half - 0.5, height])
        if all(np.linalg.norm(centre - x) > size + s + 0.02 for x, s in placed):
            add_random_body(scene, rng, centre.tolist(), size, kinds[len(placed)])
            placed.append((centre, size))
        height += 0.01  # so that there is room in the end
    return scene


def run_scene(seed: int, index: int, bodies: int, steps: int) -> Outcome:
    scene = random_scene(seed, index, bodies)
    start = time.perf_counter()
    sim = ds.Simulator(scene, DT)
    generator = torch.Generator().manual_seed(index)
    state = sim.initial_state()
    force = 0.5 * sim.mass[:, None] * torch.randn(*state.velocity.shape, generator=generator, dtype=torch.float64)
    leaves = {
        "position": state.position,
        "orientation": state.orientation,
        "velocity": state.velocity,
        "angular_velocity": state.angular_velocity,
        "force": force,
        "mass": sim.mass,
        "inertia": sim.inertia,
        "gravity": sim.gravity,
    }
    for leaf in leaves.values():
        leaf.requires_grad_()
    try:
        trajectory = sim.rollout(state, ds.Control(force=force), steps)
    except ValueError as error:  # it refuses a state that it made itself
        return Outcome([str(error)], 0, 0, time.perf_counter() - start, 0.0)
    loss = torch.zeros((), dtype=torch.float64)
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        value = getattr(trajectory, name)[-1]
        loss = loss + (value * torch.randn(value.shape, generator=generator, dtype=torch.float64)).sum()
    gradients = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values()))))
    seconds = time.perf_counter() - start

    problems = [f"gradient of {name} is not finite" for name, g in gradients.items() if not bool(g.isfinite().all())]
    problems += [f"gradient of {name} is zero" for name, g in gradients.items() if not g.any()]
    for name in ("position", "orientation", "velocity", "angular_velocity"):
        if not bool(getattr(trajectory, name).isfinite().all()):
            problems.append(f"{name} is not finite")
    check = PenetrationCheck(scene, sim.thickness)
    for step, frame in enumerate(trajectory.detach()):
        problems += [f"after step {step + 1}: {text}" for text in check.problems(sim, frame)]
    assert sim.info is not None
    largest = max(float(g.abs().max()) for g in gradients.values())
    return Outcome(problems, sim.info.failed_steps, sim.info.contacts, seconds, largest)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--bodies", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="index of the first scene")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", ds.ConvergenceWarning)  # they are counted instead
    bad, failed, unconverged_scenes, begin = 0, 0, 0, time.perf_counter()
    for index in range(arguments.first, arguments.first + arguments.scenes):
        outcome = run_scene(arguments.seed, index, arguments.bodies, arguments.steps)
        bad += bool(outcome.problems)
        failed += outcome.failed_steps
        unconverged_scenes += outcome.failed_steps > 0
        print(
            f"scene {index}: {outcome.seconds:.2f} s, {outcome.contacts} contacts at the end, largest gradient"
            f" {outcome.gradient:.1e}, {outcome.failed_steps} steps did not converge, {len(outcome.problems)} problems",
            flush=True,
        )
        for text in outcome.problems[:5]:
            print(f"  {text}", flush=True)
    print(
        f"{arguments.scenes} scenes of {arguments.bodies} bodies and {arguments.steps} steps in"
        f" {time.perf_counter() - begin:.0f} s: {bad} scenes with problems; {failed} of"
        f" {arguments.scenes * arguments.steps} steps in {unconverged_scenes} scenes did not converge"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
