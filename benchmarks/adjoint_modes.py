"""How far the paper's gradients are from those of the step that was run: adjoint="qr" and "dense" beside "exact".

Four scenes, 40 steps of 0.01 s through contact, a loss with random weights on the final state. Prints one CSV line per
scene: how long the difference to the exact gradient is, relative to the exact gradient, with respect to the initial
state (SI units) and to mass and inertia (relative changes); median over losses. Beside it the exact gradient's own
error against central differences (median and maximum over random directions whose two sides have the same contacts),
and what a backward of each mode takes.
"""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Callable
from functools import partial

import torch
from _common import in_turns, make_parser, print_header, print_row
from torch import Tensor

import diffsim as ds
from diffsim import scenes

DT, STEPS = 0.01, 40
MODES = ("exact", "qr", "dense")
COLUMNS = ("scene", "steps_with_contact", "qr_state", "dense_state", "qr_mass_inertia", "dense_mass_inertia")
COLUMNS += ("exact_error_median", "exact_error_max", "directions", *(f"{mode}_backward_ms" for mode in MODES))


def box_over_edge() -> ds.Scene:
    """A box slides across the edge of a fixed table, at an angle to it, and tips over."""
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((2.0, 2.0, 0.4)), kind="static", position=(-1.0, 0.0, -0.2), name="table")
    scene.add_body(
        ds.shapes.box((0.5, 0.4, 0.3)),
        density=1000.0,
        position=(-0.10, 0.05, 0.152),
        orientation=(math.cos(0.15), 0.0, 0.0, math.sin(0.15)),
        velocity=(1.0, 0.2, 0.0),
        name="box",
    )
    return scene


SCENES: dict[str, Callable[[], ds.Scene]] = {
    "tilted box on plane": scenes.tilted_box,
    "box on box": scenes.box_on_box,
    "box sliding over an edge": box_over_edge,
    "tetrahedron into a groove": scenes.tetrahedron_in_groove,
}


class Case:
    """One scene in one mode, its rollout recorded once."""

    def __init__(self, build: Callable[[], ds.Scene], mode: str) -> None:
        self.sim = ds.Simulator(build(), dt=DT, adjoint=mode, on_failure="raise")
        start = self.sim.initial_state()
        fields = (start.position, start.orientation, start.velocity, start.angular_velocity)
        self.state = [t.requires_grad_() for t in fields]
        self.parameters = [self.sim.mass.requires_grad_(), self.sim.inertia.requires_grad_()]
        self.final = self.sim.rollout(ds.State(*self.state), None, STEPS)[-1]

    def gradient(self, seed: int) -> tuple[Tensor, Tensor]:
        """With respect to the state, and to relative changes of mass and inertia."""
        generator = torch.Generator().manual_seed(seed)
        outputs = (self.final.position, self.final.orientation, self.final.velocity, self.final.angular_velocity)
        weights = [torch.randn(*t.shape, generator=generator, dtype=t.dtype) for t in outputs]
        grads = torch.autograd.grad(outputs, [*self.state, *self.parameters], weights, retain_graph=True)
        scaled = [g * p.detach() for g, p in zip(grads[4:], self.parameters)]
        return torch.cat([g.flatten() for g in grads[:4]]), torch.cat([g.flatten() for g in scaled])


def contact_steps(build: Callable[[], ds.Scene]) -> int:
    sim = ds.Simulator(build(), dt=DT)
    state, count = sim.initial_state(), 0
    for _ in range(STEPS):
        state = sim(state)
        count += sim.info is not None and sim.info.contacts > 0
    return count


def gap(gradient: Tensor, exact: Tensor) -> float:
    return float((gradient - exact).norm() / exact.norm())


def main() -> int:
    parser = make_parser(__doc__, rounds=21)
    parser.add_argument("--losses", type=int, default=16, help="random losses per scene (default: %(default)s)")
    options = parser.parse_args()
    if options.quick:
        options.losses, options.rounds = 1, 1
    torch.set_num_threads(1)
    print_header(clock=options.clock)
    print_row(COLUMNS)
    for name, build in SCENES.items():
        cases = {mode: Case(build, mode) for mode in MODES}
        gaps: dict[tuple[str, int], list[float]] = {(mode, k): [] for mode in MODES for k in (0, 1)}
        for seed in range(options.losses):
            exact = cases["exact"].gradient(seed)
            for mode in MODES:
                gradient = cases[mode].gradient(seed)
                for k in (0, 1):
                    gaps[mode, k].append(gap(gradient[k], exact[k]))
        columns = [statistics.median(gaps[mode, k]) for k in (0, 1) for mode in ("qr", "dense")]
        sim = cases["exact"].sim
        wrt = ("position", "orientation", "velocity", "angular_velocity", "mass", "inertia")
        report = ds.diagnostics.gradcheck(sim, sim.initial_state(), steps=STEPS, wrt=wrt, directions=8)
        seconds = in_turns({mode: partial(cases[mode].gradient, 0) for mode in MODES}, options.rounds, options.clock)
        stable = f"{len(report.stable)} of {len(report.directions)}"
        times = [1e3 * statistics.median(seconds[mode]) for mode in MODES]
        print_row([name, contact_steps(build), *columns, report.median_error, report.max_error, stable, *times])
    return 0


if __name__ == "__main__":
    sys.exit(main())
