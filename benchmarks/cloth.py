"""Cloth: square sheets of 21 x 21, 51 x 51, 101 x 101 nodes fall on a fixed sphere; dt 0.01 s, one thread.

Beside MuJoCo's flex and Newton's VBD on the CPU, in the same run, in turns: same mesh, masses and step, a sheet of
rubber-like material (Young's modulus 5 MPa, 1 mm, Poisson's ratio 0.3). Each simulator's steps before and after its own
first contact are counted apart, since their costs differ; "step" is the mean over both. Self-contact is on in ours and
in MuJoCo; in VBD it is off, since there it lets nodes move no further per step than about half the distance at which
it looks for contacts: with one of two thicknesses the sheet falls at 0.09 m/s. In all, its faces meet the sphere, too.

Ours is timed through `Simulator.rollout`, one for each of the two phases, with gradients to the state and the material;
the peers have no backward here. Newton iterations are ours; VBD takes the ten of its default, converged or not. What
errors these times buy: `cloth_accuracy.py`.

Prints one CSV line per mesh, medians over rounds, and the log-log slopes of time against nodes; draws out/cloth.png.
Targets: forward faster than both peers (ratios below 1), backward at most 1.0 of forward, slopes at most 1.25.

Contact is frictionless in all. MuJoCo's contacts are soft, and so are VBD's: how far the middle of the sheet's
thickness goes into the sphere at most stands in the columns `depth`. "mujoco_ipc" is MuJoCo with the flag that keeps
surfaces apart, as ours does. Needs the extra `bench`; without `newton` its columns are empty.
"""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import mujoco
import torch
from _cloth_scenes import RADIUS, THICK, Sheet, VbdSheet, make_flex, make_simulator, raise_if_unstable, why_no_newton
from _common import Clock, Table, draw_curves, make_parser, print_header, print_slopes, save_plot

import diffsim as ds

NODES = (21, 51, 101)  # along a side
DT = 0.01
GAP = 0.05  # between the sheet and the sphere at the start [m]
ASIDE = (0.013, 0.007)  # of the sheet's middle: one that falls dead centre stays on the saddles of its buckling [m]

PHASES = ("flight", "contact", "step")
PEERS = ("mujoco", "mujoco_ipc", "vbd")
MATERIAL = ("cloth_density", "cloth_stretch", "cloth_shear", "cloth_bend", "cloth_damping")


@dataclass
class Times:
    """Milliseconds per step before and after the first contact, and over all steps; how deep the sheet went [m]."""

    flight: float
    contact: float
    step: float
    depth: float = 0.0


def mean_times(milliseconds: list[float], touched: list[bool], depth: float) -> Times:
    first = touched.index(True) if True in touched else len(touched)
    parts = (milliseconds[:first], milliseconds[first:], milliseconds)
    return Times(*(statistics.fmean(part) if part else math.nan for part in parts), depth)


def make_sheet(nodes: int) -> Sheet:
    return Sheet(nodes, (*ASIDE, RADIUS + GAP + 0.5 * THICK))


# ---- ours ------------------------------------------------------------------------------------------------------------


class Ours:
    """The sheet as a `Simulator`; a first run finds where contact begins and how many iterations steps take."""

    def __init__(self, nodes: int, steps: int) -> None:
        self.steps = steps
        sheet = make_sheet(nodes)
        self.sim = make_simulator(sheet, DT)
        for name in MATERIAL:
            getattr(self.sim, name).requires_grad_()
        states = [self.sim.initial_state()]
        self.iterations: list[int] = []
        self.failed = 0
        touched = []
        depth = 0.0
        with torch.no_grad():
            for _ in range(steps):
                states.append(self.sim(states[-1]))
                info = self.sim.info
                assert info is not None
                self.iterations.append(info.iterations)
                self.failed += info.failed_steps
                touched.append(info.contacts > 0)
                depth = max(depth, -sheet.gap(states[-1].node_position.numpy()))
        self.first = touched.index(True)
        self.starts = {"flight": states[0], "contact": states[self.first]}
        self.counts = {"flight": self.first, "contact": steps - self.first}
        self.depth = depth

    def measure(self, clock: Clock) -> dict[str, Times]:
        """Of a rollout per phase: forward without gradients recorded, forward that records them, and backward."""
        parameters = [getattr(self.sim, name) for name in MATERIAL]
        seconds: dict[str, dict[str, float]] = {"forward": {}, "recorded": {}, "backward": {}}
        for phase, start in self.starts.items():
            steps = self.counts[phase]
            with torch.no_grad():
                begin = clock()
                self.sim.rollout(start, None, steps)
                seconds["forward"][phase] = clock() - begin
            inputs = [start.node_position.clone().requires_grad_(), start.node_velocity.clone().requires_grad_()]
            fields = (start.position, start.orientation, start.velocity, start.angular_velocity)
            begin = clock()
            final = self.sim.rollout(ds.State(*fields, *inputs), None, steps)[-1]
            seconds["recorded"][phase] = clock() - begin
            loss = final.node_position.square().sum() + final.node_velocity.square().sum()
            begin = clock()
            torch.autograd.grad(loss, [*inputs, *parameters])
            seconds["backward"][phase] = clock() - begin
        result = {}
        for name, of_phase in seconds.items():
            per_step = [1e3 * of_phase[phase] / self.counts[phase] for phase in self.starts]
            result[name] = Times(*per_step, 1e3 * sum(of_phase.values()) / self.steps, self.depth)
        return result


# ---- MuJoCo ----------------------------------------------------------------------------------------------------------


class Flex:
    """The sheet as a MuJoCo flex."""

    def __init__(self, nodes: int, steps: int, ipc: bool = False) -> None:
        self.name = "mujoco_ipc" if ipc else "mujoco"
        self.steps = steps
        self.sheet = make_sheet(nodes)
        self.model = make_flex(self.sheet, DT, ipc=ipc)

    def measure(self, clock: Clock) -> dict[str, Times]:
        data = mujoco.MjData(self.model)
        milliseconds, touched, depth = [], [], 0.0
        for _ in range(self.steps):
            begin = clock()
            mujoco.mj_step(self.model, data)
            milliseconds.append(1e3 * (clock() - begin))
            gap = self.sheet.gap(data.flexvert_xpos)
            touched.append(gap < THICK)
            depth = max(depth, -gap)
        raise_if_unstable(data)
        return {self.name: mean_times(milliseconds, touched, depth)}


# ---- Newton ----------------------------------------------------------------------------------------------------------


class Vbd:
    """The sheet in Newton's VBD solver."""

    def __init__(self, nodes: int, steps: int) -> None:
        self.steps = steps
        self.sheet = make_sheet(nodes)
        self.vbd = VbdSheet(self.sheet, DT)

    def measure(self, clock: Clock) -> dict[str, Times]:
        self.vbd.reset()
        milliseconds, touched, depth = [], [], 0.0
        for _ in range(self.steps):
            begin = clock()
            self.vbd.step()
            milliseconds.append(1e3 * (clock() - begin))
            gap = self.sheet.gap(self.vbd.positions)
            touched.append(gap < THICK)
            depth = max(depth, -gap)
        return {"vbd": mean_times(milliseconds, touched, depth)}


# ---- the table -------------------------------------------------------------------------------------------------------

OWN = tuple(f"{name}_{phase}_ms" for name in ("forward", "backward") for phase in PHASES)
OTHERS = tuple(f"{name}_{phase}_ms" for name in PEERS for phase in PHASES)
RATIOS = (*(f"forward_to_{name}" for name in PEERS), "recorded_to_forward", "backward_to_forward")
FACTS = ("iterations_flight", "iterations_contact", "iterations_most", "failed_steps")
COLUMNS = ("side_nodes", "nodes", "steps", "flight_steps", *OWN, *OTHERS, *RATIOS, *FACTS)
COLUMNS += ("depth_m", *(f"{name}_depth_m" for name in PEERS))


@dataclass
class Mesh:
    """All simulators of one mesh, and what they measured, round after round."""

    nodes: int
    ours: Ours
    others: list[Flex | Vbd]
    rounds: dict[str, list[Times]] = field(default_factory=dict)

    def measure(self, clock: Clock) -> None:
        for simulator in (self.ours, *self.others):
            for name, times in simulator.measure(clock).items():
                self.rounds.setdefault(name, []).append(times)

    def median(self, read: Callable[[dict[str, Times]], float]) -> float:
        names = tuple(self.rounds)
        return statistics.median(read(dict(zip(names, of_round))) for of_round in zip(*self.rounds.values()))

    def time(self, name: str, phase: str) -> float | None:
        return self.median(lambda times: getattr(times[name], phase)) if name in self.rounds else None

    def ratio(self, name: str, other: str) -> float | None:
        return self.median(lambda times: times[name].step / times[other].step) if other in self.rounds else None

    def row(self) -> dict[str, Any]:
        first, iterations = self.ours.first, self.ours.iterations
        row: dict[str, Any] = {
            "side_nodes": self.nodes,
            "nodes": self.nodes**2,
            "steps": self.ours.steps,
            "flight_steps": first,
        }
        for name in ("forward", "backward", *PEERS):
            row.update({f"{name}_{phase}_ms": self.time(name, phase) for phase in PHASES})
        row.update({f"forward_to_{name}": self.ratio("forward", name) for name in PEERS})
        row.update({f"{name}_to_forward": self.ratio(name, "forward") for name in ("recorded", "backward")})
        row["iterations_flight"] = statistics.fmean(iterations[:first])
        row["iterations_contact"] = statistics.fmean(iterations[first:])
        row["iterations_most"], row["failed_steps"] = max(iterations), self.ours.failed
        row["depth_m"] = self.ours.depth
        row.update({f"{name}_depth_m": self.time(name, "depth") for name in PEERS})
        return row


def draw(rows: list[dict[str, Any]], figure: Any) -> None:
    nodes = [row["nodes"] for row in rows]
    for axes, phase in zip(figure.subplots(1, len(PHASES), sharey=True), PHASES):
        names = {"diffsim, forward": "forward", "diffsim, backward": "backward", "VBD": "vbd"}
        names |= {"MuJoCo": "mujoco", "MuJoCo, ipc": "mujoco_ipc"}
        curves = {label: (nodes, [row[f"{name}_{phase}_ms"] for row in rows]) for label, name in names.items()}
        draw_curves(axes, curves, "nodes", "ms per step")
        axes.set_title("all steps" if phase == "step" else phase)


def main() -> int:
    parser = make_parser(__doc__, rounds=3, plot=True)
    parser.add_argument("--nodes", type=int, nargs="+", default=NODES, help="along a side")
    parser.add_argument("--steps", type=int, default=20, help="of which the first nine or ten are flight")
    parser.add_argument("--no-peers", action="store_true", help="time diffsim alone")
    options = parser.parse_args()
    if options.quick:
        options.nodes, options.rounds, options.steps = [11], 1, 14
    torch.set_num_threads(1)
    print_header("mujoco", "newton", "warp-lang", clock=options.clock)
    makers: list[Any] = []
    if not options.no_peers:
        makers += [Flex, partial(Flex, ipc=True)]
        why_not = why_no_newton()
        if why_not is None:
            makers.append(Vbd)
        else:
            print("# without VBD:", why_not)
    table = Table(COLUMNS)
    for nodes in options.nodes:
        mesh = Mesh(nodes, Ours(nodes, options.steps), [make(nodes, options.steps) for make in makers])
        for _ in range(options.rounds):
            mesh.measure(options.clock)
        table.add(mesh.row())
    measured = [name for name in (*OWN, *OTHERS) if table.rows[0][name] is not None]
    print_slopes({name: table.curve("nodes", name) for name in measured})
    save_plot(options.out / "cloth.png", partial(draw, table.rows), (12.0, 4.0))
    return 0


if __name__ == "__main__":
    sys.exit(main())
