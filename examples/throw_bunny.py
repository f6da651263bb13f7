"""Throw the Stanford bunny through a ring, by gradients through its contacts.

The bunny lands in a chute (fixed, non-convex), flies on to a wedge that stands free on the ground and recoils, slides
down its back and jumps off towards a ring (fixed, non-convex). Its launch misses. A PyTorch optimiser changes the
launch velocity and the spin until the centre of mass is in the middle of the ring at a given time; the loss is the
squared distance at that time, and its gradient comes back through every contact on the way. Contact is frictionless
and inelastic.

Contacts have kinks: a launch a little different strikes with another part of the foot. So the optimiser makes smaller
steps the nearer it is, in proportion to the root of the distance that is left; where a step went badly wrong (the bunny
ran into the ring, say) it returns to the best launch so far and goes on with half the rate.

Writes out/throw_bunny.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import fcl
import numpy as np
import torch
import trimesh
from _stage import FloatArray, load_figure, make_parser, report, save_figure, save_results, shift
from torch import Tensor
from tqdm import tqdm

import diffsim as ds
from diffsim.viewer import Camera, Item, draw_items

FACES = 1000  # of the bunny, after decimation
SIZE = 0.1  # longest side of its bounding box [m]
DT = 0.01  # [s]
STEPS = 60
THICKNESS = 5e-4  # distance that surfaces keep [m]
RING = (1.70, 0.11, 0.18)  # its centre, where the bunny shall be after STEPS steps [m]
LAUNCH = (1.8, -0.15, 0.9)  # [m/s]
REACHED = 5e-3  # distance at which the search ends [m]
VELOCITY_RATE, SPIN_RATE = 0.05, 0.4  # of the optimiser, at first [m/s], [rad/s]

WORSE = 4.0  # a loss this many times the best is a step gone wrong

FALL = 100.0  # the squared distance must fall by this
GRADIENT_ERROR = 1e-5  # median over random directions, relative
CONTACTS = 2  # objects the bunny must have touched before it arrives
FREE, GRAVITY = 7, 9.81  # steps before it touches anything; what it shall fall with in them [m/s²]
FLIGHT_ERROR = 1e-9  # [m]


# ---- scene -----------------------------------------------------------------------------------------------------------


def load_mesh(path: str | None = None) -> Any:
    """The mesh in a file, or the bunny: closed, decimated to FACES, centred, its longest side SIZE."""
    return load_figure(path, FACES, SIZE)


def build_scene(mesh: trimesh.Trimesh) -> ds.Scene:
    def rpy(*angles: float) -> FloatArray:
        return ds.rotation.from_rpy(np.array(angles))

    scene = ds.Scene()
    scene.add_ground()
    down_the_chute = ds.rotation.multiply(rpy(0.0, math.radians(22.0), 0.0), rpy(0.0, 0.0, -0.5 * math.pi))
    chute = ds.shapes.u_channel(width=0.34, depth=0.06, length=0.45, wall=0.02)
    scene.add_body(chute, kind="static", position=(0.55, 0.0, 0.77), orientation=down_the_chute, name="chute")
    outline = [(-0.22, 0.0), (0.22, 0.0), (0.22, 0.33), (-0.22, 0.53)]
    wedge = ds.shapes.prism(outline, 0.34)
    upright = ds.rotation.multiply(rpy(0.0, 0.0, 0.25), rpy(0.5 * math.pi, 0.0, 0.0))
    scene.add_body(wedge, density=25.0, position=(1.17, 0.0, 0.0), orientation=upright, name="wedge")
    ring = ds.shapes.torus(radius=0.15, tube=0.012, segments=24, sides=8)
    facing = rpy(0.0, 0.5 * math.pi + 0.5, 0.1)
    scene.add_body(ring, kind="static", position=RING, orientation=facing, name="ring")
    bunny, facing = (mesh.vertices, mesh.faces), rpy(0.0, 0.0, -0.5)
    scene.add_body(bunny, density=1000.0, position=(0.0, 0.0, 0.98), orientation=facing, name="bunny")
    return scene


class Throw:
    """From launch velocity and spin to where the bunny goes."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self.sim = ds.Simulator(build_scene(mesh), dt=DT, thickness=THICKNESS)
        self.rest = self.sim.initial_state()
        self.bunny = self.sim.body_names.index("bunny")
        self.target = torch.tensor(RING, dtype=torch.float64)

    def start(self, velocity: Tensor, spin: Tensor) -> ds.State:
        velocities, spins = self.rest.velocity.clone(), self.rest.angular_velocity.clone()
        velocities[self.bunny], spins[self.bunny] = velocity, spin
        return self.rest.replace(velocity=velocities, angular_velocity=spins)

    def __call__(self, velocity: Tensor, spin: Tensor) -> ds.State:
        return self.sim.rollout(self.start(velocity, spin), None, STEPS)

    def miss(self, trajectory: ds.State) -> Tensor:
        """From the target to the bunny at the end."""
        return trajectory.position[-1, self.bunny] - self.target


# ---- optimisation ----------------------------------------------------------------------------------------------------


@dataclass
class Shot:
    """A launch and what became of it."""

    velocity: Tensor
    spin: Tensor
    trajectory: ds.State
    loss: float  # squared distance [m²]
    failed_steps: int  # of the simulator: none should be

    @property
    def millimetres(self) -> float:
        """How far from the target."""
        return 1e3 * math.sqrt(self.loss)


@dataclass
class Search:
    first: Shot
    best: Shot
    losses: list[float] = field(default_factory=list)


def optimise(throw: Throw, iterations: int, seed: int = 0, quiet: bool = False) -> Search:
    launch = [speed + shift(3 * seed + k, 0.01) if seed else speed for k, speed in enumerate(LAUNCH)]
    velocity = torch.tensor(launch, dtype=torch.float64, requires_grad=True)
    spin = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([{"params": [velocity]}, {"params": [spin]}], betas=(0.7, 0.95))
    rates = [VELOCITY_RATE, SPIN_RATE]
    search: Search | None = None
    with tqdm(total=iterations, desc="throws", unit="throw", disable=quiet) as bar:
        for iteration in range(iterations):
            trajectory = throw(velocity, spin)
            loss = throw.miss(trajectory).square().sum()
            assert throw.sim.info is not None
            shot = Shot(
                velocity.detach().clone(),
                spin.detach().clone(),
                trajectory.detach(),
                loss.item(),
                throw.sim.info.failed_steps,
            )
            if search is None:
                search = Search(shot, shot)
            if shot.loss < search.best.loss:
                search.best = shot
            search.losses.append(shot.loss)
            bar.update()
            if not quiet:
                bar.write(f"throw {iteration:2d}: loss {shot.loss:.3e} m², misses by {shot.millimetres:6.1f} mm")
            if shot.millimetres < 1e3 * REACHED:
                break
            if shot.loss > WORSE * search.best.loss:
                with torch.no_grad():
                    velocity.copy_(search.best.velocity)
                    spin.copy_(search.best.spin)
                optimizer.state.clear()
                rates = [0.5 * rate for rate in rates]
                continue
            optimizer.zero_grad()
            loss.backward()
            for group, rate in zip(optimizer.param_groups, rates):
                group["lr"] = rate * (shot.loss / search.first.loss) ** 0.25
            optimizer.step()
    assert search is not None
    return search


# ---- checks, with nothing of the simulator's own geometry ------------------------------------------------------------


class Judge:
    """Distances and overlaps of the bodies' meshes, by fcl and winding numbers."""

    def __init__(self, throw: Throw) -> None:
        self.throw = throw
        names = throw.sim.body_names
        self.meshes = [throw.sim.mesh(throw.rest, body) for body in range(len(names))]
        for body, mesh in enumerate(self.meshes):  # back to the body's own frame
            mesh.apply_transform(np.linalg.inv(pose(throw.rest, body)))
        self.objects = [fcl.CollisionObject(fcl_mesh(mesh)) for mesh in self.meshes]
        fixed = {names.index("chute"), names.index("ring")}
        self.pairs = [(a, b) for b in range(len(names)) for a in range(b) if not {a, b} <= fixed]

    def place(self, state: ds.State) -> None:
        for body, item in enumerate(self.objects):
            matrix = pose(state, body)
            item.setTransform(fcl.Transform(np.ascontiguousarray(matrix[:3, :3]), matrix[:3, 3].copy()))

    def touched(self, trajectory: ds.State) -> list[str]:
        """What the bunny touches, in this order: something it comes nearer to than twice the distance surfaces keep."""
        bunny, names, order = self.throw.bunny, self.throw.sim.body_names, []
        for state in trajectory:
            self.place(state)
            for other, name in enumerate(names):
                if other == bunny or name in order:
                    continue
                distance = fcl.distance(
                    self.objects[bunny], self.objects[other], fcl.DistanceRequest(), fcl.DistanceResult()
                )
                if distance < 2.0 * THICKNESS:
                    order.append(name)
        return order

    def penetrations(self, trajectory: ds.State) -> list[str]:
        """Pairs that overlap, with each other or the ground, at the end of any step."""
        names, found = self.throw.sim.body_names, []
        for step, state in enumerate(trajectory, 1):
            self.place(state)
            placed = [world(mesh, state, body) for body, mesh in enumerate(self.meshes)]
            found += [f"{names[b]} and the ground, step {step}" for b, x in enumerate(placed) if x[:, 2].min() < 0.0]
            for a, b in self.pairs:
                crosses = fcl.collide(self.objects[a], self.objects[b], fcl.CollisionRequest(), fcl.CollisionResult())
                swallows = any(
                    abs(winding_number(placed[i][:1], placed[j], self.meshes[j].faces)[0]) > 0.5
                    for i, j in ((a, b), (b, a))
                )
                if crosses or swallows:
                    found.append(f"{names[a]} and {names[b]}, step {step}")
        return found


def pose(state: ds.State, body: int) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3] = ds.rotation.to_matrix(state.orientation[body]).numpy()
    matrix[:3, 3] = state.position[body].numpy()
    return matrix


def world(mesh: trimesh.Trimesh, state: ds.State, body: int) -> FloatArray:
    matrix = pose(state, body)
    return np.asarray(mesh.vertices @ matrix[:3, :3].T + matrix[:3, 3])


def fcl_mesh(mesh: trimesh.Trimesh) -> Any:
    model = fcl.BVHModel()
    model.beginModel(len(mesh.vertices), len(mesh.faces))
    model.addSubModel(np.array(mesh.vertices), np.array(mesh.faces))
    model.endModel()
    return model


def winding_number(points: FloatArray, vertices: FloatArray, faces: Any) -> FloatArray:
    """How often a closed surface winds around each point: the solid angles of its triangles over 4π."""
    a, b, c = (vertices[faces[:, k]][None] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    top = (a * np.cross(b, c)).sum(-1)
    bottom = la * lb * lc + (a * b).sum(-1) * lc + (b * c).sum(-1) * la + (c * a).sum(-1) * lb
    return np.asarray(np.arctan2(top, bottom).sum(-1) / (2.0 * np.pi))


def gradient_report(throw: Throw, shot: Shot) -> ds.diagnostics.GradcheckReport:
    """The layer's gradient of where the bunny arrives against central differences.

    Not of the squared distance: at the end that has no gradient to speak of.
    """
    direction = torch.tensor([0.48, -0.64, 0.6], dtype=torch.float64)
    return ds.diagnostics.gradcheck(
        throw.sim,
        throw.start(shot.velocity, shot.spin),
        steps=STEPS,
        wrt=("velocity", "angular_velocity"),
        directions=4,
        eps=1e-7,
        loss=lambda final: (final.position[throw.bunny] - throw.target) @ direction,
        median_tolerance=GRADIENT_ERROR,
        max_tolerance=1e-2,
    )


def flight_error(throw: Throw, shot: Shot) -> float:
    """How far the bunny is off its course before it touches anything, at most [m].

    Implicit Euler has it at start + v t - g t (t + dt) / 2.
    """
    time = DT * torch.arange(1, FREE + 1, dtype=torch.float64)[:, None]
    down = torch.tensor([0.0, 0.0, -GRAVITY], dtype=torch.float64)
    exact = throw.rest.position[throw.bunny] + shot.velocity * time + 0.5 * down * time * (time + DT)
    return float((shot.trajectory.position[:FREE, throw.bunny] - exact).norm(dim=-1).max())


def check(throw: Throw, search: Search) -> bool:
    """Print what must hold and whether it does."""
    first, best = search.first, search.best
    judge = Judge(throw)
    results: list[tuple[str, bool]] = []
    fall = first.loss / best.loss
    results.append((f"squared distance fell {fall:.3g} times (at least {FALL:g})", fall >= FALL))
    off = flight_error(throw, first)
    results.append((f"the bunny flies freely for {FREE * DT:g} s, to {off:.1e} m", off <= FLIGHT_ERROR))
    for name, shot in (("first", first), ("best", best)):
        measured = gradient_report(throw, shot)
        text = (
            f"gradient at the {name} launch: median error {measured.median_error:.1e} against central differences,"
            f" {len(measured.stable)} of {len(measured.directions)} directions with unchanged contacts"
        )
        results.append(
            (text, measured.median_error <= GRADIENT_ERROR and 2 * len(measured.stable) >= len(measured.directions))
        )
    for name, shot in (("first", first), ("best", best)):
        results.append(
            (f"the {name} throw has {shot.failed_steps} steps that did not converge", shot.failed_steps == 0)
        )
        touched = judge.touched(shot.trajectory)
        results.append((f"the {name} throw touches {', '.join(touched) or 'nothing'}", len(touched) >= CONTACTS))
        found = judge.penetrations(shot.trajectory)
        results.append(
            (f"the {name} throw passes through nothing (fcl)" + "".join(f"; {f}" for f in found[:3]), not found)
        )
    return report(results)


# ---- picture ---------------------------------------------------------------------------------------------------------

STROBES = (0, 7, 14, 21, 28, 35, 41, 47, 54, 60)  # steps that are drawn
COLORS = {"chute": (0.62, 0.66, 0.72), "wedge": (0.50, 0.66, 0.80), "ring": (0.30, 0.36, 0.45)}
CAMERA = Camera(-62.0, 20.0)


def draw_shot(axes: Any, throw: Throw, shot: Shot, title: str) -> None:
    """The triangles of all meshes, flat shaded, far ones first; the bunny at STROBES, all else at the end."""
    import matplotlib

    names, final = throw.sim.body_names, shot.trajectory[-1]
    states = [throw.start(shot.velocity, shot.spin), *shot.trajectory]
    items = [Item(throw.sim.mesh(final, body), COLORS[name]) for body, name in enumerate(names) if body != throw.bunny]
    colormap = matplotlib.colormaps["YlOrRd"]
    for step in STROBES:
        fraction = step / (len(states) - 1)
        items.append(Item(throw.sim.mesh(states[min(step, STEPS)], throw.bunny), colormap(0.15 + 0.65 * fraction)[:3]))
    draw_items(axes, items, CAMERA)
    path = CAMERA.project(np.array([state.position[throw.bunny].numpy() for state in states]))
    axes.plot(path[:, 0], path[:, 1], color="0.15", lw=1.0, ls=(0, (4, 3)), zorder=3)
    target = CAMERA.project(throw.target.numpy()[None])[0]
    axes.plot(*target[:2], marker="+", ms=15, mew=2.0, color="#0a7d33", zorder=4)
    axes.plot(*path[-1, :2], marker="o", ms=4.5, color="black", zorder=4)
    axes.set_title(title, fontsize=11, color="0.2")
    axes.set(xlim=(-0.13, 1.82), ylim=(-0.32, 1.07))


def draw(throw: Throw, search: Search, path: Path) -> None:
    def fill(figure: Any) -> None:
        panels = figure.subplots(1, 2)
        for panel, name, shot in ((panels[0], "before", search.first), (panels[1], "after", search.best)):
            title = f"{name}: {shot.millimetres:.1f} mm from the middle of the ring at t = {STEPS * DT:.2f} s"
            draw_shot(panel, throw, shot, title)

    save_figure(path, fill, figsize=(13.2, 4.9))


def summary(throw: Throw, search: Search) -> dict[str, Any]:
    """For a file of results."""
    found: dict[str, Any] = {"squared distances [m²]": search.losses}
    for name, shot in (("first", search.first), ("best", search.best)):
        path = shot.trajectory.position[:, throw.bunny]
        found[name] = {"velocity [m/s]": shot.velocity, "spin [rad/s]": shot.spin, "path [m]": path}
    return found


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    parser = make_parser(__doc__, "the same: it takes seconds", "of the first launch, to 10 mm/s")
    parser.add_argument("--mesh", help="any file trimesh can read, instead of the bunny")
    parser.add_argument("--iterations", type=int, default=60, help="throws at most (default: %(default)s)")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    try:
        mesh = load_mesh(options.mesh)
    except (OSError, ValueError, NotImplementedError) as error:
        parser.error(f"--mesh: {error}")
    throw = Throw(mesh)
    print(f"{len(mesh.faces)} faces, {float(throw.sim.mass[throw.bunny]):.3f} kg; {STEPS} steps of {DT:g} s")
    search = optimise(throw, options.iterations, options.seed)
    for name, shot in (("first", search.first), ("best", search.best)):
        velocity, spin = ([round(x, 4) for x in t.tolist()] for t in (shot.velocity, shot.spin))
        print(f"{name} launch: velocity {velocity} m/s, spin {spin} rad/s, misses by {shot.millimetres:.1f} mm")
    if not options.no_picture:
        draw(throw, search, options.out / "throw_bunny.png")
        save_results(options.out / "throw_bunny.json", summary(throw, search))
    passed = check(throw, search)
    print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
