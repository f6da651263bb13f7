"""Learn to carry a block with two sticks, through the physics, with DDPG beside it.

As Fig. 8a of Qiao et al. 2020. A block of 2.8 x 2.8 x 2.0 m lies on two sticks at x = ±1.2 m; gravity is 1 m/s². Within
one second it shall be at a target 1 m to the left or right and 2 m up (each ± 0.05 m). A controller, a network with 50
and 200 units, sees the way to the target, the block's velocity and its tilt, and the time left, and moves the sticks:
sideways together, up and down each for itself, at up to 5 m/s. It is trained by the gradient of the distance at the
end, through 25 steps of contact, one update per episode. DDPG plays the same task by rewards.

There is no friction, as in the paper. What holds the block are the sticks' shapes: angles with a lip on the outer side,
5 cm from the block. The lips push it sideways, and a stick that rises faster than the other tips it.

Writes out/learn_sticks.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
Without stable-baselines3 (`pip install "mesh-diffsim[rl]"`) DDPG is left out, and the program says so.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from _learning import Learning, Program, draw_moments, findings, held_out_starts, make_task, play
from _stage import report
from torch import Tensor

import diffsim as ds
from diffsim.viewer import Camera

DT, STEPS = 0.04, 25  # [s]
BLOCK = (2.8, 2.8, 2.0)  # [m]
STICK_X, PLAY = 1.2, 0.05  # of the middle of a stick's floor; between lips and block [m]
DENSITY, GRAVITY = 10.0, 1.0  # of the block [kg/m³], [m/s²]
SPEED = 5.0  # of a stick at most [m/s]
SIDE, UP, SPREAD = 1.0, 2.0, 0.05  # of the targets [m]

PROGRAM = Program("learn_sticks", __doc__, episodes=100, quick_episodes=60, rate=2e-3)
REACH = 0.05  # of the distance that may be left
GRADIENT_ERROR = 1e-4  # of an episode's gradient, relative


# ---- task ------------------------------------------------------------------------------------------------------------


def build_scene() -> ds.Scene:
    scene = ds.Scene(gravity=(0.0, 0.0, -GRAVITY))
    scene.add_body(ds.shapes.box(BLOCK), density=DENSITY, position=(0.0, 0.0, 0.5 * BLOCK[2]), name="block")
    inner, edge = STICK_X - 0.3, 0.5 * BLOCK[0] + PLAY
    outline = [(inner, -0.3), (edge + 0.2, -0.3), (edge + 0.2, 0.6), (edge, 0.6), (edge, 0.0), (inner, 0.0)]
    vertices, faces = ds.shapes.prism(outline, 3.4)
    upright = vertices[:, [0, 2, 1]] * np.array([1.0, -1.0, 1.0])  # the outline's y becomes z
    for name, side in (("left", -1.0), ("right", 1.0)):
        turned = upright * np.array([side, side, 1.0])  # about z
        scene.add_body((turned, faces), kind="kinematic", name=name)
    return scene


def build_task() -> tuple[Any, Any]:
    """The task, and what part of the distance is left."""
    sim = ds.Simulator(build_scene(), dt=DT)
    rest = sim.initial_state()

    def sample(rng: np.random.Generator) -> tuple[ds.State, Tensor]:
        side = SIDE * rng.choice([-1.0, 1.0])
        way = np.array([side + rng.uniform(-SPREAD, SPREAD), 0.0, UP + rng.uniform(-SPREAD, SPREAD)])
        return rest, rest.position[0] + torch.from_numpy(way)

    def control(action: Tensor, moment: Any) -> ds.Control:
        across, left, right = (SPEED * action).unbind(-1)
        nothing = torch.zeros_like(across)
        rows = (nothing,) * 3, (across, nothing, left), (across, nothing, right)
        velocity = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=1)
        return ds.Control(body_velocity=velocity, body_angular_velocity=torch.zeros_like(velocity))

    def observation(moment: Any) -> Tensor:
        state = moment.state
        way = (moment.goal - state.position[:, 0])[:, [0, 2]]
        tilt = torch.stack([state.orientation[:, 0, 2], state.angular_velocity[:, 0, 1]], dim=-1)
        return torch.cat([way, state.velocity[:, 0, [0, 2]], tilt, moment.time_left[:, None]], dim=-1)

    return make_task(sim, STEPS, 3, sample=sample, control=control, observation=observation)


APART = 5.5  # of the pictures of one motion [m]

# ---- checks and picture ----------------------------------------------------------------------------------------------


def check(task: Any, left: Any, ours: Learning, ddpg: Learning | None) -> bool:
    """Print what must hold and whether it does."""
    results = findings(task, left, ours, ddpg, REACH, GRADIENT_ERROR, DENSITY * math.prod(BLOCK), GRAVITY)
    with torch.no_grad():
        moments, _ = play(task, ours.controllers[0], held_out_starts(task)[:1])
    lowest = min(task.simulator.min_distance(moment.state).item() for moment in moments)
    results.append((f"block and sticks never come nearer than {lowest:.1e} m beyond their margins", lowest > -1e-3))
    return report(results)


def draw_scene(axes: Any, task: Any, ours: Learning) -> None:
    block, sticks = (0.93, 0.55, 0.25), (0.50, 0.66, 0.80)
    looks = {0: {"color": block}, 1: {"color": sticks}, 2: {"color": sticks}}
    draw_moments(axes, task, ours, Camera(-84.0, 9.0), APART, looks, split=0.3)


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    return PROGRAM.main(argv, build_task, check, draw_scene)


if __name__ == "__main__":
    sys.exit(main())
