"""Learn to lift a box with a cloth, through the physics, with DDPG beside it.

As Fig. 8b of Qiao et al. 2020. A box of 0.08 x 0.12 x 0.11 m lies on the middle of a cloth of 1 x 1 m whose corners are
driven up and down, each for itself, at up to 2 m/s; gravity is 2 m/s². Within one second the box shall be at a target
above its start. A controller, a network with 50 and 200 units, sees the way to the target, the box's velocity and the
time left, and moves the corners. It is trained by the gradient of the distance at the end, through 25 steps of cloth in
contact, one update per episode. DDPG plays the same task by rewards.

Targets are 0.3 to 0.55 m up. The original's are 0.5 to 0.55 m, so close together that a controller which never looks at
them leaves less than 5 %. There is no friction, as in the paper: the box stays on the cloth because the cloth sags.

Writes out/learn_cloth.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
Without stable-baselines3 (`pip install "mesh-diffsim[rl]"`) DDPG is left out, and the program says so.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from _learning import Learning, Program, draw_moments, findings, held_out_starts, make_task, play
from _stage import Judge, report
from torch import Tensor

import diffsim as ds
from diffsim.viewer import Camera

DT, STEPS = 0.04, 25  # [s]
BOX, MASS, GRAVITY = (0.08, 0.12, 0.11), 0.3, 2.0  # [m], [kg], [m/s²]
SIDE, NODES = 1.0, 7  # of the cloth [m], and along a side
CLOTH = ds.ClothMaterial(density=0.374, stretch=200.0, shear=60.0, bend=1e-4, damping=0.02)
SPEED = 2.0  # of a corner at most [m/s]
LOW, HIGH = 0.3, 0.55  # of the targets above the start [m]

PROGRAM = Program("learn_cloth", __doc__, episodes=100, quick_episodes=100, rate=2e-3)
REACH = 0.05  # of the distance that may be left
GRADIENT_ERROR = 1e-4  # of an episode's gradient, relative
APART = 1.15  # of the pictures of one motion [m]


# ---- task ------------------------------------------------------------------------------------------------------------

LAST = NODES * NODES - 1
CORNERS = [0, NODES - 1, LAST - NODES + 1, LAST]


def build_scene() -> ds.Scene:
    scene = ds.Scene(gravity=(0.0, 0.0, -GRAVITY))
    scene.add_cloth(ds.shapes.sheet(SIDE, NODES), CLOTH, pinned=CORNERS, name="cloth")
    scene.add_body(ds.shapes.box(BOX), mass=MASS, position=(0.0, 0.0, 0.5 * BOX[2] + 0.002), name="box")
    return scene


def build_task() -> tuple[Any, Any]:
    """The task, and what part of the distance is left."""
    sim = ds.Simulator(build_scene(), dt=DT)
    rest = sim.initial_state()

    def sample(rng: np.random.Generator) -> tuple[ds.State, Tensor]:
        return rest, rest.position[0] + torch.tensor([0.0, 0.0, rng.uniform(LOW, HIGH)], dtype=torch.float64)

    def control(action: Tensor, moment: Any) -> ds.Control:
        up = torch.nn.functional.pad((SPEED * action)[..., None], (2, 0))
        velocity = up.new_zeros(len(up), NODES * NODES, 3).index_copy(1, torch.tensor(CORNERS), up)
        return ds.Control(node_velocity=velocity)

    def observation(moment: Any) -> Tensor:
        way = moment.goal - moment.state.position[:, 0]
        return torch.cat([4.0 * way, moment.state.velocity[:, 0], moment.time_left[:, None]], dim=-1)

    return make_task(sim, STEPS, 4, sample=sample, control=control, observation=observation)


# ---- checks and picture ----------------------------------------------------------------------------------------------


def check(task: Any, left: Any, ours: Learning, ddpg: Learning | None) -> bool:
    """Print what must hold and whether it does."""
    results = findings(task, left, ours, ddpg, REACH, GRADIENT_ERROR, MASS, GRAVITY)
    with torch.no_grad():
        moments, _ = play(task, ours.controllers[0], held_out_starts(task))
        starts = moments[0]
        middle = starts.state.position[:1, 0] + torch.tensor([0.0, 0.0, 0.5 * (LOW + HIGH)], dtype=torch.float64)
        blind = (starts.goal - middle).norm(dim=-1) / (starts.goal - starts.state.position[:, 0]).norm(dim=-1)
    text = f"a controller that never looks at the target would leave {100.0 * blind.mean():.1f} %"
    results.append((text, float(blind.mean()) > 2.0 * REACH))
    judge = Judge(build_scene(), task.simulator)
    found = judge.count([moment.state[0] for moment in moments[1:]])
    results.append(("the box passes through nothing (ipctk)" + "".join(f"; {f}" for f in found[:3]), not found))
    return report(results)


def draw_scene(axes: Any, task: Any, ours: Learning) -> None:
    cloth = {"color": (0.50, 0.66, 0.80), "two_sided": True, "edges": True}
    looks = {1: cloth, 0: {"color": (0.93, 0.55, 0.25)}}
    draw_moments(axes, task, ours, Camera(-78.0, 16.0), APART, looks)


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    return PROGRAM.main(argv, build_task, check, draw_scene)


if __name__ == "__main__":
    sys.exit(main())
