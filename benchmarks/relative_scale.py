"""A bunny strikes a cloth that is 1 to 100 times as large: Fig. 3, bottom, of Qiao et al. 2020, and ten times as far.

The bunny (about 500 faces, 0.17 m) falls at 1 m/s on the middle of a square cloth of 9 x 9 nodes that is held at its
four corners; the cloth's side is the scale in metres, its mesh always the same. 2 s in steps of 0.02 s, one thread,
forward alone and with the gradient of a loss on the final state. Time and memory should not depend on the scale:
nothing here fills space with cells, as grids and particles have to. They do depend on how the cloth moves, which is
not the same for cloths of other sizes; Newton's iterations per step are printed beside. One CSV line per scale,
medians over rounds, then the ratios of the largest to the smallest of a column, and a plot.

MPM's memory grows with the volume at a given size of the cells: with the scale's third power, and its surface's with
the second. Needs the extras `bench` and `examples` (for the bunny).
"""

from __future__ import annotations

import statistics
import sys
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _common import (
    Clock,
    Table,
    added_memory,
    advance,
    differentiate,
    draw_curves,
    in_fresh_process,
    in_turns,
    make_parser,
    print_header,
    save_plot,
)

import diffsim as ds

SCALES = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0, 30.0, 100.0)
DT, STEPS = 0.02, 100
NODES = 9  # per side
DENSITY = 0.374  # of the cloth [kg/m²]
FACES, SIZE, BODY_DENSITY = 510, 0.17, 200.0  # of the bunny: 257 vertices
GAP, SPEED = 0.05, 1.0  # from the bunny to the cloth [m], its velocity down [m/s]
COLUMNS = ("scale", "steps", "forward_s", "forward_backward_s", "memory_mb", "steps_with_contact")
COLUMNS += ("iterations_per_step", "most_iterations")


def build_scene(mesh: Any, scale: float) -> ds.Scene:
    scene = ds.Scene(gravity=(0.0, 0.0, -9.8))
    at = np.linspace(-0.5 * scale, 0.5 * scale, NODES)
    x, y = np.meshgrid(at, at, indexing="ij")
    vertices = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    corner = np.arange(NODES * NODES).reshape(NODES, NODES)
    a, b, c, d = (corner[i : i + NODES - 1, j : j + NODES - 1].ravel() for i in (0, 1) for j in (0, 1))
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    pinned = corner[[0, 0, -1, -1], [0, -1, 0, -1]].tolist()
    material = ds.ClothMaterial(density=DENSITY)
    scene.add_cloth((vertices, faces), material=material, pinned=pinned, name="cloth")
    bottom = float(mesh.vertices[:, 2].min())
    scene.add_body(
        (mesh.vertices, mesh.faces),
        density=BODY_DENSITY,
        position=(0.013, 0.007, GAP - bottom),  # off the middle node: there the gradient has a kink
        velocity=(0.0, 0.0, -SPEED),
        name="bunny",
    )
    return scene


def measure(mesh: Any, scale: float, steps: int, rounds: int, clock: Clock) -> dict[str, Any]:
    """One row, in a fresh process."""
    torch.set_num_threads(1)
    made: dict[str, Any] = {}

    def make_and_differentiate() -> None:
        made["sim"] = ds.Simulator(build_scene(mesh, scale), dt=DT, thickness=1e-3, num_threads=1, on_failure="raise")
        made["start"] = made["sim"].initial_state()
        differentiate(made["sim"], made["start"], steps)

    row: dict[str, Any] = {"scale": scale, "steps": steps, "memory_mb": added_memory(make_and_differentiate)}
    sim, state = made["sim"], made["start"]
    iterations, contacts = [], 0
    with torch.no_grad():
        for _ in range(steps):
            state = sim(state)
            iterations.append(sim.info.iterations)
            contacts += sim.info.contacts > 0
    row["steps_with_contact"] = contacts
    row["iterations_per_step"], row["most_iterations"] = statistics.mean(iterations), max(iterations)
    cases = {
        "forward_s": partial(advance, sim, made["start"], steps),
        "forward_backward_s": partial(differentiate, sim, made["start"], steps),
    }
    row.update({name: statistics.median(values) for name, values in in_turns(cases, rounds, clock).items()})
    return row


def draw(rows: list[dict[str, Any]], figure: Any) -> None:
    scales = [row["scale"] for row in rows]
    times = {"forward + backward": "forward_backward_s", "forward": "forward_s"}
    left, right = figure.subplots(1, 2)
    draw_curves(
        left,
        {name: (scales, [row[column] for row in rows]) for name, column in times.items()},
        "size of the cloth / 1 m",
        f"time for {STEPS} steps [s]",
    )
    memory = {"forward + backward": (scales, [row["memory_mb"] for row in rows])}
    draw_curves(right, memory, "size of the cloth / 1 m", "peak of memory added [MB]")
    for axes in (left, right):
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, high / 30.0), high * 3.0)


def main() -> int:
    parser = make_parser(__doc__, rounds=3, plot=True)
    parser.add_argument("--scales", type=float, nargs="+", default=SCALES, help="of the cloth")
    options = parser.parse_args()
    steps = STEPS
    if options.quick:
        options.scales, options.rounds, steps = [1.0], 1, 10
    print_header(clock=options.clock)
    sys.path.append(str(Path(__file__).resolve().parents[1] / "examples"))
    from _stage import load_figure  # the bunny; only here, since what it imports takes memory

    mesh = load_figure(None, FACES, SIZE)
    print(f"# bunny: {len(mesh.vertices)} vertices; cloth: {NODES * NODES} nodes")
    table = Table(COLUMNS)
    for scale in options.scales:
        table.add(in_fresh_process(measure, mesh, scale, steps, options.rounds, options.clock))
    for name in ("forward_s", "forward_backward_s", "memory_mb"):
        values = [row[name] for row in table.rows]
        print(f"# {name}: largest / smallest {max(values) / min(values):.2f}")
    save_plot(options.out / "relative_scale.png", partial(draw, table.rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
