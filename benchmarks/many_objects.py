"""Many objects in an ever larger space: Fig. 3, top, of Qiao et al. 2020, and ten times as far.

N cubes of edge 0.1 m on a grid whose lines stand the further apart the more there are, 0.2 m above the ground and
moving down at 1 m/s; 2 s in steps of 0.02 s, one thread. Ours (forward alone, and with the gradient of a loss on the
final state with respect to the initial state and the masses) and MuJoCo's forward take turns in the same process.
Prints one CSV line per N: medians over rounds; how far the process's memory rose at most while the scene was built
and differentiated, and while MuJoCo's was built and advanced; and what others need on such a machine, measured apart
(see OTHERS). Then the log-log slopes, and a plot. Needs the extra `bench`.
"""

from __future__ import annotations

import math
import statistics
import sys
from functools import partial
from typing import Any

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
    median_ratio,
    print_header,
    print_slopes,
    save_plot,
)
from _mujoco import boxes, faster, ways_to_step

import diffsim as ds

COUNTS = (20, 100, 200, 300, 1000, 3000, 10000)
DT, STEPS = 0.02, 100
EDGE, HEIGHT, SPEED, DENSITY = 0.1, 0.2, 1.0, 1000.0
SPACING, GROWTH = 0.15, 0.02  # of the first line [m]; what every further line adds, in parts of it

# Measured apart from this script on 2 shared cores, one thread, as it runs: falling cubes, 2 s, forward + backward.
# - MPM: DiffTaichi's (taichi 1.7.4), 5 cells per cube, without its 96 to 274 s of compilation. 100 cubes took 19 GB;
#   more did not fit into 24.
# - The paper's own code (2020, on torch 2.15): 0.526, 1.032, 1.776 s for a step with all cubes on the ground, times
#   STEPS.
OTHERS: dict[int, dict[str, float]] = {
    20: {"mpm_s": 47, "mpm_memory_mb": 3900},
    100: {"mpm_s": 230, "mpm_memory_mb": 19000, "paper_code_s": 52.6},
    200: {"paper_code_s": 103.2},
    300: {"paper_code_s": 177.6},
}

TIMES = ("forward_s", "forward_backward_s", "mujoco_forward_s")
COLUMNS = ("objects", "steps", *TIMES, "forward_to_mujoco", "forward_backward_to_mujoco")
COLUMNS += ("memory_mb", "mujoco_memory_mb", "mpm_s", "mpm_memory_mb", "paper_code_s")


def build_scene(count: int) -> ds.Scene:
    scene = ds.Scene(gravity=(0.0, 0.0, -9.8))
    scene.add_ground()
    mesh, side, y = ds.shapes.box(EDGE), math.isqrt(count - 1) + 1, 0.0
    for index in range(count):
        line, place = divmod(index, side)
        spacing = SPACING * (1.0 + GROWTH * line)
        if place == 0:
            y += spacing
        position = (spacing * place, y, HEIGHT + 0.5 * EDGE)
        scene.add_body(mesh, density=DENSITY, position=position, velocity=(0.0, 0.0, -SPEED), name=f"cube_{index}")
    return scene


def measure(count: int, rounds: int, clock: Clock) -> dict[str, Any]:
    """One row, in a fresh process."""
    torch.set_num_threads(1)
    made: dict[str, Any] = {}

    def make_and_differentiate() -> None:
        made["sim"] = ds.Simulator(build_scene(count), dt=DT, num_threads=1, on_failure="raise")
        made["start"] = made["sim"].initial_state()
        differentiate(made["sim"], made["start"], STEPS)

    def make_and_advance_mujoco() -> None:
        down = (0.0, 0.0, -SPEED)
        position = made["start"].position.numpy()
        made["mujoco"] = ways_to_step(*boxes(position, EDGE, dt=DT, gravity=9.8, density=DENSITY, velocity=down), STEPS)
        made["mujoco"]["mj_step"]()

    row: dict[str, Any] = {"objects": count, "steps": STEPS, "memory_mb": added_memory(make_and_differentiate)}
    row["mujoco_memory_mb"] = added_memory(make_and_advance_mujoco)
    sim, start = made["sim"], made["start"]
    height = float(advance(sim, start, STEPS).position[-1, :, 2].max())
    assert height < 0.5 * EDGE * 1.01, f"a cube is not on the ground: {height}"
    cases = {"forward": partial(advance, sim, start, STEPS), "both": partial(differentiate, sim, start, STEPS)}
    cases.update({f"mujoco {way}": call for way, call in made["mujoco"].items()})
    seconds = in_turns(cases, rounds, clock)
    mujoco = faster(seconds, "mujoco ")
    medians = (statistics.median(s) for s in (seconds["forward"], seconds["both"], mujoco))
    row.update(zip(TIMES, medians))
    row["forward_to_mujoco"] = median_ratio(seconds["forward"], mujoco)
    row["forward_backward_to_mujoco"] = median_ratio(seconds["both"], mujoco)
    return row | OTHERS.get(count, {})


def draw(rows: list[dict[str, Any]], figure: Any) -> None:
    counts = [row["objects"] for row in rows]
    curves = (
        {
            "diffsim, forward + backward": "forward_backward_s",
            "diffsim, forward": "forward_s",
            "MuJoCo, forward": "mujoco_forward_s",
            "MPM, forward + backward (apart)": "mpm_s",
            "paper's code, both (apart)": "paper_code_s",
        },
        {
            "diffsim, forward + backward": "memory_mb",
            "MuJoCo, forward": "mujoco_memory_mb",
            "MPM, forward + backward (apart)": "mpm_memory_mb",
        },
    )
    for axes, names, label in zip(figure.subplots(1, 2), curves, ("time for 2 s [s]", "peak of memory added [MB]")):
        values = {name: (counts, [row.get(column) for row in rows]) for name, column in names.items()}
        draw_curves(axes, values, "objects", label)


def main() -> int:
    parser = make_parser(__doc__, rounds=5, plot=True)
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="numbers of objects")
    options = parser.parse_args()
    if options.quick:
        options.counts, options.rounds = [20], 1
    print_header("mujoco", clock=options.clock)
    table = Table(COLUMNS)
    for count in options.counts:
        table.add(in_fresh_process(measure, count, options.rounds, options.clock))
    print_slopes({name: table.curve("objects", name) for name in TIMES})
    save_plot(options.out / "many_objects.png", partial(draw, table.rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
