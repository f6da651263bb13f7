"""Masses from motion: one from the momentum of a collision; mass, inertia, friction and more from a noisy recording.

**The collision**, Fig. 9 of Qiao et al. 2020. Two cubes of edge 0.2 m meet head-on at ±v without gravity and stay
together. The first has mass m1, the other 1 kg; the total momentum after 0.4 s shall be (3, 0, 0) kg·m/s. Gradient
descent on the squared difference begins at m1 = 1 kg, and every gradient comes through the collision. Momentum is
conserved, so that m1 v - v = 3: m1 = 1 + 3/v, and the momentum's derivative with respect to m1 is v whatever the
collision does to either cube. At v = 1 m/s that is 4 kg. The published 5.4 kg is the answer of a simulator that damps
every velocity; this one conserves. Nothing here is random: the curve is one descent, and has no seeds.

**The recording.** A box of unknown mass and inertia is pushed and twisted by known forces and torques, and falls on a
sheet pinned at its corners, of unknown stretch stiffness, on which it slides with unknown friction. Four corners of the
box and five nodes of the sheet are seen seven times in 0.28 s, with noise of 0.2 mm. Gauss-Newton steps with the
layer's Jacobian find the six logarithms (mass, three moments of inertia, stiffness, Coulomb's coefficient) that fit
best; friction shows as long as something slips, and here it does. The first steps look at the first frames only: far
from the truth the box lands otherwise, and what comes after misleads. The Jacobian J of the fit gives a covariance
s² (JᵀJ)⁻¹, with s² the mean squared residual, and so intervals of 95 %. Whether they are that: the fit is made again
for 200 draws of the noise, in one batch, and the truth must lie in the interval as often as it claims, and the spread
of the fits must be the claimed one.

Writes out/estimate_mass.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from _stage import make_parser, needed, report, save_figure, save_results
from torch import Tensor, nn
from torch.func import functional_call, jacrev, vmap
from tqdm import tqdm

import diffsim as ds
from diffsim.viewer import Camera, Item, draw_items

stats = needed("scipy.stats")

F64 = torch.float64


# ---- the collision ---------------------------------------------------------------------------------------------------

EDGE, APART, COLLISION_DT, COLLISION_STEPS = 0.2, 0.2, 0.02, 20  # of both cubes, centres from x = 0 [m], [s]
MOMENTUM = 3.0  # wanted, along x [kg·m/s]
DESCENT_STEPS = 90
RATE = 0.2  # of the squared difference, times v⁻²

MASS_ERROR = 1e-6  # of the mass found, relative to conservation
SENSITIVITY_ERROR = 1e-9  # of d(momentum)/d(m1), relative to v


@dataclass
class Descent:
    speed: float  # v [m/s]
    masses: list[float] = field(default_factory=list)  # of the first cube, one more than gradients [kg]
    sensitivities: list[float] = field(default_factory=list)  # d(momentum)/d(m1) [m/s]
    together: float = 0.0  # relative velocity of the cubes after the last collision [m/s]
    failed_steps: int = 0

    @property
    def conserved(self) -> float:
        """The mass conservation of momentum asks for [kg]."""
        return 1.0 + MOMENTUM / self.speed


def build_collision(speed: float) -> ds.Scene:
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    for name, side in (("first", -1.0), ("second", 1.0)):
        start, velocity = (side * APART, 0.0, 0.0), (-side * speed, 0.0, 0.0)
        scene.add_body(ds.shapes.box(EDGE), mass=1.0, position=start, velocity=velocity, name=name)
    return scene


def descend(speed: float, steps: int = DESCENT_STEPS) -> Descent:
    sim, descent = ds.Simulator(build_collision(speed), dt=COLLISION_DT), Descent(speed, [1.0])
    start = sim.initial_state()
    for _ in tqdm(range(steps), desc="collisions", unit="step"):
        mass = torch.tensor(descent.masses[-1], dtype=F64, requires_grad=True)
        # The mass reaches the momentum through the collision and as a factor; the inertia grows with it.
        factors = torch.stack([mass, mass.new_tensor(1.0)])
        parameters = {"mass": factors, "inertia": sim.inertia.detach() * factors[:, None, None]}
        end = functional_call(Rollout(sim, COLLISION_STEPS), _named(parameters), (start, None))[-1]
        momentum = (factors[:, None] * end.velocity).sum(dim=0)[0]
        (sensitivity,) = torch.autograd.grad(momentum, mass)
        assert sim.info is not None
        descent.failed_steps += sim.info.failed_steps
        descent.sensitivities.append(sensitivity.item())
        # Of ½ (momentum - MOMENTUM)².
        gradient = (momentum.item() - MOMENTUM) * sensitivity.item()
        descent.masses.append(mass.item() - RATE / speed**2 * gradient)
        descent.together = float((end.velocity[0] - end.velocity[1]).detach().norm())
    return descent


class Rollout(nn.Module):
    """A whole motion as a module, for `functional_call` to exchange the simulator's parameters in."""

    def __init__(self, sim: ds.Simulator, steps: int) -> None:
        super().__init__()
        self.sim, self.steps = sim, steps

    def forward(self, state: ds.State, control: ds.Control | None) -> ds.State:
        return self.sim.rollout(state, control, self.steps)


def _named(parameters: dict[str, Tensor]) -> dict[str, Tensor]:
    return {f"sim.{name}": value for name, value in parameters.items()}


# ---- the recording ---------------------------------------------------------------------------------------------------

DT, STEPS, EVERY = 0.01, 28, 4  # a frame every EVERY steps [s]
NODES, SIDE = 5, 0.6  # of the sheet along a side [m]
MASS, GRAVITY, PUSH = 0.3, 9.81, 1.5  # of the box; downwards; along x, until it lands [kg], [m/s²], [N]
FREE, FLIGHT_ERROR = 4, 1e-9  # steps before it touches anything; of its way in them [m]
FRICTION = 0.3  # of box and sheet; only their coefficient together can be told
SHEET = ds.ClothMaterial(density=0.3, stretch=300.0, shear=100.0, bend=1e-4, damping=0.01)
CORNERS, SEEN_NODES = (0, 3, 5, 6), (6, 8, 12, 16, 18)  # of the box and of the sheet, whose places are recorded
NOISE = 2e-4  # standard deviation of each coordinate [m]
NAMES = ("mass", "inertia x", "inertia y", "inertia z", "stretch", "friction")
FIRST_GUESS = (-0.25, 0.3, 0.3, -0.3, 0.35, 0.4)  # error of the logarithms at first
FRAMES = (2, 3, 4, 5, 7, 7)  # that Gauss-Newton steps look at
REFITS = 3  # steps with the Jacobian of the fit, for other noise
DRAWS, QUICK_DRAWS = 200, 40
LEVEL, RARE = 0.95, 1e-3  # of the intervals; probability with which a right program may fail one check


class Recording(nn.Module):
    """From logarithms of parameters, relative to the truth, to what is seen, flat [m]."""

    def __init__(self) -> None:
        super().__init__()
        scene = ds.Scene()
        last = NODES * NODES - 1
        pinned = [0, NODES - 1, last - NODES + 1, last]
        sheet = ds.shapes.sheet(SIDE, NODES)
        self.sheet = scene.add_cloth(sheet, SHEET, pinned=pinned, friction=FRICTION, name="sheet")
        self.box = scene.add_body(
            ds.shapes.box((0.10, 0.14, 0.08)),
            mass=MASS,
            position=(0.02, -0.01, 0.11),
            orientation=ds.rotation.from_rpy([0.3, 0.2, 0.1]),
            angular_velocity=(3.0, -2.0, 4.0),
            friction=FRICTION,
            name="box",
        )
        sim = ds.Simulator(scene, dt=DT)
        self.rollout, self.start, self.control = Rollout(sim, STEPS), sim.initial_state(), self.pushes()
        unknown = ("mass", "inertia", "cloth_stretch", "friction")
        self.truth = {name: getattr(sim, name).detach().clone() for name in unknown}
        box_vertices = 8  # which come before the nodes
        self.seen = torch.tensor([*CORNERS, *(box_vertices + node for node in SEEN_NODES)])

    @staticmethod
    def pushes() -> ds.Control:
        """Known: without forces that do not grow with the mass, only ratios could be found."""
        force, torque = torch.zeros(2, STEPS, 1, 3, dtype=F64)
        force[:12, 0, 0], force[12:24, 0, 0] = PUSH, -PUSH
        torque[:6, 0] = torch.tensor([2e-2, -1e-2, -2e-2], dtype=F64)
        torque[6:12, 0] = -torque[0, 0]
        return ds.Control(force=force, torque=torque)

    def trajectory(self, logarithms: Tensor) -> ds.State:
        factor = logarithms.exp()
        parameters = {
            "mass": self.truth["mass"] * factor[:1],
            # The box's axes are the principal ones.
            "inertia": self.truth["inertia"] * torch.diag_embed(factor[1:4]),
            "cloth_stretch": self.truth["cloth_stretch"] * factor[4:5],
            "friction": self.truth["friction"] * factor[5:],
        }
        return functional_call(self.rollout, _named(parameters), (self.start, self.control))

    def forward(self, logarithms: Tensor, count: int = STEPS // EVERY) -> Tensor:
        """Of the first frames."""
        frames = self.trajectory(logarithms)[EVERY - 1 : count * EVERY : EVERY]
        return self.rollout.sim.vertices(frames)[:, self.seen].flatten()


@dataclass
class Fit:
    logarithms: Tensor  # (6,)
    jacobian: Tensor  # (seen, 6) [m]
    deviation: float  # s, the root of the mean squared residual [m]
    history: list[float]  # root of the mean squared residual, per iteration [m]

    @property
    def covariance(self) -> Tensor:
        """Of the logarithms."""
        return self.deviation**2 * torch.linalg.inv(self.jacobian.T @ self.jacobian)


def deviation(residuals: Tensor) -> Tensor:
    """Of one or more fits, s, shape (..., seen) to (...)."""
    return (residuals.square().sum(-1) / (residuals.shape[-1] - len(NAMES))).sqrt()


def fit(recording: Recording, seen: Tensor) -> Fit:
    logarithms, history = torch.tensor(FIRST_GUESS, dtype=F64), []
    for count in tqdm(FRAMES, desc="Gauss-Newton", unit="step"):
        look = partial(_twice, recording, count)
        jacobian, model = jacrev(look, has_aux=True)(logarithms)
        residual = (model - seen[: len(model)]).detach()
        history.append(float(deviation(residual)))
        # Friction has no effect on the first frames: its column is zero, for which torch's default driver reads memory
        # that nobody wrote, and finds another solution each time (pytorch/pytorch#187411).
        change = torch.linalg.lstsq(jacobian, residual[:, None], driver="gelsd").solution[:, 0]
        logarithms = logarithms - change
    with torch.no_grad():
        history.append(float(deviation(recording(logarithms) - seen)))
    return Fit(logarithms, jacobian.detach(), history[-1], history)


def _twice(recording: Recording, count: int, logarithms: Tensor) -> tuple[Tensor, Tensor]:
    """For `jacrev`, to have the value beside the Jacobian."""
    seen = recording(logarithms, count)
    return seen, seen


@dataclass
class Coverage:
    draws: int
    inside: Tensor  # times the truth was in the interval, per parameter, (6,)
    spread: Tensor  # standard deviation of the fits over the claimed one, (6,)


def cover(recording: Recording, main: Fit, draws: int, seed: int) -> Coverage:
    """Fit again for other noise. The Jacobian stays; the gradient, by the layer, says where each fit ends."""
    truth = torch.zeros(len(NAMES), dtype=F64)
    with torch.no_grad():
        clean = recording(truth)
    noise = NOISE * torch.randn(draws, len(clean), generator=torch.Generator().manual_seed(seed), dtype=F64)
    seen, inverse = clean + noise, torch.linalg.inv(main.jacobian.T @ main.jacobian)
    logarithms = truth.expand(draws, -1).clone()
    for _ in tqdm(range(REFITS), desc=f"{draws} fits", unit="step"):
        logarithms.requires_grad_()
        residuals = vmap(recording)(logarithms) - seen
        (gradient,) = torch.autograd.grad(0.5 * residuals.square().sum(), logarithms)
        logarithms = logarithms.detach() - gradient @ inverse
    claimed = deviation(residuals.detach())[:, None] * inverse.diagonal().sqrt()
    half_width = claimed * stats.t.ppf(0.5 + 0.5 * LEVEL, len(clean) - len(NAMES))
    inside = (logarithms.abs() <= half_width).sum(dim=0)
    return Coverage(draws, inside, logarithms.square().mean(dim=0).sqrt() / claimed.square().mean(dim=0).sqrt())


# ---- checks ----------------------------------------------------------------------------------------------------------


def flight_error(recording: Recording) -> float:
    """How far the box is off its course before it touches anything, at most [m].

    Implicit Euler has it at start + a t (t + dt) / 2. A recording by a wrong simulator is fitted well by the same one.
    """
    with torch.no_grad():
        found = recording.trajectory(torch.zeros(len(NAMES), dtype=F64))[:FREE].position[:, recording.box]
    time = DT * torch.arange(1, FREE + 1, dtype=F64)[:, None]
    course = 0.5 * time * (time + DT) * torch.tensor([PUSH / MASS, 0.0, -GRAVITY], dtype=F64)
    return float((found - recording.start.position[recording.box] - course).norm(dim=-1).max())


def check(descent: Descent, recording: Recording, main: Fit, coverage: Coverage) -> bool:
    """Print what must hold and whether it does."""
    found, expected = descent.masses[-1], descent.conserved
    steps = len(descent.sensitivities)
    error = abs(found / expected - 1.0)
    text = f"collision: m1 = {found:.6f} kg after {steps} gradient steps, {expected:.6f} by conservation"
    results = [(text, error <= MASS_ERROR and steps <= DESCENT_STEPS)]
    error = max(abs(s / descent.speed - 1.0) for s in descent.sensitivities)
    text = f"collision: the derivative of the momentum is v in every step, to {error:.1e}"
    results.append((text, error <= SENSITIVITY_ERROR))
    text = f"collision: the cubes stay together, to {descent.together:.1e} m/s; {descent.failed_steps} steps failed"
    results.append((text, descent.together < 1e-3 * descent.speed and descent.failed_steps == 0))

    off = flight_error(recording)
    text = f"recording: the box flies as force and gravity have it for {FREE * DT:g} s, to {off:.1e} m"
    results.append((text, off <= FLIGHT_ERROR))
    degrees = len(main.jacobian) - len(NAMES)
    low, high = (math.sqrt(stats.chi2.ppf(p, degrees) / degrees) for p in (0.5 * RARE, 1.0 - 0.5 * RARE))
    ratio = main.deviation / NOISE
    text = f"recording: what is left of the residuals is {ratio:.3f} of the noise ({low:.3f} to {high:.3f})"
    results.append((text, low <= ratio <= high))
    distance = float(main.logarithms @ torch.linalg.solve(main.covariance, main.logarithms)) / len(NAMES)
    most = float(stats.f.ppf(1.0 - RARE, len(NAMES), degrees))
    text = f"recording: the truth is at {distance:.2f} of the fit's covariance (at most {most:.2f})"
    results.append((text, distance <= most))

    draws = coverage.draws
    share = RARE / len(NAMES)  # all parameters are asked
    low, high = (int(stats.binom.ppf(p, draws, LEVEL)) for p in (0.5 * share, 1.0 - 0.5 * share))
    listed = ", ".join(f"{name} {int(n)}" for name, n in zip(NAMES, coverage.inside))
    text = f"intervals of {100 * LEVEL:.0f} % hold the truth in {low} to {high} of {draws} draws: {listed}"
    results.append((text, bool(((coverage.inside >= low) & (coverage.inside <= high)).all())))
    low, high = (math.sqrt(stats.chi2.ppf(p, draws) / draws) for p in (0.5 * share, 1.0 - 0.5 * share))
    listed = ", ".join(f"{s:.3f}" for s in coverage.spread.tolist())
    text = f"the fits spread as claimed, {low:.2f} to {high:.2f} times: {listed}"
    results.append((text, bool(((coverage.spread >= low) & (coverage.spread <= high)).all())))
    return report(results)


# ---- picture ---------------------------------------------------------------------------------------------------------


def draw(descent: Descent, recording: Recording, main: Fit, coverage: Coverage, path: Path) -> None:
    def fill(figure: Any) -> None:
        left, middle, right = figure.subplots(1, 3, width_ratios=(1.0, 1.2, 1.0))
        left.plot(descent.masses, color="#b03a2e", lw=1.8)
        left.axhline(descent.conserved, color="0.6", lw=1.0, ls="--")
        left.text(len(descent.masses) - 1, descent.conserved * 0.97, "conservation", ha="right", va="top", color="0.5")
        left.set(xlabel="gradient steps", ylabel="m1 [kg]", title="the collision")
        with torch.no_grad():
            frames = recording.trajectory(main.logarithms)
        sim = recording.rollout.sim
        items = [Item(sim.mesh(frames[24], recording.sheet), (0.50, 0.66, 0.80), 0.85, two_sided=True, edges=True)]
        for index, shade in ((0, 0.95), (11, 0.75), (24, 0.6)):
            items.append(Item(sim.mesh(frames[index], recording.box), (shade, 0.55 * shade, 0.25 * shade)))
        draw_items(middle, items, Camera(-62.0, 14.0), shadows=False)
        middle.set_title("what is recorded, at 0.01, 0.12 and 0.25 s")
        half = stats.t.ppf(0.5 + 0.5 * LEVEL, len(main.jacobian)) * main.covariance.diagonal().sqrt()
        right.axvline(0.0, color="0.6", lw=1.0, ls="--")
        right.errorbar(100.0 * main.logarithms, range(len(NAMES)), xerr=100.0 * half, fmt="o", color="0.2", capsize=4)
        right.set_yticks(range(len(NAMES)), [f"{n}\n{int(k)}/{coverage.draws}" for n, k in zip(NAMES, coverage.inside)])
        right.set(xlabel="error of the fit [%], intervals of 95 %", title="the fit, and how often intervals hold")
        right.invert_yaxis()

    save_figure(path, fill, figsize=(13.0, 4.2))


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    quick = f"{QUICK_DRAWS} draws of noise instead of {DRAWS}"
    parser = make_parser(__doc__, quick, "of the noise")
    parser.add_argument("--speed", type=float, default=1.0, help="v of the cubes [m/s] (default: %(default)s)")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    descent = descend(options.speed)
    recording = Recording()
    with torch.no_grad():
        clean = recording(torch.zeros(len(NAMES), dtype=F64))
    generator = torch.Generator().manual_seed(1000 + options.seed)
    fitted = fit(recording, clean + NOISE * torch.randn(len(clean), generator=generator, dtype=F64))
    for name, value, error in zip(NAMES, fitted.logarithms, fitted.covariance.diagonal().sqrt()):
        print(f"{name:9s}: {100 * float(value):+.2f} % off, standard deviation {100 * float(error):.2f} %")
    coverage = cover(recording, fitted, QUICK_DRAWS if options.quick else DRAWS, options.seed)
    if not options.no_picture:
        draw(descent, recording, fitted, coverage, options.out / "estimate_mass.png")
        results = {
            "m1 [kg]": descent.masses,
            "residual [m]": fitted.history,
            "error of the logarithms": dict(zip(NAMES, fitted.logarithms.tolist())),
            "inside": dict(zip(NAMES, coverage.inside.tolist())),
            "draws": coverage.draws,
        }
        save_results(options.out / "estimate_mass.json", results)
    passed = check(descent, recording, fitted, coverage)
    print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
