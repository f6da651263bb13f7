"""A ball on a trampoline: down, into the sheet, and back up; MuJoCo's flex and a coarse MuJoCo grid beside it.

As Fig. 6 of Qiao et al. 2020. A sheet of rubber, a square metre of 374 g, is pinned all around; a ball of 8 cm radius
falls on it. The same scene goes to MuJoCo twice: as a flex of the same mesh width and material, and as a net of 9 x 9
small spheres with springs between neighbours, what cloth was in MuJoCo when the paper was written. The ball lies on
the flex as it lies on our sheet; it goes through the net, which has holes.

Material: Young's modulus 5 MPa, 1 mm thick, Poisson's ratio 0.3, unstrained at the start, so that the sheet stiffens as
it is pushed in. Contact is inelastic: what brings the ball up is the sheet. The ball spins. Without friction, as beside
MuJoCo, it keeps its spin; with a coefficient of 0.5, rubber's, it grips the sheet, loses most of its spin, and is
driven sideways.

Implicit Euler takes energy out of the bounce, in proportion to the step: on 11 x 11 nodes the ball comes back to 14,
36, 52 and 62 % of its height at steps of 10, 5, 2.5 and 1.25 ms. MuJoCo's comes to 66 % at 1 ms and 75 % at 0.2 ms.

Nothing here is random: each curve of the picture is one fall.

Writes out/trampoline.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
Without mujoco (`pip install "mesh-diffsim[mujoco]"`) that part is left out, and the program says so.
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
from _stage import FloatArray, Judge, make_parser, present, report, save_figure, save_results, shift
from tqdm import tqdm

import diffsim as ds
from diffsim.viewer import Camera, Item, draw_items

NODES = 21  # of the sheet along a side
SIDE, HEIGHT = 1.0, 1.0  # of the sheet [m]
YOUNG, THICK, DENSITY, POISSON = 5.0e6, 1.0e-3, 374.0, 0.3  # of rubber-like sheet [Pa], [m], [kg/m³]
DAMPING = 5.0e-4  # [s]
RADIUS, MASS, DROP = 0.08, 1.0, 0.42  # of the ball, and from its lower side to the sheet [m], [kg]
ASIDE = 0.06  # of the middle, along x and y: over a hole of the coarse net [m]
FRICTION, SPIN = 0.5, 20.0  # of ball and sheet, the second time; of the ball about y, both times [rad/s]
DURATION = 1.0  # [s]
DT = 0.005  # [s]
GRAVITY = 9.81

NET_NODES, NET_RADIUS = 9, 0.01  # of the coarse net, and of its spheres [m]
FLEX_DT = 1.0e-3  # for MuJoCo's flex [s]
CONTACT = 2.0e-3  # time constant of its contacts, which are springs: by default the ball goes through the flex [s]

COMES_UP = 0.25  # of the height it fell from, at least
# How far the flex may be off: part of the depth per second of our time step, which implicit Euler makes an error in
# proportion to; and the time of the lowest point [s].
FLEX_DEPTH, FLEX_TIME = 25.0, 0.02

# What a step's energy may rise by, against what the ball brings: contacts store a little that is not counted.
ENERGY_RISE = 1e-4


# ---- the scene, and its run ------------------------------------------------------------------------------------------


@dataclass
class Run:
    """What became of a ball."""

    sim: ds.Simulator
    scene: ds.Scene
    states: list[ds.State]  # the first is the start
    times: FloatArray
    heights: FloatArray  # of the ball's centre [m]
    energies: FloatArray  # [J]
    failed: list[int]  # steps that did not converge
    seconds: float


def build_scene(nodes: int, speed: float, aside: float = ASIDE, friction: float = 0.0, spin: float = 0.0) -> ds.Scene:
    """The ball over the sheet, both with one friction; it falls, and spins about the y axis [rad/s]."""
    scene = ds.Scene(gravity=(0.0, 0.0, -GRAVITY))
    vertices, faces = ds.shapes.sheet(SIDE, nodes)
    rim = np.abs(vertices[:, :2]).max(axis=1) > 0.5 * SIDE * (1.0 - 1e-9)
    material = ds.ClothMaterial.isotropic(YOUNG, THICK, DENSITY, POISSON, DAMPING)
    scene.add_cloth(
        (vertices, faces),
        material,
        pinned=rim,
        position=(0, 0, HEIGHT),
        margin=0.5 * THICK,
        friction=friction,
        name="sheet",
    )
    start = (aside, aside, HEIGHT + 0.5 * THICK + RADIUS + DROP)
    scene.add_sphere(
        RADIUS,
        mass=MASS,
        position=start,
        velocity=(0.0, 0.0, -speed),
        angular_velocity=(0.0, spin, 0.0),
        friction=friction,
        name="ball",
    )
    return scene


def fall(
    nodes: int,
    dt: float = DT,
    speed: float = 0.0,
    aside: float = ASIDE,
    duration: float = DURATION,
    friction: float = 0.0,
    spin: float = 0.0,
    quiet: bool = False,
) -> Run:
    scene = build_scene(nodes, speed, aside, friction, spin)
    sim = ds.Simulator(scene, dt=dt)
    states, failed = [sim.initial_state()], []
    begin = time.perf_counter()
    for step in tqdm(range(1, round(duration / dt) + 1), desc="trampoline", unit="step", disable=quiet):
        states.append(sim(states[-1]))
        assert sim.info is not None
        if not sim.info.converged:
            failed.append(step)
    seconds = time.perf_counter() - begin
    heights = np.array([float(state.position[0, 2]) for state in states])
    energies = np.array([float(sim.kinetic_energy(state) + sim.potential_energy(state)) for state in states])
    times = np.arange(len(states), dtype=np.float64) * dt
    return Run(sim, scene, states, times, heights, energies, failed, seconds)


# ---- MuJoCo ----------------------------------------------------------------------------------------------------------

FRICTIONLESS = f'condim="1" solref="{CONTACT} 1"'


@dataclass
class Peer:
    """The path of the ball in another simulator."""

    name: str
    times: FloatArray
    heights: FloatArray
    step_milliseconds: float


def world_xml(dt: float, aside: float, sheet: str, extra: str = "") -> str:
    # "discrete" integrates the stiffness of flexes and tendons implicitly.
    return (
        f'<mujoco><option timestep="{dt}" gravity="0 0 {-GRAVITY}" integrator="discrete"/>'
        f"<worldbody>{sheet}"
        f'<body name="ball" pos="{aside} {aside} {HEIGHT + 0.5 * THICK + RADIUS + DROP}"><freejoint/>'
        f'<geom type="sphere" size="{RADIUS}" mass="{MASS}" contype="1" conaffinity="2" {FRICTIONLESS}/></body>'
        f"</worldbody>{extra}</mujoco>"
    )


def flex_xml(nodes: int, dt: float, aside: float) -> str:
    spacing = SIDE / (nodes - 1)
    ends = (0, nodes - 1)
    rim = " ".join(str(i * nodes + j) for i in range(nodes) for j in range(nodes) if i in ends or j in ends)
    return world_xml(
        dt,
        aside,
        f'<flexcomp name="sheet" type="grid" dim="2" count="{nodes} {nodes} 1" spacing="{spacing} {spacing} {spacing}"'
        f' pos="0 0 {HEIGHT}" radius="{0.5 * THICK}" mass="{DENSITY * THICK * SIDE**2}">'
        f'<elasticity young="{YOUNG}" poisson="{POISSON}" thickness="{THICK}" elastic2d="both" damping="{DAMPING}"/>'
        f'<contact selfcollide="none" contype="2" conaffinity="1" {FRICTIONLESS}/><pin id="{rim}"/></flexcomp>',
    )


def net_xml(nodes: int, dt: float, aside: float) -> str:
    spacing, stiffness = SIDE / (nodes - 1), YOUNG * THICK  # a spring for a strip as wide as it is long
    bodies, springs = [], []
    slides = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    for i in range(nodes):
        for j in range(nodes):
            pinned = i in (0, nodes - 1) or j in (0, nodes - 1)
            place = f"{i * spacing - 0.5 * SIDE} {j * spacing - 0.5 * SIDE} {HEIGHT}"
            sphere = f'<geom type="sphere" size="{NET_RADIUS}" mass="{DENSITY * THICK * SIDE**2 / nodes**2}"'
            bodies.append(
                f'<body pos="{place}">{"" if pinned else slides}{sphere} contype="2" conaffinity="1" {FRICTIONLESS}/>'
                f'<site name="{i}_{j}"/></body>'
            )
            springs += [
                f'<spatial stiffness="{stiffness}" damping="{DAMPING * stiffness}" springlength="{spacing}">'
                f'<site site="{i}_{j}"/><site site="{k}_{m}"/></spatial>'
                for k, m in ((i + 1, j), (i, j + 1))
                if k < nodes and m < nodes
            ]
    return world_xml(dt, aside, "".join(bodies), f"<tendon>{''.join(springs)}</tendon>")


def fall_in_mujoco(name: str, xml: str, dt: float, speed: float, duration: float) -> Peer:
    import mujoco

    model = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(model)
    ball = data.joint(model.body("ball").jntadr[0])
    ball.qvel[2] = -speed
    heights = [float(ball.qpos[2])]  # xpos is of the step's start
    begin = time.perf_counter()
    for _ in range(round(duration / dt)):
        mujoco.mj_step(model, data)
        heights.append(float(ball.qpos[2]))
    seconds = time.perf_counter() - begin
    if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:  # MuJoCo starts again from the beginning there
        raise RuntimeError(f"{name}: MuJoCo became unstable")
    times = np.arange(len(heights), dtype=np.float64) * dt
    return Peer(name, times, np.array(heights), 1e3 * seconds / (len(heights) - 1))


def peers(nodes: int, dt: float, speed: float, duration: float, aside: float = ASIDE) -> list[Peer]:
    """The flex with a small step of its own, and the net with ours; none without mujoco."""
    if not present("mujoco", "mujoco", "its ball"):
        return []
    flex, net = flex_xml(nodes, FLEX_DT, aside), net_xml(NET_NODES, dt, aside)
    return [
        fall_in_mujoco(f"MuJoCo flex, {nodes} x {nodes}", flex, FLEX_DT, speed, duration),
        fall_in_mujoco(f"MuJoCo net, {NET_NODES} x {NET_NODES} spheres", net, dt, speed, duration),
    ]


# ---- checks ----------------------------------------------------------------------------------------------------------


def clearance(run: Run, state: ds.State, nodes: int) -> float:
    """How high the ball's centre is over the sheet at the same x and y, by the triangle there [m]."""
    centre = state.position[0].numpy()
    x, (_, faces) = state.node_position.numpy(), ds.shapes.sheet(SIDE, nodes)
    a, b, c = (x[faces[:, k]] for k in range(3))

    def area(p: FloatArray, q: FloatArray) -> FloatArray:
        return np.asarray(p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0])

    u, v = area(centre - a, c - a) / area(b - a, c - a), area(b - a, centre - a) / area(b - a, c - a)
    here = np.flatnonzero((u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9))
    if not len(here):  # beside the sheet, as after a rise of many metres
        return math.inf if centre[2] > x[:, 2].max() else -math.inf
    return float(centre[2] - (a + u[:, None] * (b - a) + v[:, None] * (c - a))[here, 2].max())


def check(run: Run, rough: Run, others: Sequence[Peer], nodes: int = NODES, speed: float = 0.0) -> bool:
    """Print what must hold and whether it does."""
    dt, start, z = run.sim.dt, run.heights[0], run.heights
    touching = HEIGHT + 0.5 * THICK + RADIUS
    lowest = int(np.argmin(z))
    results = [(f"{len(run.failed)} of {len(run.states) - 1} steps did not converge", not run.failed)]

    # Before it arrives the ball falls as implicit Euler has it: z = start - v t - g t (t + dt) / 2.
    arrival = (math.sqrt(speed**2 + 2.0 * GRAVITY * DROP) - speed) / GRAVITY
    free = run.times <= max(0.0, arrival - 2.0 * dt)
    exact = start - speed * run.times - 0.5 * GRAVITY * run.times * (run.times + dt)
    error = float(np.abs(z - exact)[free].max())
    results.append((f"falls freely for {arrival:.3f} s, to {error:.1e} m", error < 1e-9))

    depth = touching - z[lowest]
    apex = float(z[lowest:].max())
    part = (apex - touching) / (start - touching + 0.5 * speed**2 / GRAVITY)
    least = COMES_UP if speed == 0.0 else 0.0
    text = f"goes {1e3 * depth:.1f} mm deep and comes up to {100.0 * part:.0f} % of the height its energy is worth"
    results.append((f"{text} (at least {100.0 * least:.0f} %)", depth > 0.01 and part >= least))
    brought = MASS * (GRAVITY * (start - touching) + 0.5 * speed**2)
    rise = float(np.diff(run.energies).max())
    text = f"energy never rises in a step: at most by {rise:.1e} J of {brought:.2f} J"
    results.append((text, rise <= ENERGY_RISE * brought))

    over = min(clearance(run, state, nodes) for state in run.states)
    results.append((f"the ball's centre stays above the sheet, at least {1e3 * over:.1f} mm", over >= RADIUS))
    found = Judge(run.scene, run.sim).count(run.states[1:])
    results.append(("nothing passes through anything (ipctk)" + "".join(f"; {f}" for f in found[:3]), not found))
    rim = run.states[0].node_position[:, :2].abs().amax(dim=1) > 0.5 * SIDE * (1.0 - 1e-9)
    moved = max(float((s.node_position - run.states[0].node_position)[rim].abs().max()) for s in run.states)
    results.append((f"the rim stays where it is pinned, to {moved:.1e} m", moved == 0.0))
    spins = run.states[-1].angular_velocity[0, 1].item()
    results.append((f"without friction it keeps its spin, to {abs(spins - SPIN):.1e} rad/s", abs(spins - SPIN) < 1e-9))
    back = lowest + int(np.argmax(rough.heights[lowest:]))
    turned, rise = rough.states[back].angular_velocity[0, 1].item(), float(np.diff(rough.energies).max())
    driven = (rough.states[back].velocity - run.states[back].velocity)[0, 0].item()
    text = f"with friction it comes up with a spin of {turned:.1f} rad/s, and {driven:.2f} m/s faster along x"
    held = 0.0 < driven < RADIUS * SPIN and abs(turned) < 0.5 * SPIN
    results.append((text, held and not rough.failed and rise <= ENERGY_RISE * brought))
    for peer in others:
        bottom = int(np.argmin(peer.heights))
        if "flex" in peer.name and speed == 0.0:
            off = abs(peer.heights[bottom] - z[lowest]) / depth
            late = abs(peer.times[bottom] - run.times[lowest])
            text = f"{peer.name}: lowest point {100.0 * off:.1f} % of the depth and {1e3 * late:.0f} ms from ours"
            results.append((text, off <= FLEX_DEPTH * dt and late <= FLEX_TIME + dt))
        else:  # said, not asked for
            through = peer.heights[-1] < HEIGHT - SIDE
            print(f"      {peer.name}: the ball {'goes through' if through else 'stays above'}")
    return report(results)


# ---- picture ---------------------------------------------------------------------------------------------------------


def draw(run: Run, rough: Run, others: Sequence[Peer], path: Path) -> None:
    def fill(figure: Any) -> None:
        grid = figure.add_gridspec(2, 2, width_ratios=(1.0, 1.15))
        camera = Camera(-62.0, 7.0)
        lowest = int(np.argmin(run.heights))
        apex = lowest + int(np.argmax(run.heights[lowest:]))
        for row, (index, title) in enumerate(((lowest, "lowest"), (apex, "back up"))):
            axes = figure.add_subplot(grid[row, 0])
            items = [
                Item(run.sim.mesh(run.states[index], 1), (0.50, 0.66, 0.80), alpha=0.93, two_sided=True, edges=True),
                Item(run.sim.mesh(run.states[index], 0), (0.93, 0.55, 0.25)),
            ]
            draw_items(axes, items, camera, shadows=False)
            low = camera.project([[0.0, 0.0, HEIGHT - 0.24], [0.0, 0.0, HEIGHT + 0.42]])
            axes.set(ylim=(float(low[0, 1]), float(low[1, 1])))
            axes.set_title(f"{title}, t = {run.times[index]:.2f} s", fontsize=10, color="0.2")
        axes = figure.add_subplot(grid[:, 1])
        axes.axhline(HEIGHT + RADIUS, color="0.8", lw=1.0)
        axes.text(0.01, HEIGHT + RADIUS + 0.005, "ball touches the flat sheet", fontsize=8, color="0.5")
        for peer, style in zip(others, ((0, (5, 2)), (0, (1, 1.5)))):
            axes.plot(peer.times, peer.heights, ls=style, lw=1.6, color="#7a4fa3", label=peer.name)
        nodes = math.isqrt(run.states[0].node_position.shape[0])
        axes.plot(run.times, run.heights, lw=1.8, color="#d9601a", label=f"diffsim, {nodes} x {nodes}")
        axes.plot(
            rough.times, rough.heights, lw=1.2, ls=":", color="0.1", label=f"with friction {FRICTION:g}, spinning"
        )
        axes.set(xlabel="time [s]", ylabel="height of the ball's centre [m]")
        axes.set(ylim=(HEIGHT - 0.35, float(run.heights.max()) + 0.05), xlim=(0.0, float(run.times[-1])))
        axes.legend(frameon=False, fontsize=9)

    save_figure(path, fill, figsize=(11.0, 5.4))


def summary(run: Run, rough: Run, others: Sequence[Peer]) -> dict[str, Any]:
    """For a file of results: of each fall when the ball is how high."""
    found: dict[str, Any] = {}
    for name, fallen in (("diffsim", run), ("diffsim, with friction", rough)):
        spins = [round(state.angular_velocity[0, 1].item(), 6) for state in fallen.states]
        found[name] = {
            "times [s]": fallen.times.round(6),
            "heights [m]": fallen.heights.round(6),
            "spins [rad/s]": spins,
            "steps that did not converge": fallen.failed,
        }
    for peer in others:
        found[peer.name] = {"times [s]": peer.times.round(6), "heights [m]": peer.heights.round(6)}
    return found


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    parser = make_parser(__doc__, "11 x 11 nodes", "of where the ball falls, to 5 mm")
    parser.add_argument("--nodes", type=int, default=NODES, help="of the sheet along a side (default: %(default)s)")
    parser.add_argument("--dt", type=float, default=DT, help="time step [s] (default: %(default)s)")
    parser.add_argument("--speed", type=float, default=0.0, help="downwards at the start [m/s] (default: %(default)s)")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    nodes = 11 if options.quick else options.nodes
    aside = ASIDE + shift(options.seed, 5e-3)
    run = fall(nodes, options.dt, options.speed, aside, spin=SPIN)
    rough = fall(nodes, options.dt, options.speed, aside, friction=FRICTION, spin=SPIN)
    print(f"diffsim: {1e3 * run.seconds / (len(run.states) - 1):.1f} ms per step of {options.dt:g} s")
    others = peers(nodes, options.dt, options.speed, DURATION, aside)
    for peer in others:
        print(f"{peer.name}: {peer.step_milliseconds:.1f} ms per step of {peer.times[1]:g} s")
    if not options.no_picture:
        draw(run, rough, others, options.out / "trampoline.png")
        save_results(options.out / "trampoline.json", summary(run, rough, others))
    passed = check(run, rough, others, nodes, options.speed)
    print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
