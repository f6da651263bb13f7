"""Cloth: error against run time. One sheet in diffsim, MuJoCo's flex and Newton's VBD; one thread, forward only.

Rubber as in `cloth.py` (5 MPa, 1 mm), 1 m wide, 21 x 21 nodes, on one mesh and with equal masses in all three. Scenes:

- hung: by two corners, released level; no contact; the end is at 0.4 s.
- draped: pinned at its four corners, released level 10 mm over a fixed sphere, frictionless; the end is at 0.12 s, some
  0.07 s after the first contact. Later, waves that come back from the corners make the end depend on dt too much; and a
  sheet that falls freely on the sphere buckles: it turns 1e-6 m at the start into millimetres within 40 ms of contact.

A line says how many times as far the end moves if all nodes start 1e-6 m elsewhere: little, so ends can be compared.

Effort is varied by dt, and by what a step does: diffsim solves it to 1e-10 (its default) or 1e-2, or as in its paper,
with `coupling="split"` and one, two or four Newton iterates. VBD sweeps 10 (its default), 30 or 100 times. MuJoCo's
integrator "discrete" takes one linearised step, solved by CG to 1e-4: the ends are within 0.02 mm of those to 1e-14; in
the scene with contact also with the flag "ipc", which keeps surfaces apart. Self-contact is off in the peers, and VBD
meets the sphere with faces and not only with nodes, as the others do.

Errors are root mean square distances of the nodes at the end:

- `error_mm`, all in all: from the simulator's own limit dt -> 0, extrapolated from two smaller steps as for errors of
  first order. A line says how far that is from the extrapolation with steps twice as large.
- `way_error_mm`, the same, root mean square over some moments of the second half: at the start of a motion all steps of
  one size are as exact, and what linearising leaves out grows with it.
- `step_error_mm`, of not solving the step: from diffsim's converged steps of the same dt.

VBD takes too long for a limit of its own: its errors are from diffsim's, which has the same energy at small strains.
Lines say how far the limits of MuJoCo are from diffsim's, and VBD's most sweeps from diffsim's steps of the same, small
dt: step errors of the peers below that mean nothing. They are left out where contacts are too different: without "ipc"
MuJoCo's sheet goes into the sphere, by `depth_mm` (of the middle of its thickness, most over time).

Limits: two scenes, one mesh, one material, smooth motion. Finer sheets need more sweeps for the same error: on 11 x 11
nodes VBD is 20 times nearer with 100 sweeps of 0.0025 s. VBD is made for GPUs; here all run on one core of a CPU.

Prints one CSV line per run, medians of rounds (of one, where it takes longer than a second); comment lines with the run
times at which the curves pass an error, and with what the loose tolerance does to a gradient; draws
out/cloth_accuracy.png. Needs the extra `bench`.
"""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import torch
from _cloth_scenes import (
    RADIUS,
    THICK,
    Sheet,
    VbdSheet,
    make_flex,
    make_simulator,
    raise_if_unstable,
    why_no_newton,
)
from _common import Clock, Table, draw_curves, make_parser, print_header, save_plot
from numpy.typing import NDArray

import diffsim as ds

STEPS = (0.02, 0.01, 0.005, 0.0025, 0.00125, 0.000625)  # [s]
LONG = 1.0  # a run that takes longer is timed once [s]
PASSED = (20.0, 10.0, 5.0, 2.0)  # errors at which run times are compared [mm]
LOOSE = 1.0e-2  # tolerance
MOVED = 1.0e-6  # of the start, to see whether the end is stable [m]
COLUMNS = ("scene", "name", "dt_s", "time_ms_per_s", "step_error_mm", "error_mm", "way_error_mm", "depth_mm")

Trajectory = NDArray[np.float64]  # (steps, nodes, 3)
Call = Callable[[], Trajectory]


@dataclass(frozen=True)
class Scene:
    name: str
    sheet: Sheet
    duration: float  # [s]
    looks: tuple[float, ...]  # for errors on the way [s]

    def steps(self, dt: float) -> int:
        return round(self.duration / dt)


def make_scenes(nodes: int) -> tuple[Scene, Scene]:
    top = nodes * (nodes - 1)
    hung = Sheet(nodes, (0.0, 0.0, 0.0), pinned=(0, nodes - 1), sphere=False, self_contact=False)
    corners = (0, nodes - 1, top, top + nodes - 1)
    draped = Sheet(nodes, (0.013, 0.007, RADIUS + 0.5 * THICK + 0.01), pinned=corners, self_contact=False)
    return Scene("hung", hung, 0.4, (0.2, 0.3, 0.4)), Scene("draped", draped, 0.12, (0.06, 0.08, 0.1, 0.12))


# ---- one run of each simulator ---------------------------------------------------------------------------------------


def run_diffsim(scene: Scene, dt: float, moved: float = 0.0, **options: Any) -> Call:
    sim = make_simulator(scene.sheet, dt, **options)
    start = sim.initial_state()
    noise = moved * torch.randn(start.node_position.shape, generator=torch.Generator().manual_seed(0)).double()
    bodies = (start.position, start.orientation, start.velocity, start.angular_velocity)
    start = ds.State(*bodies, start.node_position + noise, start.node_velocity)

    def call() -> Trajectory:
        with torch.no_grad():
            return sim.rollout(start, None, scene.steps(dt)).node_position.numpy()

    return call


def run_mujoco(scene: Scene, dt: float, ipc: bool = False) -> Call:
    model = make_flex(scene.sheet, dt, ipc=ipc)
    data, start = mujoco.MjData(model), scene.sheet.points
    free = np.setdiff1d(np.arange(len(start)), scene.sheet.pinned)

    def call() -> Trajectory:
        mujoco.mj_resetData(model, data)
        moved = []
        for _ in range(scene.steps(dt)):
            mujoco.mj_step(model, data)
            moved.append(data.qpos.copy())  # flexvert_xpos is of the step's start
        raise_if_unstable(data)
        result = np.tile(start, (len(moved), 1, 1))
        result[:, free] += np.reshape(moved, (len(moved), -1, 3))  # three slides for a node
        return result

    return call


def run_vbd(scene: Scene, dt: float, sweeps: int) -> Call:
    sheet = VbdSheet(scene.sheet, dt, sweeps)

    def call() -> Trajectory:
        sheet.reset()
        result = []
        for _ in range(scene.steps(dt)):
            sheet.step()
            result.append(sheet.positions.copy())
        return np.asarray(result, dtype=np.float64)

    return call


@dataclass(frozen=True)
class Method:
    """A curve of the plot: runs of these steps."""

    name: str
    steps: Sequence[float]  # dt [s]
    run: Callable[[Scene, float], Call]
    limit: str  # the method whose limit its errors are from
    same_contact: bool = True  # as diffsim's, so that steps can be compared


def make_methods(scene: Scene, steps: Sequence[float], sweeps: Sequence[int]) -> list[Method]:
    methods = [
        Method("diffsim", steps, run_diffsim, "diffsim"),
        Method(f"diffsim tolerance {LOOSE:g}", steps, partial(run_diffsim, tolerance=LOOSE), "diffsim"),
    ]
    for count in (1, 2, 4):
        run = partial(run_diffsim, coupling="split", newton_iterations=count)
        methods.append(Method(f"diffsim split {count} Newton", steps[:4], run, "diffsim"))
    more_steps = (*steps, 0.5 * steps[-1])
    methods.append(Method("MuJoCo flex", more_steps, run_mujoco, "MuJoCo flex", same_contact=not scene.sheet.sphere))
    if scene.sheet.sphere:
        methods.append(Method("MuJoCo flex ipc", more_steps, partial(run_mujoco, ipc=True), "MuJoCo flex ipc"))
    for count, last in zip(sweeps, (None, -1, -1)):  # more sweeps take longer, and do not need the smallest steps
        methods.append(Method(f"VBD {count} sweeps", steps[1:last], partial(run_vbd, sweeps=count), "diffsim"))
    return methods


# ---- errors ----------------------------------------------------------------------------------------------------------


def distance(a: NDArray[Any], b: NDArray[Any]) -> float:
    """Root mean square [mm]."""
    return 1e3 * math.sqrt(np.square(a - b).sum(axis=-1).mean())


def seen(scene: Scene, dt: float, trajectory: Trajectory) -> Trajectory:
    """At the moments of `looks`, the last of which is the end."""
    return trajectory[[round(time / dt) - 1 for time in scene.looks]]


def depth_mm(sheet: Sheet, trajectory: Trajectory) -> float | None:
    return 1e3 * max(0.0, *(-sheet.gap(positions) for positions in trajectory)) if sheet.sphere else None


def timed(call: Call, clock: Clock, rounds: int) -> tuple[Trajectory, float]:
    seconds: list[float] = []
    while not seconds or (len(seconds) < rounds and seconds[0] < LONG):
        begin = clock()
        trajectory = call()
        seconds.append(clock() - begin)
    return trajectory, statistics.median(seconds)


def gradient(scene: Scene, dt: float, tolerance: float) -> torch.Tensor:
    """Of the mean height at the end, to where the nodes start."""
    sim = make_simulator(scene.sheet, dt, tolerance=tolerance)
    start = sim.initial_state()
    start.node_position.requires_grad_()
    height = sim.rollout(start, None, scene.steps(dt)).node_position[-1, :, 2].mean()
    return torch.autograd.grad(height, start.node_position)[0]


def limit_of(ends: dict[float, NDArray[Any]], finest: float) -> NDArray[Any]:
    return 2.0 * ends[finest] - ends[2.0 * finest]


def time_at(error: float, times: list[float], errors: list[float]) -> str:
    """Where the curve, straight between its points on log-log axes, first falls below the error."""
    if errors[0] <= error:
        return f"<{times[0]:.0f}"  # with the largest step already
    for (t0, e0), (t1, e1) in pairwise(zip(times, errors)):
        if e0 > error >= e1:
            return f"{t0 * (t1 / t0) ** (math.log(e0 / error) / math.log(e0 / e1)):.0f}"
    return "-"


def measure(scene: Scene, methods: list[Method], steps: Sequence[float], options: Any, table: Table) -> None:
    trajectories: dict[tuple[str, float], Trajectory] = {}
    seconds: dict[tuple[str, float], float] = {}
    for method in methods:
        for dt in method.steps:
            run = timed(method.run(scene, dt), options.clock, options.rounds)
            trajectories[method.name, dt], seconds[method.name, dt] = run
    limits = {}
    for method in methods:
        if method.limit == method.name:
            ways = {dt: seen(scene, dt, trajectories[method.name, dt]) for dt in method.steps}
            finest = 0.5 * method.steps[-1]
            ways[finest] = seen(scene, finest, method.run(scene, finest)())
            limits[method.name] = limit_of(ways, finest)
            doubt = distance(limits[method.name][-1], limit_of(ways, 2.0 * finest)[-1])
            apart = distance(limits[method.name][-1], limits["diffsim"][-1])
            print(f"# {scene.name}: limit of {method.name} +- {doubt:.2g} mm, from diffsim's {apart:.2g} mm")
    moved = run_diffsim(scene, steps[-1], MOVED)()[-1]
    growth = 1e-3 * distance(moved, trajectories["diffsim", steps[-1]][-1]) / (MOVED * math.sqrt(3.0))
    print(f"# {scene.name}: a start moved by {MOVED:g} m moves the end {growth:.2g} times as far")
    tight, loose = (gradient(scene, steps[2], tolerance) for tolerance in (1e-10, LOOSE))
    change = float((loose - tight).norm() / tight.norm())
    print(f"# {scene.name}: tolerance {LOOSE:g} changes a gradient by {change:.1g} of its size at dt = {steps[2]:g}")
    last = methods[-1]
    if last.name.startswith("VBD"):
        gap = distance(*(trajectories[name, last.steps[-1]][-1] for name in (last.name, "diffsim")))
        print(f"# {scene.name}: {last.name} of {last.steps[-1]:g} s end {gap:.2g} mm from where diffsim's do")
    for method in methods:
        for dt in method.steps:
            trajectory = trajectories[method.name, dt]
            end, converged = trajectory[-1], trajectories.get(("diffsim", dt))
            table.add(
                {
                    "scene": scene.name,
                    "name": method.name,
                    "dt_s": dt,
                    "time_ms_per_s": 1e3 * seconds[method.name, dt] / scene.duration,
                    "step_error_mm": distance(end, converged[-1])
                    if method.same_contact and converged is not None
                    else None,
                    "error_mm": distance(end, limits[method.limit][-1]),
                    "way_error_mm": distance(seen(scene, dt, trajectory), limits[method.limit]),
                    "depth_mm": depth_mm(scene.sheet, trajectory),
                }
            )
    for which, column in (("at the end", "error_mm"), ("on the way", "way_error_mm")):
        listed = ", ".join(f"{error:g}" for error in PASSED)
        print(f"# {scene.name}: ms per simulated second at errors {which} of {listed} mm")
        for method in methods:
            curve = table.curve("time_ms_per_s", column, scene=scene.name, name=method.name)
            print(f"#   {method.name}:", ", ".join(time_at(error, *curve) for error in PASSED))


def draw(table: Table, scenes: Sequence[Scene], figure: Any) -> None:
    for axes, scene in zip(figure.subplots(1, len(scenes), sharey=True), scenes):
        names = dict.fromkeys(row["name"] for row in table.rows if row["scene"] == scene.name)
        curves = {name: table.curve("time_ms_per_s", "error_mm", scene=scene.name, name=name) for name in names}
        draw_curves(axes, curves, f"{scene.name}: ms per simulated second", "error [mm]")


def main() -> int:
    parser = make_parser(__doc__, rounds=3, plot=True)
    parser.add_argument("--nodes", type=int, default=21, help="along a side (default: %(default)s)")
    options = parser.parse_args()
    steps, sweeps = STEPS, (10, 30, 100)
    if options.quick:
        options.nodes, options.rounds, steps, sweeps = 7, 1, STEPS[:3], (5, 10, 20)
    torch.set_num_threads(1)
    print_header("mujoco", "newton", "warp-lang", clock=options.clock)
    why_not = why_no_newton()
    if why_not is not None:
        print("# without VBD:", why_not)
        sweeps = ()
    table = Table(COLUMNS)
    scenes = make_scenes(options.nodes)
    for scene in scenes:
        measure(scene, make_methods(scene, steps, sweeps), steps, options, table)
    save_plot(options.out / "cloth_accuracy.png", partial(draw, table, scenes), (11.0, 6.0))
    return 0


if __name__ == "__main__":
    sys.exit(main())
