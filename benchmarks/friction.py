"""Coulomb friction of a box on a slope, beside MuJoCo's: creep, acceleration and its gradient, against time.

A box of 1 x 1 x 0.4 m on a plane, in steps of several lengths. `creep`: its speed [m/s] on 20° with a coefficient of
0.5, where it should rest, over the second after the first half. `acceleration_error`: on 30° with 0.2, relative, over
0.4 s after the first 0.1 s. `gradient_error`: of the derivative of the way on which friction of 0.5 stops a box of
2 m/s, by the coefficient, relative to the closed form -v² / (2 μ² g): ours by its backward, MuJoCo's by central
differences of two whole runs, as it has no derivative by friction. A step's own error, of first order in its length, is
part of all of them. `forward_ms` is the time of the slide's 0.5 s, `gradient_ms` that of the derivative over 0.6 s.

MuJoCo runs with its default contacts and pyramidal cones, elliptic ones, and elliptic ones with impratio 100, by which
it fights creep; its steps are looped over from Python. One thread; medians over rounds, one CSV line per run, and a
plot of the errors against the time.
Needs the extra `bench`.
"""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

import mujoco
import numpy as np
import torch
from _common import Clock, Table, draw_curves, in_turns, make_parser, print_header, save_plot
from torch import Tensor

import diffsim as ds

COLUMNS = ("name", "dt_s", "creep", "acceleration_error", "gradient_error", "forward_ms", "gradient_ms")
EXTENTS = (1.0, 1.0, 0.4)  # of the box [m]
DENSITY, G = 1000.0, 9.81
STEEP, SLIPPERY = 30.0, 0.2  # where it slides [°], [1]
FLAT, ROUGH = 20.0, 0.5  # where it rests
SPEED, STOPS = 2.0, 0.6  # of the box that is stopped [m/s], and when it surely has [s]
SLIDES = 0.5  # [s]
OURS = (0.02, 0.01, 0.005, 0.002)  # [s]
THEIRS = (0.01, 0.005, 0.002, 0.001)
MUJOCO = {
    "MuJoCo pyramidal": 'cone="pyramidal"',
    "MuJoCo elliptic": 'cone="elliptic"',
    "MuJoCo elliptic impratio 100": 'cone="elliptic" impratio="100"',
}
EPS = 1e-3  # of MuJoCo's differences, of the coefficient


class Ours:
    """The box as a simulator's."""

    def __init__(self, dt: float) -> None:
        scene = ds.Scene()
        scene.add_ground(friction=ROUGH)
        height = 0.5 * EXTENTS[2] * (1.0 + 2e-3)  # a thickness of 1e-3 above the ground
        scene.add_body(ds.shapes.box(EXTENTS), density=DENSITY, position=(0.0, 0.0, height), friction=ROUGH)
        self.dt = dt
        self.sim = ds.Simulator(scene, dt, num_threads=1, on_failure="raise")
        self.start = self.sim.initial_state()

    def path(self, degrees: float, mu: float | Tensor, seconds: float, speed: float = 0.0) -> Tensor:
        """Along the slope, after each step, from 0 on."""
        friction = torch.as_tensor(mu, dtype=torch.float64).expand(2)
        parameters = {"gravity": torch.tensor(gravity(degrees), dtype=torch.float64), "friction": friction}
        start = self.start.replace(velocity=torch.tensor([[speed, 0.0, 0.0]], dtype=torch.float64))
        ends = self.sim.rollout(start, steps=round(seconds / self.dt), parameters=parameters)
        return torch.cat([torch.zeros(1).double(), ends.position[:, 0, 0] - self.start.position[0, 0]])

    def slide(self, degrees: float, mu: float, seconds: float) -> Any:
        with torch.no_grad():
            return self.path(degrees, mu, seconds).numpy()

    def derivative(self) -> float:
        """Of the way to rest by the coefficient."""
        mu = torch.tensor(ROUGH, dtype=torch.float64, requires_grad=True)
        way = self.path(0.0, mu, STOPS, SPEED)[-1]
        return float(torch.autograd.grad(way, mu)[0])


class MuJoCo:
    """The same box as MuJoCo's, with options for its solver."""

    def __init__(self, options: str, dt: float) -> None:
        half = " ".join(str(0.5 * extent) for extent in EXTENTS)
        self.model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><option timestep="{dt}" {options}/><worldbody><geom type="plane" size="0 0 1"/>
            <body pos="0 0 {0.5 * EXTENTS[2]}"><freejoint/><geom type="box" size="{half}" density="{DENSITY}"/></body>
            </worldbody></mujoco>"""
        )
        self.dt = dt

    def slide(self, degrees: float, mu: float, seconds: float, speed: float = 0.0) -> Any:
        model = self.model
        model.opt.gravity[:] = gravity(degrees)
        model.geom_friction[:, 0] = mu
        data = mujoco.MjData(model)
        data.qvel[0] = speed
        places = [0.0]
        for _ in range(round(seconds / self.dt)):
            mujoco.mj_step(model, data)
            places.append(float(data.qpos[0]))
        return np.array(places)

    def derivative(self) -> float:
        ends = [self.slide(0.0, mu, STOPS, SPEED)[-1] for mu in (ROUGH + EPS, ROUGH - EPS)]
        return float((ends[0] - ends[1]) / (2.0 * EPS))


def gravity(degrees: float) -> list[float]:
    """In the axes of the slope, which falls along x."""
    return [G * math.sin(math.radians(degrees)), 0.0, -G * math.cos(math.radians(degrees))]


def measure(name: str, box: Ours | MuJoCo, rounds: int, clock: Clock) -> dict[str, Any]:
    dt = box.dt
    resting = box.slide(FLAT, ROUGH, 1.5)
    creep = abs(resting[-1] - resting[round(0.5 / dt)]) / 1.0
    speed = np.diff(box.slide(STEEP, SLIPPERY, SLIDES)) / dt
    first = round(0.1 / dt)
    found = (speed[-1] - speed[first]) / (dt * (len(speed) - 1 - first))
    angle = math.radians(STEEP)
    expected = G * (math.sin(angle) - SLIPPERY * math.cos(angle))
    derivative = -(SPEED**2) / (2.0 * ROUGH**2 * G)
    cases: dict[str, Callable[[], object]] = {
        "forward_ms": partial(box.slide, STEEP, SLIPPERY, SLIDES),
        "gradient_ms": box.derivative,
    }
    return {
        "name": name,
        "dt_s": dt,
        "creep": float(creep),
        "acceleration_error": abs(found / expected - 1.0),
        "gradient_error": abs(box.derivative() / derivative - 1.0),
        **{case: 1e3 * statistics.median(seconds) for case, seconds in in_turns(cases, rounds, clock).items()},
    }


def draw(table: Table, figure: Any) -> None:
    panels = {"creep": "creep [m/s]", "acceleration_error": "error of acceleration", "gradient_error": "of gradient"}
    for axes, (column, label) in zip(figure.subplots(1, 3), panels.items()):
        time = "gradient_ms" if column == "gradient_error" else "forward_ms"
        curves = {}
        for name in dict.fromkeys(row["name"] for row in table.rows):
            x, y = table.curve(time, column, name=name)
            curves[name] = (x, [max(value, 1e-16) for value in y])  # 0 is drawn at the bottom
        draw_curves(axes, curves, "time [ms]", label)


def main() -> int:
    parser = make_parser(__doc__, rounds=5, plot=True)
    options = parser.parse_args()
    ours, theirs = OURS, THEIRS
    if options.quick:
        options.rounds, ours, theirs = 1, OURS[1:2], THEIRS[:1]
    torch.set_num_threads(1)
    print_header("mujoco", clock=options.clock)
    table = Table(COLUMNS)
    for dt in ours:
        table.add(measure("ours", Ours(dt), options.rounds, options.clock))
    for name, settings in MUJOCO.items():
        for dt in theirs:
            table.add(measure(name, MuJoCo(settings, dt), options.rounds, options.clock))
    save_plot(options.out / "friction.png", partial(draw, table), size=(13.0, 4.8))
    return 0


if __name__ == "__main__":
    sys.exit(main())
