"""Cloth: square sheets of 21 x 21, 51 x 51, 101 x 101 nodes fall on a fixed sphere; dt 0.01 s, one thread.

Beside MuJoCo's flex and Newton's VBD on the CPU, in the same run, in turns: same mesh width, same step, a sheet of
rubber-like material (Young's modulus 5 MPa, 1 mm, Poisson's ratio 0.3). Each simulator's steps before and after its own
first contact are counted apart, since their costs differ; "step" is the mean over both. Self-contact is on in ours and
in MuJoCo; in VBD it is off, since there it lets nodes move no further per step than about half the distance at which
it looks for contacts: with one of two thicknesses the sheet falls at 0.09 m/s.

Ours is timed through `Simulator.rollout`, one for each of the two phases, with gradients to the state and the material;
the peers have no backward here. Newton iterations are ours; VBD takes the ten of its default, converged or not.

Prints one CSV line per mesh, medians over rounds, and the log-log slopes of time against nodes; draws out/cloth.png.
Targets: forward faster than both peers (ratios below 1), backward at most 1.0 of forward, slopes at most 1.25.

Contact is frictionless in all. MuJoCo's contacts are soft, and so are VBD's: how far nodes go into the sphere at most
stands in the columns `depth`. Needs the extra `bench`; without `newton` its columns are empty.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import math
import statistics
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from _common import Clock, Table, draw_curves, make_parser, print_header, print_slopes, save_plot

import diffsim as ds

NODES = (21, 51, 101)  # along a side
DT = 0.01
SIDE, RADIUS, GAP = 1.0, 0.25, 0.05  # of the sheet, of the sphere, and between them at the start [m]
YOUNG, THICK, DENSITY, POISSON = 5.0e6, 1.0e-3, 374.0, 0.3  # [Pa], [m], [kg/m³]
DAMPING = 5.0e-4  # [s]
HEIGHT = RADIUS + GAP + 0.5 * THICK  # of the sheet over the sphere's centre [m]
ASIDE = (0.013, 0.007)  # of it: a sheet that falls dead centre stays on the saddles of its buckling [m]

PHASES = ("flight", "contact", "step")
PEERS = ("mujoco", "vbd")
MATERIAL = ("cloth_density", "cloth_stretch", "cloth_shear", "cloth_bend", "cloth_damping")


@dataclass
class Times:
    """Milliseconds per step before and after the first contact, and over all steps; how deep nodes went [m]."""

    flight: float
    contact: float
    step: float
    depth: float = 0.0


def mean_times(milliseconds: list[float], touched: list[bool], depth: float) -> Times:
    first = touched.index(True) if True in touched else len(touched)
    parts = (milliseconds[:first], milliseconds[first:], milliseconds)
    return Times(*(statistics.fmean(part) if part else math.nan for part in parts), depth)


def depth_in_sphere(positions: np.ndarray) -> float:
    return float(max(RADIUS - np.linalg.norm(positions, axis=-1).min(), 0.0))


# ---- ours ------------------------------------------------------------------------------------------------------------


class Ours:
    """The sheet as a `Simulator`; a first run finds where contact begins and how many iterations steps take."""

    def __init__(self, nodes: int, steps: int) -> None:
        self.steps = steps
        scene = ds.Scene(gravity=(0.0, 0.0, -9.81))
        scene.add_sphere(RADIUS, density=1000.0, kind="static")
        material = ds.ClothMaterial.isotropic(YOUNG, THICK, DENSITY, POISSON, DAMPING)
        sheet = ds.shapes.sheet(SIDE, nodes)
        scene.add_cloth(sheet, material, position=(*ASIDE, HEIGHT), margin=0.5 * THICK)
        self.sim = ds.Simulator(scene, dt=DT, num_threads=1)
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
                depth = max(depth, depth_in_sphere(states[-1].node_position.numpy()))
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

    def __init__(self, nodes: int, steps: int) -> None:
        self.steps = steps
        spacing = SIDE / (nodes - 1)
        # "discrete" integrates the stiffness of flexes implicitly.
        sheet = f'young="{YOUNG}" poisson="{POISSON}" thickness="{THICK}" elastic2d="both" damping="{DAMPING}"'
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><size memory="2G"/><option timestep="{DT}" gravity="0 0 -9.81" integrator="discrete"/><worldbody>'
            f'<geom type="sphere" size="{RADIUS}" condim="1"/>'
            f'<flexcomp name="sheet" type="grid" dim="2" count="{nodes} {nodes} 1" spacing="{spacing} {spacing} 1"'
            f' pos="{ASIDE[0]} {ASIDE[1]} {HEIGHT}" radius="{0.5 * THICK}" mass="{DENSITY * THICK * SIDE**2}">'
            f'<elasticity {sheet}/><contact selfcollide="auto" condim="1"/></flexcomp></worldbody></mujoco>'
        )

    def measure(self, clock: Clock) -> dict[str, Times]:
        data = mujoco.MjData(self.model)
        milliseconds, touched, depth = [], [], 0.0
        for _ in range(self.steps):
            begin = clock()
            mujoco.mj_step(self.model, data)
            milliseconds.append(1e3 * (clock() - begin))
            touched.append(bool(data.ncon > 0))
            depth = max(depth, depth_in_sphere(data.flexvert_xpos))
        if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:  # MuJoCo starts again from the beginning there
            raise RuntimeError("MuJoCo became unstable")
        return {"mujoco": mean_times(milliseconds, touched, depth)}


# ---- Newton ----------------------------------------------------------------------------------------------------------


class Vbd:
    """The sheet in Newton's VBD solver, its step captured as a graph. Single precision."""

    def __init__(self, nodes: int, steps: int) -> None:
        self.steps = steps
        import newton
        import warp

        self.warp = warp
        cell = SIDE / (nodes - 1)
        lame, shear = YOUNG * THICK * POISSON / (1.0 - POISSON**2), YOUNG * THICK / (2.0 * (1.0 + POISSON))
        bend = YOUNG * THICK**3 / (12.0 * (1.0 - POISSON**2))
        builder = newton.ModelBuilder(gravity=(0.0, 0.0, -9.81))
        builder.add_cloth_grid(
            pos=warp.vec3(ASIDE[0] - 0.5 * SIDE, ASIDE[1] - 0.5 * SIDE, HEIGHT),
            rot=warp.quat_identity(),
            vel=warp.vec3(0.0, 0.0, 0.0),
            dim_x=nodes - 1,
            dim_y=nodes - 1,
            cell_x=cell,
            cell_y=cell,
            mass=DENSITY * THICK * SIDE**2 / nodes**2,
            tri_ke=shear,
            tri_ka=lame,
            tri_kd=DAMPING * shear,
            edge_ke=1.2 * bend / cell,  # its hinges alone bend a grid of squares with 5/6 of their stiffness
            edge_kd=0.0,
            particle_radius=0.5 * THICK,
        )
        builder.add_shape_sphere(-1, radius=RADIUS)
        builder.color(include_bending=True)
        self.model = builder.finalize()
        self.model.soft_contact_ke, self.model.soft_contact_kd, self.model.soft_contact_mu = 1.0e4, 1.0e-4, 0.0
        self.solver = newton.solvers.SolverVBD(self.model)
        self.pipeline = newton.CollisionPipeline(self.model)
        self.contacts = self.pipeline.contacts()
        self.start, self.state, self.next = self.model.state(), self.model.state(), self.model.state()
        self.control = self.model.control()
        self.step()  # compiles its kernels
        with warp.ScopedCapture() as capture:
            self.step()
        self.graph = capture.graph

    def step(self) -> None:
        self.state.clear_forces()
        self.pipeline.collide(self.state, self.contacts)
        self.solver.step(self.state, self.next, self.control, self.contacts, DT)
        self.state.assign(self.next)

    def measure(self, clock: Clock) -> dict[str, Times]:
        self.state.assign(self.start)
        milliseconds, touched, depth = [], [], 0.0
        for _ in range(self.steps):
            begin = clock()
            self.warp.capture_launch(self.graph)
            milliseconds.append(1e3 * (clock() - begin))
            positions = self.state.particle_q.numpy()
            touched.append(bool(np.linalg.norm(positions, axis=1).min() < RADIUS + THICK))
            depth = max(depth, depth_in_sphere(positions))
        return {"vbd": mean_times(milliseconds, touched, depth)}


def why_no_newton() -> str | None:
    """None if Newton runs here."""
    if importlib.util.find_spec("newton") is None:
        return "newton is not installed (pip install newton)"
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            import warp

            warp.config.quiet = True
            warp.init()
            warp.set_device("cpu")
            Vbd(3, 1)
    except Exception as error:  # whatever keeps it from running must not keep us from it
        return f"newton does not run here: {type(error).__name__}: {error}"
    return None


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
        names = {"diffsim, forward": "forward", "diffsim, backward": "backward", "MuJoCo": "mujoco", "VBD": "vbd"}
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
        makers.append(Flex)
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
