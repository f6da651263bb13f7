"""Random scenes, simulated and differentiated: no NaN, no penetration, and how often a step did not converge.

    python tests/fuzz.py --scenes 200 --steps 300 --seed 0
    python tests/fuzz.py --scenes 40 --steps 100 --bodies 4 --cloths 1 --gradients 20
    python tests/fuzz.py --regular --scenes 200 --steps 60 --gradients 20
    python tests/fuzz.py --friction --scenes 60 --steps 200 --gradients 20

Each scene has ten bodies, convex and not, that fall on each other, every second time between four walls; with --cloths
sheets of random material among them, some of them pinned. With --regular they are those of tests/python/regular_scenes
instead: stacks, walls, rows, with edges parallel and corners above corners. With --gradients k the gradient of every
k-th step is held against differences: it is wrong if it agrees with those of no step size. Scene k of seed S is the
same whatever the number of scenes: `--first k --scenes 1` runs it alone. With --friction all objects of the same scenes
have a coefficient between 0 and 1.5. Where there are neither cloths nor moving bodies energy must not rise, but by what
forces do and turns in contact make (energy_rises.py). With --failures the state before each step that does not converge
is written there.
"""

from __future__ import annotations

import argparse
import json
import statistics
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
import differences
from energy_rises import rises_of_energy
from penetration import CrossingCheck, PenetrationCheck
from regular_scenes import regular_scene

DT = 0.01
WALL = 0.1  # [m]
DIFFERENCES = (1e-6, 1e-5, 3e-6, 3e-7, 1e-7, 3e-8, 1e-8)  # step sizes of central differences
WRONG = 1e-4  # relative error of a derivative; differences have up to a hundredth of that of their own
SLOW = 200.0  # of a scene's median step
MOST_FRICTION = 1.5


@dataclass(frozen=True)
class Outcome:
    problems: list[str]
    failed_steps: int
    blocked_steps: int  # in which a moving body squeezes something: they cannot converge
    contacts: int  # in the last step
    seconds: float
    slowest: float  # step, relative to the median, in process time
    gradient: float  # largest entry
    derivatives: int  # held against differences


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


def add_random_cloth(scene: ds.Scene, rng: np.random.Generator, position: list[float], size: float) -> None:
    """A sheet within a ball of radius size."""
    nodes = int(rng.integers(4, 10))  # along a side
    material = ds.ClothMaterial.isotropic(
        young=float(10.0 ** rng.uniform(4.0, 7.0)),
        thickness=float(10.0 ** rng.uniform(-3.5, -2.5)),
        density=float(10.0 ** rng.uniform(2.0, 3.2)),
        poisson=0.3,
        damping=float(rng.choice([0.0, 1e-4, 1e-3])),
    )
    corners = [0, nodes - 1, nodes * (nodes - 1), nodes**2 - 1]
    scene.add_cloth(
        ds.shapes.sheet(np.sqrt(2.0) * size, nodes),
        material,
        position=position,
        orientation=rng.normal(size=4) * (1.0, 0.3, 0.3, 1.0),
        velocity=tuple(rng.normal(size=3)),
        pinned=corners[: rng.choice([0, 0, 1, 2, 4])],
    )


def random_scene(seed: int, index: int, bodies: int, cloths: int = 0) -> ds.Scene:
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
    while len(placed) < bodies + cloths:
        size = rng.uniform(0.15, 0.45)
        centre = rng.uniform([-half + 0.5, -half + 0.5, 0.5], [half - 0.5, half - 0.5, height])
        if all(np.linalg.norm(centre - x) > size + s + 0.02 for x, s in placed):
            if len(placed) < bodies:
                add_random_body(scene, rng, centre.tolist(), size, kinds[len(placed)])
            else:
                add_random_cloth(scene, rng, centre.tolist(), size)
            placed.append((centre, size))
        height += 0.01  # so that there is room in the end
    return scene


def wrong_derivatives(sim: ds.Simulator, state: ds.State, control: ds.Control, seed: int) -> tuple[int, list[str]]:
    """How many derivatives of one step could be held against differences, and those that agree with none of them."""
    found: dict[int, list[ds.diagnostics.DirectionCheck]] = {}  # per direction, one for each step size
    for eps in DIFFERENCES:
        try:
            report = ds.diagnostics.gradcheck(sim, state, control, directions=1, eps=eps, seed=seed)
        except ValueError as error:  # a contact under load has less room than eps
            if "take a smaller eps" not in str(error):
                raise
            continue
        for k, check in enumerate(report.directions):
            if not check.active_set_changed:
                found.setdefault(k, []).append(check)
        if found and not any(map(disagreement, found.values())):
            break
    return len(found), [text for checks in found.values() if (text := disagreement(checks))]


def disagreement(checks: list[ds.diagnostics.DirectionCheck]) -> str:
    """Empty if the derivative agrees with a difference, or is as near to one as these are to each other: rounding."""
    best = min(checks, key=lambda check: check.error)
    differences = [check.difference for check in checks]
    spread = max(differences) - min(differences)
    if best.error <= WRONG or abs(best.derivative - best.difference) <= spread:
        return ""
    return f"derivative by {best.name} is {best.derivative:g}, differences say {best.difference:g}"


def save(state: ds.State, directory: Path, name: str) -> None:
    directory.mkdir(parents=True, exist_ok=True)
    fields = {name: value.tolist() for name, value in vars(state.detach()).items() if value is not None}
    (directory / f"{name}.json").write_text(json.dumps(fields))


def run_scene(
    scene: ds.Scene, index: int, steps: int, every: int, failures: Path | None, regular: bool, friction: int | None
) -> Outcome:
    """`every`: steps from one that is held against differences to the next; 0 for none. `friction`: seed of the
    coefficients.
    """
    start = time.perf_counter()
    sim = ds.Simulator(scene, DT)
    if friction is not None:
        rng = np.random.default_rng([friction, index, 1])
        sim.friction.copy_(torch.from_numpy(rng.uniform(0.0, MOST_FRICTION, size=sim.friction.shape)))
    generator = torch.Generator().manual_seed(index)
    state = sim.initial_state()
    cloths = state.node_position.numel() > 0
    force = 0.5 * sim.mass[:, None] * torch.randn(*state.velocity.shape, generator=generator, dtype=torch.float64)
    if regular:
        force = torch.zeros_like(force)
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
    fields = ["position", "orientation", "velocity", "angular_velocity"]
    if cloths:
        fields += ["node_position", "node_velocity"]
        leaves |= {"node_position": state.node_position, "node_velocity": state.node_velocity}
        leaves |= {name: getattr(sim, name) for name in ("cloth_density", "cloth_stretch", "cloth_shear", "cloth_bend")}
    if friction is not None:
        leaves["friction"] = sim.friction
    for leaf in leaves.values():
        leaf.requires_grad_()
    control = ds.Control(force=force)
    frames, times, failed, blocked, contacts = [state], [], 0, 0, 0
    for step in range(1, steps + 1):
        begin = time.process_time()
        try:
            frames.append(sim(frames[-1], control))
        except ValueError as error:  # it refuses a state that it made itself
            seconds = time.perf_counter() - start
            return Outcome([f"step {step}: {error}"], failed, blocked, contacts, seconds, 0.0, 0.0, 0)
        times.append(time.process_time() - begin)
        assert sim.info is not None
        contacts = sim.info.contacts
        if any(failure.status == "blocked" for failure in sim.info.failures):
            blocked += 1
        elif not sim.info.converged:
            failed += 1
            if failures is not None:
                save(frames[-2], failures, f"scene_{index}_before_step_{step}")
    end = frames[-1]
    loss = torch.zeros((), dtype=torch.float64)
    for name in fields:
        value = getattr(end, name)
        loss = loss + (value * torch.randn(value.shape, generator=generator, dtype=torch.float64)).sum()
    gradients = dict(zip(leaves, torch.autograd.grad(loss, list(leaves.values()))))
    seconds = time.perf_counter() - start

    problems = [f"gradient of {name} is not finite" for name, g in gradients.items() if not bool(g.isfinite().all())]
    if not regular:  # where nothing turns, inertia has none
        problems += [f"gradient of {name} is zero" for name, g in gradients.items() if not g.any()]
    for name in fields:
        if not bool(getattr(end, name).isfinite().all()):
            problems.append(f"{name} is not finite")
    if not cloths and not bool((sim._packed.kind == 2).any()):  # nor what moves as it is told
        problems += rises_of_energy(sim, frames, control)
    slowest = max(times) / statistics.median(times)
    largest = max(float(g.abs().max()) for g in gradients.values())

    checks: list[Any] = [PenetrationCheck(scene, sim.thickness)]
    if cloths:
        checks.append(CrossingCheck(scene, sim.thickness))
    derivatives = 0
    hold = differences.wrong_derivatives if regular else wrong_derivatives
    for step, frame in enumerate((frame.detach() for frame in frames[1:]), 1):
        found = [text for check in checks for text in check.problems(sim, frame)]
        if every and step % every == 0 and not blocked:  # such a body has no room to be moved for a difference
            with torch.no_grad():
                sim(frame, ds.Control(force=force))
            if sim.info.converged:  # else the step ended short of what is differentiated
                count, wrong = hold(sim, frame, ds.Control(force=force.detach()), step)
                derivatives += count
                found += wrong
        problems += [f"after step {step}: {text}" for text in found]
    return Outcome(problems, failed, blocked, contacts, seconds, slowest, largest, derivatives)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=200)
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--bodies", type=int, default=10)
    parser.add_argument("--cloths", type=int, default=0)
    parser.add_argument("--gradients", type=int, default=0, help="every so many steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="index of the first scene")
    parser.add_argument("--regular", action="store_true", help="scenes in which everything is aligned")
    parser.add_argument("--friction", action="store_true", help="between all objects, at random")
    parser.add_argument("--failures", type=Path, help="directory for the states before steps that do not converge")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", ds.ConvergenceWarning)  # they are counted instead
    bad, failed, blocked, unconverged_scenes, slow, derivatives, begin = 0, 0, 0, 0, 0, 0, time.perf_counter()
    for index in range(arguments.first, arguments.first + arguments.scenes):
        if arguments.regular:
            scene = regular_scene(arguments.seed, index)
        else:
            scene = random_scene(arguments.seed, index, arguments.bodies, arguments.cloths)
        outcome = run_scene(
            scene,
            index,
            arguments.steps,
            arguments.gradients,
            arguments.failures,
            arguments.regular,
            arguments.seed if arguments.friction else None,
        )
        derivatives += outcome.derivatives
        bad += bool(outcome.problems)
        failed += outcome.failed_steps
        blocked += outcome.blocked_steps
        unconverged_scenes += outcome.failed_steps > 0
        slow += outcome.slowest > SLOW
        print(
            f"scene {index}: {outcome.seconds:.2f} s, {outcome.contacts} contacts at the end, largest gradient"
            f" {outcome.gradient:.1e}, slowest step {outcome.slowest:.0f} medians{' (!)' * (outcome.slowest > SLOW)},"
            f" {outcome.failed_steps} steps did not converge, {outcome.blocked_steps} blocked,"
            f" {len(outcome.problems)} problems",
            flush=True,
        )
        for text in outcome.problems[:5]:
            print(f"  {text}", flush=True)
    print(
        f"{arguments.scenes} scenes of {'regular' if arguments.regular else arguments.bodies} bodies and"
        f" {arguments.steps} steps in {time.perf_counter() - begin:.0f} s: {bad} scenes with problems; {failed} of"
        f" {arguments.scenes * arguments.steps} steps in {unconverged_scenes} scenes did not converge,"
        f" {blocked} were blocked; a step took more than {SLOW:.0f} medians in {slow} scenes;"
        f" {derivatives} derivatives held against differences"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
