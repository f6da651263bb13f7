"""A bunny and a chess pawn stand on a cloth on the ground; its corners are lifted, and it carries both away.

As Figs. 5a and 11 of Qiao et al. 2020. The four corners are pinned nodes that move as `Control.node_velocity` says:
upwards and inwards, gently at first and in the end, and then they are held. The cloth slides under the figurines,
closes around them and lifts them off the ground, in one problem with them at each step. Contact is frictionless: what
holds them is the bag. `--friction 0.4` carries them as well.

Writes out/lift_figurines.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from _stage import (
    FloatArray,
    Judge,
    load_figure,
    make_parser,
    report,
    save_figure,
    save_results,
    shift,
    weight_errors,
)
from torch import Tensor
from tqdm import tqdm

import diffsim as ds
from diffsim.viewer import Camera, Item, draw_items

FACES, SIZE, DENSITY = 400, 0.2, 300.0  # of a figurine: faces at most, longest side [m], [kg/m³]
APART = 0.26  # of the figurines' centres [m]
SIDE, NODES = 1.0, 17  # of the cloth [m], along a side
MATERIAL = ds.ClothMaterial(density=0.3, stretch=3000.0, shear=100.0, bend=2.0e-4, damping=0.01)
THICKNESS = 2.0e-3  # distance that surfaces keep [m]
DT = 0.01  # [s]
LIFTING, HOLDING = 1.6, 0.6  # [s]
RISE = 0.95  # of the corners [m]
INWARDS = 0.85  # of their way to the middle

LIFTED = 0.05  # how far a figurine's lowest point is off the ground at the end, at least [m]
COVERED = 0.8  # of the directions from a figurine's centre of mass that meet the cloth, at least; 0.5 at the start
BELOW = 0.98  # the same for the lower half of them, at least
DIRECTIONS = 400
LAST, BALANCE = 10, 1e-3  # steps at the end over which forces are added up; what they may be off, relative


# ---- the scene, and its run ------------------------------------------------------------------------------------------


def pawn() -> Any:
    """A chess pawn: turned, and not convex."""
    profile = [(0, 0), (55, 0), (55, 20), (30, 45), (20, 100), (35, 110), (20, 120), (40, 150), (28, 180), (0, 190)]
    return trimesh.creation.revolve(1e-3 * np.array(profile, dtype=np.float64), sections=12)


def figurines(paths: Sequence[str]) -> list[Any]:
    """The bunny and the pawn, or what the files hold in their places; each stands on z = 0 around the origin."""
    found = [load_figure(paths[0] if paths else None, FACES, SIZE)]
    found.append(load_figure(paths[1], FACES, SIZE) if len(paths) > 1 else pawn())
    for mesh in found:
        low, high = mesh.bounds
        mesh.apply_translation([*(-0.5 * (low + high))[:2], -low[2]])
    return found


def corners(nodes: int) -> list[int]:
    return [0, nodes - 1, nodes * (nodes - 1), nodes * nodes - 1]


def build_scene(meshes: Sequence[Any], nodes: int, turned: float = 0.0, friction: float = 0.0) -> ds.Scene:
    """The figurines, turned about the vertical by an angle [rad], on the cloth on the ground, all with one friction."""
    scene = ds.Scene()
    scene.add_ground(friction=friction)
    for i, (mesh, name) in enumerate(zip(meshes, ("bunny", "pawn"))):
        place = ((i - 0.5) * APART, 0.0, 2.0 * THICKNESS)
        facing = ds.rotation.from_rpy(np.array([0.0, 0.0, turned]))
        scene.add_body(
            (mesh.vertices, mesh.faces),
            density=DENSITY,
            position=place,
            orientation=facing,
            friction=friction,
            name=name,
        )
    sheet = ds.shapes.sheet(SIDE, nodes)
    place = (0.0, 0.0, THICKNESS)
    scene.add_cloth(sheet, MATERIAL, pinned=corners(nodes), position=place, friction=friction, name="cloth")
    return scene


def corner_path(time: float) -> float:
    """How much of their way the corners have behind them: from 0 to 1, its first two derivatives 0 at both ends."""
    part = min(max(time / LIFTING, 0.0), 1.0)
    return part**3 * (10.0 - 15.0 * part + 6.0 * part**2)


def drive(start: Tensor, pinned: Sequence[int], step: int, dt: float) -> ds.Control:
    """The corners' velocity in a step, so that they are on their path at its end."""
    way = torch.cat([-INWARDS * start[:, :2], torch.full((len(start), 1), RISE, dtype=start.dtype)], dim=1)
    velocity = torch.zeros_like(start)
    rate = (corner_path((step + 1) * dt) - corner_path(step * dt)) / dt
    velocity[list(pinned)] = rate * way[list(pinned)]
    return ds.Control(node_velocity=velocity)


@dataclass
class Run:
    """What became of it."""

    scene: ds.Scene
    sim: ds.Simulator
    states: list[ds.State]  # the first is the start
    pinned: list[int]
    failed: list[int]  # steps that did not converge
    seconds: float


def lift(
    meshes: Sequence[Any],
    nodes: int = NODES,
    dt: float = DT,
    turned: float = 0.0,
    friction: float = 0.0,
    quiet: bool = False,
) -> Run:
    scene = build_scene(meshes, nodes, turned, friction)
    sim = ds.Simulator(scene, dt=dt, thickness=THICKNESS)
    states, failed, pinned = [sim.initial_state()], [], corners(nodes)
    begin = time.perf_counter()
    for step in tqdm(range(round((LIFTING + HOLDING) / dt)), desc="lift", unit="step", disable=quiet):
        states.append(sim(states[-1], drive(states[0].node_position, pinned, step, dt)))
        assert sim.info is not None
        if not sim.info.converged:
            failed.append(step + 1)
    return Run(scene, sim, states, pinned, failed, time.perf_counter() - begin)


# ---- checks ----------------------------------------------------------------------------------------------------------


def meets(origin: FloatArray, directions: FloatArray, triangles: FloatArray) -> Any:
    """Which rays meet a triangle; shapes (3,), (n, 3) and (m, 3, 3)."""
    a, b, c = triangles.transpose(1, 0, 2)
    u, v, w = b - a, c - a, origin - a
    across = np.cross(directions[:, None], v[None])
    determinant = (across * u).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        first = (across * w).sum(-1) / determinant
        turned = np.cross(w, u)
        second = (directions @ turned.T) / determinant
        distance = (turned * v).sum(-1)[None] / determinant
    return ((first >= 0.0) & (second >= 0.0) & (first + second <= 1.0) & (distance > 0.0)).any(axis=1)


def sphere_directions(count: int) -> FloatArray:
    """Spread evenly, by the golden angle; from the lowest to the highest."""
    z = -1.0 + (2.0 * np.arange(count) + 1.0) / count
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def check(run: Run) -> bool:
    """Print what must hold and whether it does."""
    first, last = run.states[0], run.states[-1]
    results = [(f"{len(run.failed)} of {len(run.states) - 1} steps did not converge", not run.failed)]
    start = first.node_position[run.pinned]
    way = torch.cat([-INWARDS * start[:, :2], torch.full((len(start), 1), RISE, dtype=start.dtype)], dim=1)
    off = max(
        float((state.node_position[run.pinned] - start - corner_path(step * run.sim.dt) * way).abs().max())
        for step, state in enumerate(run.states)
    )
    results.append((f"the corners are where they are driven, to {off:.1e} m", off < 1e-9))
    cloth = len(run.sim.body_names)
    triangles = run.sim.mesh(last, cloth).triangles
    directions = sphere_directions(DIRECTIONS)
    for body, name in enumerate(run.sim.body_names):
        low = float(run.sim.mesh(last, body).vertices[:, 2].min())
        results.append((f"{name}: lowest point {1e3 * low:.0f} mm over the ground at the end", low > LIFTED))
        met = meets(last.position[body].numpy(), directions, np.asarray(triangles))
        text = f"{name}: cloth in {100.0 * met.mean():.0f} % of the directions around it"
        text += f", {100.0 * met[: DIRECTIONS // 2].mean():.0f} % of those below"
        results.append((text, met.mean() >= COVERED and met[: DIRECTIONS // 2].mean() >= BELOW))
    down = np.array([[1e-4, 2e-4, -1.0]])  # not through the nodes of a symmetric mesh
    fallen = [
        f"{name}, step {step}"
        for step, state in enumerate(run.states)
        for body, name in enumerate(run.sim.body_names)
        if not meets(state.position[body].numpy(), down, np.asarray(run.sim.mesh(state, cloth).triangles)).all()
    ]
    results.append(("cloth is under both all the time" + "".join(f"; not {f}" for f in fallen[:3]), not fallen))
    masses = {body: DENSITY * float(run.sim.mesh(first, body).volume) for body in range(cloth)}
    steps = range(len(run.states) - 1 - LAST, len(run.states) - 1)
    drives = {step: drive(first.node_position, run.pinned, step, run.sim.dt) for step in steps}
    for body, off in weight_errors(run.sim, run.states, drives, masses).items():
        text = f"{run.sim.body_names[body]}: in the last {LAST} steps the cloth carries its weight, to {off:.1e}"
        results.append((text, off < BALANCE))
    # At rest in the end, or nearly: the bag swings.
    weight = run.sim.mass.sum() * 9.81
    swing = float(run.sim.kinetic_energy(last)) / float(weight * RISE)
    results.append((f"the bag hangs: kinetic energy is {100.0 * swing:.2f} % of the work of lifting", swing < 0.05))
    found = Judge(run.scene, run.sim).count(run.states[1:])
    results.append(("nothing passes through anything (ipctk)" + "".join(f"; {f}" for f in found[:3]), not found))
    return report(results)


# ---- picture ---------------------------------------------------------------------------------------------------------

COLORS = ((0.93, 0.62, 0.35), (0.55, 0.45, 0.70))


def draw(run: Run, path: Path) -> None:
    dt, last = run.sim.dt, len(run.states) - 1
    shown = [0, *(round(part * LIFTING / dt) for part in (0.4, 0.6, 0.8)), last]

    def fill(figure: Any) -> None:
        for axes, step in zip(figure.subplots(1, len(shown)), shown):
            state = run.states[step]
            items = [Item(run.sim.mesh(state, body), COLORS[body]) for body in range(len(run.sim.body_names))]
            cloth = run.sim.mesh(state, len(run.sim.body_names))
            items.append(Item(cloth, (0.45, 0.62, 0.80), alpha=0.55, two_sided=True, edges=True))
            draw_items(axes, items, Camera(-62.0, 18.0), split=0.03)
            axes.set(xlim=(-0.72, 0.72), ylim=(-0.3, 1.06))
            axes.set_title(f"t = {step * dt:.2f} s", fontsize=10, color="0.2")

    save_figure(path, fill, figsize=(3.4 * len(shown), 3.5))


def summary(run: Run) -> dict[str, Any]:
    """For a file of results."""
    places = torch.stack([state.position for state in run.states])
    return {
        "dt [s]": run.sim.dt,
        "masses [kg]": dict(zip(run.sim.body_names, run.sim.mass.tolist())),
        "centres of mass [m]": {name: places[:, body] for body, name in enumerate(run.sim.body_names)},
        "steps that did not converge": run.failed,
    }


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    parser = make_parser(__doc__, "13 x 13 nodes, steps of 0.02 s", "of where the figurines look, to 10 degrees")
    parser.add_argument("--mesh", action="append", default=[], help="instead of the bunny; a second one: of the pawn")
    parser.add_argument("--nodes", type=int, default=NODES, help="of the cloth along a side (default: %(default)s)")
    parser.add_argument("--dt", type=float, default=DT, help="time step [s] (default: %(default)s)")
    parser.add_argument("--friction", type=float, default=0.0, help="of everything (default: %(default)s)")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    meshes = figurines(options.mesh)
    nodes, dt = (13, 0.02) if options.quick else (options.nodes, options.dt)
    run = lift(meshes, nodes, dt, shift(options.seed, math.radians(10.0)), options.friction)
    masses = " and ".join(f"{mass:.2f} kg" for mass in run.sim.mass.tolist())
    each = 1e3 * run.seconds / (len(run.states) - 1)
    print(f"{masses} on {nodes} x {nodes} nodes; {each:.0f} ms per step of {dt:g} s")
    if not options.no_picture:
        draw(run, options.out / "lift_figurines.png")
        save_results(options.out / "lift_figurines.json", summary(run))
    passed = check(run)
    print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
