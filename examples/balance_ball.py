"""Keep a ball at a target on a tilting tray: a policy gradient through short stretches of physics, PPO beside it.

A ball lies on a tray of 0.6 x 0.6 m with a rim. There is no friction: it slides to where the tray leans. A policy sees
the way to the target, the ball's velocity and the tray's lean, and says how the tray shall lean, up to 0.2 in sine, 25
times a second; the tray turns towards that. Where it sinks faster than the ball falls, the ball leaves it for a while.
Every step's reward is minus the distance; an episode lasts 48 steps, and has no end of its own.

**Short horizons**, after Xu et al., ICLR 2022. 32 episodes run at a time. Every 16 steps the policy makes one step up
the gradient of the rewards so far plus what a critic, a second network, promises of the state they lead to; that
gradient comes through the physics, its contacts among it. Then the critic learns from the same rewards, and the
episodes go on.
**PPO**, of stable-baselines3 with its own defaults and networks of the same size, plays as many episodes at a time of
the same `Task`, by `ds.interop.gymnasium.VectorEnv`, and sees rewards only.

What is compared is how far the ball is from the target in the last half second of 64 episodes that start elsewhere, by
steps of the environment and by seconds of the processor. PPO gets four times as many steps.

Writes out/balance_ball.png and .json and checks itself: the exit code says whether all that `check` looks at holds.
Without stable-baselines3 (`pip install "mesh-diffsim[rl]"`) PPO is left out, and the program says so.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _stage import FloatArray, draw_band, make_parser, needed, of_seeds, present, report, save_figure, save_results
from torch import Tensor, nn
from tqdm import tqdm

import diffsim as ds
from diffsim.interop.gymnasium import Moment, Task, VectorEnv
from diffsim.viewer import Camera, Item, draw_items

gymnasium = needed("gymnasium", "rl")

SIDE, FLOOR, RIM, WALL = 0.6, 0.02, 0.08, 0.02  # of the tray: inside; thickness, height and thickness of the rim [m]
RADIUS, MASS, GRAVITY = 0.05, 0.1, 9.81  # of the ball [m], [kg], [m/s²]
LEAN, TURN = 0.2, 8.0  # sine of the tray's lean at most; how fast it turns to what is wanted [1/s]
SPREAD = 0.2  # of starts and targets, from the tray's middle [m]
DT, STEPS = 0.04, 48  # [s]

EPISODES, HORIZON = 32, 16  # at a time; steps through which gradients go
DISCOUNT, MIX = 0.99, 0.95  # of later rewards; of longer and shorter estimates of what a state is worth
RATE, CRITIC_RATE, CRITIC_UPDATES = 1e-2, 2e-3, 8
WINDOWS, QUICK_WINDOWS, PPO_STEPS, SEEDS = 60, 40, 4, 5
TESTS, LAST = 64, 12  # episodes nothing was trained on, and their steps that count
EVERY = 6  # windows from test to test

HELD = 0.02  # distance of the ball from the target that training must come to [m]
GRADIENT_ERROR, SLIDE_ERROR = 1e-4, 1e-3  # relative

F64 = torch.float64


# ---- task ------------------------------------------------------------------------------------------------------------


def tray() -> tuple[FloatArray, FloatArray]:
    """A box without lid, the upper side of its floor at z = 0: vertices and faces."""
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    rings = ((0.5 * SIDE + WALL, -FLOOR), (0.5 * SIDE + WALL, RIM), (0.5 * SIDE, RIM), (0.5 * SIDE, 0.0))
    vertices = np.concatenate([np.column_stack([half * square, np.full(4, z)]) for half, z in rings])
    faces = [[0, 2, 1], [0, 3, 2], [12, 13, 14], [12, 14, 15]]
    for ring in (0, 4, 8):
        for a in range(4):
            b = (a + 1) % 4
            faces += [[ring + a, ring + b, ring + b + 4], [ring + a, ring + b + 4, ring + a + 4]]
    return vertices, np.array(faces)


def build_scene() -> ds.Scene:
    scene = ds.Scene(gravity=(0.0, 0.0, -GRAVITY))
    scene.add_sphere(RADIUS, mass=MASS, position=(0.0, 0.0, RADIUS), name="ball")
    scene.add_body(tray(), kind="kinematic", name="tray")
    return scene


def lean(state: ds.State) -> Tensor:
    """X and y of the tray's upright axis, shape (B, 2): where things slide to."""
    return ds.rotation.to_matrix(state.orientation[:, 1])[:, :2, 2]


def on_tray(state: ds.State) -> Tensor:
    """X and y of the ball in the tray's axes, from its middle, shape (B, 2) [m]."""
    turned = ds.rotation.to_matrix(state.orientation[:, 1]).transpose(1, 2)
    return (turned @ (state.position[:, 0] - state.position[:, 1])[..., None])[:, :2, 0]


def build_task() -> Task:
    sim = ds.Simulator(build_scene(), dt=DT)
    rest = sim.initial_state()

    def sample(generator: np.random.Generator) -> tuple[ds.State, Tensor]:
        ball, target = torch.from_numpy(generator.uniform(-SPREAD, SPREAD, (2, 2)))
        position = rest.position.clone()
        position[0, :2] = ball
        return rest.replace(position=position), target

    def control(action: Tensor, moment: Moment) -> ds.Control:
        x, y = (TURN * (LEAN * action - lean(moment.state))).unbind(-1)
        nothing = torch.zeros_like(x)
        turn = torch.stack([-y, x, nothing], dim=-1)
        spin = torch.stack([torch.zeros_like(turn), turn], dim=1)
        return ds.Control(body_velocity=torch.zeros_like(spin), body_angular_velocity=spin)

    def way(moment: Moment) -> Tensor:
        return moment.goal - on_tray(moment.state)

    def observation(moment: Moment) -> Tensor:
        state = moment.state
        return torch.cat([way(moment) / SPREAD, state.velocity[:, 0, :2], lean(state) / LEAN], dim=-1)

    def reward(before: Moment, action: Tensor, after: Moment) -> Tensor:
        return -(way(after).square().sum(-1) + 1e-4).sqrt() / SPREAD  # the distance, smooth where it is none

    return Task(
        simulator=sim,
        sample=sample,
        control=control,
        observation=observation,
        reward=reward,
        action_space=gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
        steps=STEPS,
    )


Act = Callable[[Tensor], Tensor]


def distances(task: Task, act: Act) -> FloatArray:
    """From the target in the last half second of test episodes, the mean of each [m]."""
    seen = []
    with torch.no_grad():
        moment = task.start(*(np.random.default_rng(10_000 + i) for i in range(TESTS)))
        for _ in range(STEPS):
            before, moment = moment, task.step(moment, act(task.observation(moment)))
            seen.append(SPREAD * -task.reward(before, torch.zeros(TESTS, 2), moment))
    return np.asarray(torch.stack(seen[-LAST:]).mean(dim=0).numpy())


# ---- learning --------------------------------------------------------------------------------------------------------


@dataclass
class Curve:
    """Of one seed: how far the ball is from the target in test episodes, after so many steps and seconds."""

    name: str
    seed: int
    steps: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)  # of the processor, tests not among them
    held: list[float] = field(default_factory=list)  # [m]

    def note(self, task: Task, act: Act, steps: int, seconds: float) -> None:
        self.steps.append(steps)
        self.seconds.append(seconds)
        self.held.append(float(distances(task, act).mean()))


def network(inputs: int, outputs: int) -> nn.Sequential:
    layers = nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
    return nn.Sequential(*layers).double()


class Actor(nn.Module):
    """A mean action, and how much a policy that explores strays from it."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.mean = network(inputs, outputs)
        self.log_spread = nn.Parameter(torch.full((outputs,), -1.5, dtype=F64))
        with torch.no_grad():
            self.mean[-1].weight.mul_(0.1)

    def forward(self, observation: Tensor) -> Tensor:
        return torch.tanh(self.mean(observation))

    def explore(self, observation: Tensor, noise: Tensor) -> Tensor:
        return torch.tanh(self.mean(observation) + self.log_spread.exp() * noise)


def detached(moment: Moment) -> Moment:
    return Moment(moment.state.detach(), moment.goal, moment.time_left)


@dataclass
class Window:
    """HORIZON steps of all episodes."""

    end: Moment
    seen: Tensor  # observations before each step, cut from the graph, (HORIZON, B, n)
    rewards: Tensor  # (HORIZON, B)
    worth: Tensor  # of the state after each step, by the critic, (HORIZON, B)

    @property
    def gain(self) -> Tensor:
        """What the policy shall raise: rewards, and what the critic promises of the end."""
        weights = DISCOUNT ** torch.arange(HORIZON, dtype=F64)
        return ((weights[:, None] * self.rewards).sum(0) + DISCOUNT**HORIZON * self.worth[-1]).mean() / HORIZON

    def targets(self) -> Tensor:
        """For the critic: of each state what it was worth, a mixture of all horizons."""
        rewards, worth = self.rewards.detach(), self.worth.detach()
        value, found = worth[-1], []
        for k in reversed(range(HORIZON)):
            value = rewards[k] + DISCOUNT * ((1.0 - MIX) * worth[k] + MIX * value)
            found.append(value)
        return torch.stack(found[::-1])


def play(task: Task, actor: Actor, critic: nn.Module, moment: Moment, noise: Tensor) -> Window:
    seen, rewards, worth = [], [], []
    for k in range(HORIZON):
        observation = task.observation(moment)
        action = actor.explore(observation, noise[k])
        before, moment = moment, task.step(moment, action)
        seen.append(observation.detach())
        rewards.append(task.reward(before, action, moment))
        worth.append(critic(task.observation(moment))[:, 0])
    return Window(moment, torch.stack(seen), torch.stack(rewards), torch.stack(worth))


def by_short_horizons(task: Task, seed: int, windows: int) -> tuple[Curve, Actor, nn.Module, int]:
    """The curve, the policy, the critic, and how many windows had a step that did not converge."""
    torch.manual_seed(seed)
    generators = [np.random.default_rng([seed, i]) for i in range(EPISODES)]
    moment = task.start(*generators)
    inputs = task.observation(moment).shape[1]
    actor, critic = Actor(inputs, 2), network(inputs, 1)
    ascent = torch.optim.Adam(actor.parameters(), lr=RATE, betas=(0.7, 0.95))
    schedule = torch.optim.lr_scheduler.LinearLR(ascent, 1.0, 0.05, windows)
    fitting = torch.optim.Adam(critic.parameters(), lr=CRITIC_RATE)
    curve, seconds, failed = Curve("short horizons", seed), 0.0, 0
    curve.note(task, actor, 0, 0.0)
    for window in tqdm(range(1, windows + 1), desc=f"short horizons, seed {seed}", unit="window", leave=False):
        begin = time.process_time()
        if float(moment.time_left.max()) < 0.5 * DT:
            moment = task.start(*generators)
        played = play(task, actor, critic, moment, torch.randn(HORIZON, EPISODES, 2, dtype=F64))
        moment = detached(played.end)
        info = task.simulator.info
        failed += info is None or not info.converged
        ascent.zero_grad()
        (-played.gain).backward()
        nn.utils.clip_grad_norm_(actor.parameters(), 1.0)
        ascent.step()
        schedule.step()
        targets = played.targets()
        for _ in range(CRITIC_UPDATES):
            fitting.zero_grad()
            (critic(played.seen)[..., 0] - targets).square().mean().backward()
            fitting.step()
        seconds += time.process_time() - begin
        if window % EVERY == 0 or window == windows:
            curve.note(task, actor, window * HORIZON * EPISODES, seconds)
    return curve, actor, critic, failed


def by_ppo(task: Task, seed: int, steps: int) -> Curve:
    from stable_baselines3 import PPO
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv

    class Episodes(VecEnv):
        """Our episodes as stable-baselines3 wants them."""

        def __init__(self) -> None:
            self.env = VectorEnv(task, EPISODES, gymnasium.vector.AutoresetMode.SAME_STEP)
            super().__init__(EPISODES, self.env.single_observation_space, self.env.single_action_space)

        def reset(self) -> Any:
            return self.env.reset(seed=seed)[0]

        def step_async(self, actions: Any) -> None:
            self.actions = actions

        def step_wait(self) -> Any:
            seen, rewards, terminated, truncated, infos = self.env.step(self.actions)
            ended, told = terminated | truncated, [{} for _ in range(EPISODES)]
            for i in np.flatnonzero(ended):
                told[i] = {"TimeLimit.truncated": bool(truncated[i]), "terminal_observation": infos["final_obs"][i]}
            return seen, rewards.astype(np.float32), ended, told

        def close(self) -> None: ...

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [None] * EPISODES  # of what it asks for, `render_mode`

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None: ...

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
            raise NotImplementedError

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * EPISODES

    curve = Curve("PPO", seed)

    class Record(BaseCallback):
        begin = time.process_time()

        def _on_step(self) -> bool:
            bar.update(EPISODES)
            return True

        def _on_rollout_start(self) -> None:
            testing = time.process_time()
            curve.note(task, act, self.num_timesteps, testing - self.begin)
            self.begin += time.process_time() - testing

    def act(observation: Tensor) -> Tensor:
        action, _ = model.predict(observation.numpy().astype(np.float32), deterministic=True)
        return torch.from_numpy(action).double()

    network_sizes = {"net_arch": [64, 64]}
    model = PPO("MlpPolicy", Episodes(), n_steps=STEPS, batch_size=256, seed=seed, policy_kwargs=network_sizes)
    with tqdm(total=steps, desc=f"PPO, seed {seed}", unit="step", leave=False) as bar:
        record = Record()
        model.learn(steps, callback=record)
    record._on_rollout_start()
    return curve


# ---- checks ----------------------------------------------------------------------------------------------------------


def gradient_error(task: Task, actor: Actor, critic: nn.Module) -> float:
    """Of a window's gain along a direction of the policy's weights, relative to central differences."""
    generator = torch.Generator().manual_seed(0)
    weights = list(actor.parameters())
    direction = [torch.randn(w.shape, generator=generator, dtype=F64) for w in weights]
    noise = torch.randn(HORIZON, 8, 2, generator=generator, dtype=F64)

    def gain() -> Tensor:
        start = task.start(*(np.random.default_rng(20_000 + i) for i in range(8)))
        return play(task, actor, critic, start, noise).gain

    gradient = torch.autograd.grad(gain(), weights)
    slope = sum(float((g * d).sum()) for g, d in zip(gradient, direction))
    values, nudge = [], 1e-7
    with torch.no_grad():
        for sign in (1.0, -2.0, 1.0):  # there, to the other side, and back
            for w, d in zip(weights, direction):
                w.add_(d, alpha=sign * nudge)
            values.append(float(gain()))
    return abs((values[0] - values[1]) / (2.0 * nudge) / slope - 1.0)


def slide_error(task: Task) -> float:
    """Of the way a ball slides in 10 steps on a tray that leans and stays so, relative to g sin cos t (t + dt) / 2."""
    sine, steps = 0.1, 10
    rest = task.simulator.initial_state()
    turn = ds.rotation.from_rpy(torch.tensor([0.0, math.asin(sine), 0.0], dtype=F64))
    position, orientation = rest.position.clone(), rest.orientation.clone()
    position[0] = position[1] + ds.rotation.to_matrix(turn) @ (position[0] - position[1])
    orientation[1] = turn
    start = rest.replace(position=position, orientation=orientation)
    end = task.simulator.rollout(start, steps=steps)[-1]
    way = float(end.position[0, 0] - start.position[0, 0])
    expected = 0.5 * GRAVITY * sine * math.sqrt(1.0 - sine**2) * (steps * DT) * (steps * DT + DT)
    return abs(way / expected - 1.0)


def check(task: Task, ours: Sequence[Curve], ppo: Sequence[Curve], learned: Any, failed: int) -> bool:
    """Print what must hold and whether it does. `learned`: the policy of the first seed and its critic."""
    listed = ", ".join(f"{1e3 * c.held[-1]:.1f}" for c in ours)
    text = f"after {ours[0].steps[-1]} steps the ball is held {listed} mm from its target (at most {1e3 * HELD:g})"
    results = [(text, max(c.held[-1] for c in ours) <= HELD)]
    fresh = Actor(6, 2), learned[1]
    for name, (actor, critic) in (("first", fresh), ("learned", learned)):
        error = gradient_error(task, actor, critic)
        text = f"gradient of a window by the {name} policy: {error:.1e} off central differences"
        results.append((text, error <= GRADIENT_ERROR))
    error = slide_error(task)
    results.append((f"on a leaning tray the ball slides as it must, to {error:.1e}", error <= SLIDE_ERROR))
    results.append((f"{failed} windows had a step that did not converge", failed == 0))
    if ppo:
        after = [float(np.interp(ours[0].steps[-1], c.steps, c.held)) for c in ppo]
        listed = ", ".join(f"{1e3 * x:.0f}" for x in after)
        text = f"PPO holds it {listed} mm from there after as many steps, and"
        text += f" {', '.join(f'{1e3 * c.held[-1]:.0f}' for c in ppo)} mm after {ppo[0].steps[-1]}"
        results.append((text, float(np.median(after)) > max(c.held[-1] for c in ours)))
    return report(results)


# ---- picture ---------------------------------------------------------------------------------------------------------

COLORS = {"short horizons": "#d9601a", "PPO": "#7a4fa3"}


def draw_curves(axes: Any, curves: Sequence[Curve], over: str) -> None:
    """Mean and standard deviation over seeds; tests come after the same numbers of steps."""
    held = 1e3 * np.array([c.held for c in curves])
    x = np.mean([getattr(c, over) for c in curves], axis=0)
    draw_band(axes, x, held, COLORS[curves[0].name], lw=1.8, label=of_seeds(curves[0].name, len(curves)))


def draw(task: Task, actor: Actor, groups: Sequence[Sequence[Curve]], path: Path) -> None:
    def fill(figure: Any) -> None:
        scene, steps, seconds = figure.subplots(1, 3, width_ratios=(1.2, 1.0, 1.0))
        camera, sim = Camera(-60.0, 32.0), task.simulator
        with torch.no_grad():
            moments = [task.start(np.random.default_rng(10_000))]
            for _ in range(STEPS):
                moments.append(task.step(moments[-1], actor(task.observation(moments[-1]))))
        items = [Item(sim.mesh(moments[-1].state[0], 1), (0.72, 0.76, 0.82))]
        for index in (0, 6, 12, 18, STEPS):
            items.append(Item(sim.mesh(moments[index].state[0], 0), (0.93, 0.55, 0.25), 0.4 + 0.6 * index / STEPS))
        draw_items(scene, items, camera, shadows=False)
        path_dots = camera.project(np.array([m.state.position[0, 0].numpy() for m in moments]))
        scene.plot(path_dots[:, 0], path_dots[:, 1], color="#b3261e", lw=1.2, zorder=5)
        goal = camera.project([*moments[0].goal[0].tolist(), 0.0])
        scene.plot(goal[0], goal[1], "+", ms=12, mew=2.0, color="#0a7d33", zorder=6)
        scene.set_title("a test episode, to the cross", fontsize=10, color="0.2")
        for axes, over, label in ((steps, "steps", "steps"), (seconds, "seconds", "seconds of the processor")):
            for curves in groups:
                draw_curves(axes, curves, over)
            axes.axhline(1e3 * HELD, color="0.6", lw=1.0, ls="--")
            axes.set(xlabel=label, ylabel="distance held in test episodes [mm]", yscale="log")
            axes.locator_params(axis="x", nbins=5)
            axes.grid(True, alpha=0.3)
        steps.legend(frameon=False)
        seconds.set_title("mean and standard deviation", fontsize=10, color="0.2")

    save_figure(path, fill, figsize=(13.0, 4.2))


def summary(groups: Sequence[Sequence[Curve]]) -> dict[str, Any]:
    """For a file of results."""
    return {
        curves[0].name: [
            {
                "seed": c.seed,
                "steps": c.steps,
                "seconds": [round(x, 3) for x in c.seconds],
                "held [m]": [round(x, 6) for x in c.held],
            }
            for c in curves
        ]
        for curves in groups
    }


# ---- program ---------------------------------------------------------------------------------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    parser = make_parser(__doc__, f"one seed, {QUICK_WINDOWS} windows, without PPO", "the first")
    parser.add_argument("--seeds", type=int, default=SEEDS, help="how many (default: %(default)s)")
    parser.add_argument("--windows", type=int, default=WINDOWS, help="of each training (default: %(default)s)")
    options = parser.parse_args(argv)
    begin = time.perf_counter()
    task = build_task()
    seeds = range(options.seed, options.seed + (1 if options.quick else options.seeds))
    windows = min(options.windows, QUICK_WINDOWS) if options.quick else options.windows
    trained = [by_short_horizons(task, seed, windows) for seed in seeds]
    ours = [curve for curve, *_ in trained]
    ppo: list[Curve] = []
    if not options.quick and present("stable_baselines3", "rl", "PPO"):
        ppo = [by_ppo(task, seed, PPO_STEPS * windows * HORIZON * EPISODES) for seed in seeds]
    if not options.no_picture:
        groups = [ours, ppo] if ppo else [ours]
        draw(task, trained[0][1], groups, options.out / "balance_ball.png")
        save_results(options.out / "balance_ball.json", summary(groups))
    passed = check(task, ours, ppo, trained[0][1:3], sum(failed for *_, failed in trained))
    print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
    return 0 if passed else 1


if __name__ == "__main__":
    sys.exit(main())
