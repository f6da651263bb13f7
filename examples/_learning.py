"""What the examples of learned control share: a controller trained through the physics, DDPG beside it, and curves.

Both play the same `Task`, one episode after the other, with the same network: 50 and 200 rectified linear units, a
tangent at the end. Through the physics there is one update per episode, by the gradient of its loss, the square of the
distance from the target at the end over that at the start. DDPG, of stable-baselines3 with its own defaults, gets as
reward of every action how much nearer the object came, which adds up to the same; it makes an update per action, and
would need many more episodes than either gets here.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _stage import (
    FloatArray,
    draw_band,
    make_parser,
    needed,
    of_seeds,
    present,
    save_figure,
    save_results,
    weight_errors,
)
from torch import Tensor, nn
from tqdm import tqdm

import diffsim as ds
from diffsim.viewer import Camera, Item, draw_items

gymnasium = needed("gymnasium", "rl")

HIDDEN = (50, 200)
CLIP = 1.0  # of the norm of a gradient
TESTS = 32  # episodes nothing was trained on
TESTED, CHOSEN = 10_000, 20_000  # where the draws of the episodes that are tested on begin; and of those of a choice
CHOOSING = range(10, 15)  # seeds on which a rate is chosen; tests are on others
RATES = (1e-3, 2e-3, 3e-3, 5e-3, 1e-2)
BALANCE = 1e-3  # what the forces on the object may be off, of its weight
AVERAGE = 10  # episodes a point of a curve is the mean of


class Controller(nn.Module):
    """From observations (B, n) to actions (B, m) between -1 and 1."""

    def __init__(self, inputs: int, outputs: int, seed: int) -> None:
        super().__init__()
        torch.manual_seed(seed)
        a, b = HIDDEN
        layers = nn.Linear(inputs, a), nn.ReLU(), nn.Linear(a, b), nn.ReLU(), nn.Linear(b, outputs), nn.Tanh()
        self.layers = nn.Sequential(*layers).double()
        with torch.no_grad():
            self.layers[-2].weight.mul_(0.1)  # at first it hardly moves
            self.layers[-2].bias.zero_()

    def forward(self, observation: Tensor) -> Tensor:
        return self.layers(observation)


@dataclass
class Curve:
    """Of one seed: the distance left at the end of each episode, over that at its start, and when that was known."""

    seed: int
    left: list[float] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)  # of the processor
    tests: FloatArray = field(default_factory=lambda: np.empty(0))  # the same in the test episodes, after training

    def before(self, seconds: float) -> float:
        """What was left in the last AVERAGE episodes until then, on the average."""
        count = max(int(np.searchsorted(self.seconds, seconds)), 1)
        return float(np.mean(self.left[max(count - AVERAGE, 0) : count]))


@dataclass
class Learning:
    name: str
    curves: list[Curve] = field(default_factory=list)
    controllers: list[Any] = field(default_factory=list)  # one per seed, by the gradient
    failed_episodes: int = 0  # that had a step that did not converge

    @property
    def tests(self) -> FloatArray:
        """Mean distance left in the test episodes, one per seed."""
        return np.array([float(curve.tests.mean()) for curve in self.curves])


Distance = Callable[[Any], Tensor]  # from a Moment to the distance from the target, over that at the start, (B,)


def make_task(sim: ds.Simulator, steps: int, actions: int, **functions: Any) -> tuple[Any, Distance]:
    """Bring body 0 from its start to a goal in so many steps, by actions between -1 and 1; and what part of the
    distance is left. `functions`: the task's `sample`, `control` and `observation`.
    """
    start = sim.initial_state().position[0]

    def left(moment: Any) -> Tensor:
        whole = (moment.goal - start).norm(dim=-1)
        return (moment.goal - moment.state.position[:, 0]).norm(dim=-1) / whole

    task = ds.interop.gymnasium.Task(
        simulator=sim,
        reward=lambda before, action, after: left(before) - left(after),
        action_space=gymnasium.spaces.Box(-1.0, 1.0, (actions,), np.float32),
        steps=steps,
        terminates_in_time=True,
        **functions,
    )
    return task, left


def play(task: Any, act: Callable[[Tensor], Tensor], moment: Any) -> tuple[list[Any], bool]:
    """The moments of whole episodes, the start among them, and whether all steps converged."""
    moments, converged = [moment], True
    for _ in range(task.steps):
        moments.append(task.step(moments[-1], act(task.observation(moments[-1]))))
        converged = converged and task.simulator.info.converged
    return moments, converged


def held_out_starts(task: Any, drawn: int = TESTED) -> Any:
    """Of episodes nothing was trained on."""
    return task.start(*(np.random.default_rng(drawn + i) for i in range(TESTS)))


def left_over(task: Any, act: Callable[[Tensor], Tensor], left: Distance, drawn: int = TESTED) -> FloatArray:
    """What is left of the distance in such episodes."""
    with torch.no_grad():
        return np.asarray(left(play(task, act, held_out_starts(task, drawn))[0][-1]).numpy())


# ---- through the physics ---------------------------------------------------------------------------------------------


def by_gradient(
    task: Any, left: Distance, seeds: Sequence[int], episodes: int, rate: float, drawn: int = TESTED
) -> Learning:
    learning = Learning("through the physics")
    first = task.observation(task.start(np.random.default_rng(0)))
    for seed in seeds:
        controller = Controller(first.shape[1], task.action_space.shape[0], seed)
        optimiser = torch.optim.Adam(controller.parameters(), lr=rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, episodes)
        curve, generator, begin = Curve(seed), np.random.default_rng(seed), time.process_time()
        for _ in tqdm(range(episodes), desc=f"{learning.name}, seed {seed}", unit="episode", leave=False):
            moments, converged = play(task, controller, task.start(generator))
            learning.failed_episodes += not converged
            loss = left(moments[-1]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(controller.parameters(), CLIP)
            optimiser.step()
            schedule.step()
            curve.left.append(loss.item() ** 0.5)
            curve.seconds.append(time.process_time() - begin)
        curve.tests = left_over(task, controller, left, drawn)
        learning.curves.append(curve)
        learning.controllers.append(controller)
    return learning


def choose_rate(task: Any, left: Distance, episodes: int) -> None:
    """Print what each rate leaves, on seeds and targets that nothing is tested on."""
    means = {}
    for rate in RATES:
        tests = by_gradient(task, left, CHOOSING, episodes, rate, CHOSEN).tests
        means[rate] = tests.mean()
        listed = ", ".join(f"{100.0 * t:.2f}" for t in tests)
        print(f"rate {rate:g}: {100.0 * means[rate]:.2f} % of the distance left on the average, {listed}", flush=True)
    print(f"the least is left by rate {min(means, key=means.__getitem__):g}")


# ---- beside it -------------------------------------------------------------------------------------------------------


def by_ddpg(task: Any, left: Distance, seeds: Sequence[int], episodes: int) -> Learning | None:
    """None where stable-baselines3 is missing, which is said."""
    if not present("stable_baselines3", "rl", "DDPG"):
        return None
    from stable_baselines3 import DDPG
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.noise import NormalActionNoise

    class Record(BaseCallback):
        def __init__(self, curve: Curve, bar: Any) -> None:
            super().__init__()
            self.curve, self.bar, self.begin = curve, bar, time.process_time()

        def _on_step(self) -> bool:
            for info in self.locals["infos"]:
                if "episode" in info:  # by the Monitor stable-baselines3 puts around an environment
                    self.curve.left.append(1.0 - info["episode"]["r"])
                    self.curve.seconds.append(time.process_time() - self.begin)
                    self.bar.update()
            return True

    learning, size = Learning("DDPG"), task.action_space.shape[0]
    for seed in seeds:
        curve = Curve(seed)
        noise = NormalActionNoise(np.zeros(size), 0.2 * np.ones(size))
        network = {"net_arch": list(HIDDEN)}
        env = ds.interop.gymnasium.Env(task)
        start = 5 * task.steps  # five episodes of random actions before the first update
        model = DDPG("MlpPolicy", env, seed=seed, action_noise=noise, policy_kwargs=network, learning_starts=start)
        with tqdm(total=episodes, desc=f"DDPG, seed {seed}", unit="episode", leave=False) as bar:
            model.learn(episodes * task.steps, callback=Record(curve, bar))

        def act(observation: Tensor, model: Any = model) -> Tensor:
            return torch.from_numpy(
                model.predict(observation.numpy().astype(np.float32), deterministic=True)[0]
            ).double()

        curve.tests = left_over(task, act, left)
        learning.curves.append(curve)
    return learning


# ---- checks and pictures ---------------------------------------------------------------------------------------------


def gradient_error(task: Any, controller: Controller, left: Distance) -> float:
    """Of the loss of one episode along a direction of the controller's weights, relative to central differences."""
    weights = list(controller.parameters())
    generator = torch.Generator().manual_seed(0)
    direction = [torch.randn(w.shape, generator=generator, dtype=w.dtype) for w in weights]

    def loss() -> Tensor:
        return left(play(task, controller, task.start(np.random.default_rng(99)))[0][-1]).square().mean()

    gradient = torch.autograd.grad(loss(), weights)
    expected = sum(float((g * d).sum()) for g, d in zip(gradient, direction))
    values, nudge = [], 1e-7
    with torch.no_grad():
        for sign in (1.0, -2.0):  # there, and from there to the other side
            for w, d in zip(weights, direction):
                w.add_(d, alpha=sign * nudge)
            values.append(float(loss()))
        for w, d in zip(weights, direction):
            w.add_(d, alpha=nudge)
    assert expected != 0.0
    return abs((values[0] - values[1]) / (2.0 * nudge) / expected - 1.0)


def weight_error(task: Any, controller: Controller, mass: float, gravity: float) -> float:
    """Of body 0 in a test episode: what its contacts do beyond its weight and its gain of momentum, over its weight."""
    with torch.no_grad():
        moments, _ = play(task, controller, held_out_starts(task)[:1])
        drives = {
            k: task.control(controller(task.observation(moment)), moment)[0] for k, moment in enumerate(moments[:-1])
        }
        states = [moment.state[0] for moment in moments]
        return weight_errors(task.simulator, states, drives, {0: mass}, gravity)[0]


def findings(
    task: Any,
    left: Distance,
    ours: Learning,
    ddpg: Learning | None,
    reach: float,
    error: float,
    mass: float,
    gravity: float,
) -> list[tuple[str, bool]]:
    """What must hold, in words, and whether it does. `mass` [kg] and `gravity` [m/s²] are what body 0 shall have."""
    listed = ", ".join(f"{100.0 * t:.1f}" for t in ours.tests)
    results = [
        (
            f"at {TESTS} test targets the controllers leave {listed} % of the distance (at most {100.0 * reach:g})",
            bool((ours.tests <= reach).all()),
        )
    ]
    text = f"{ours.failed_episodes} episodes had a step that did not converge"
    results.append((text, ours.failed_episodes == 0))
    fresh = Controller(task.observation(held_out_starts(task)).shape[1], task.action_space.shape[0], 0)
    for name, controller in (("first", fresh), ("learned", ours.controllers[0])):
        found = gradient_error(task, controller, left)
        text = f"gradient of an episode by the {name} controller: {found:.1e} off central differences"
        results.append((text, found <= error))
    off = weight_error(task, ours.controllers[0], mass, gravity)
    text = f"what carries it bears its weight and speeds it up, to {off:.1e} of its weight"
    results.append((text, off <= BALANCE))
    if ddpg is not None:
        listed = ", ".join(f"{100.0 * t:.0f}" for t in ddpg.tests)
        text = f"DDPG leaves {listed} % of the distance after as many episodes,"
        early = (d.before(o.seconds[-1]) for d, o in zip(ddpg.curves, ours.curves))
        text += f" and {', '.join(f'{100.0 * x:.0f}' for x in early)} % in training after as many seconds"
        results.append((text, bool(np.median(ddpg.tests) > np.median(ours.tests))))
    return results


def summary(learnings: Sequence[Learning]) -> dict[str, Any]:
    """For a file of results."""
    return {
        learning.name: [
            {
                "seed": c.seed,
                "left": [round(x, 5) for x in c.left],
                "seconds": [round(x, 3) for x in c.seconds],
                "tests": [round(float(x), 5) for x in c.tests],
            }
            for c in learning.curves
        ]
        for learning in learnings
    }


def draw_moments(
    axes: Any,
    task: Any,
    ours: Learning,
    camera: Camera,
    apart: float,
    looks: dict[int, dict[str, Any]],
    **settings: Any,
) -> None:
    """The motion to a test target at its start, middle and end, side by side. `looks`: of each object, see `Item`."""
    with torch.no_grad():
        moments, _ = play(task, ours.controllers[0], held_out_starts(task)[:1])
    items, marks, dt = [], [], task.simulator.dt * task.substeps
    shown = (0, task.steps // 2, task.steps)
    for place, index in enumerate(shown):
        shift = np.array([apart * place, 0.0, 0.0])
        for thing, look in looks.items():
            mesh = task.simulator.mesh(moments[index].state[0], thing)
            mesh.apply_translation(shift)
            items.append(Item(mesh, **look))
        marks.append(camera.project(moments[0].goal.numpy()[0] + shift))
    draw_items(axes, items, camera, shadows=False, **settings)
    axes.plot(*np.array(marks)[:, :2].T, "+", ms=12, mew=2.0, color="#0a7d33", zorder=4)
    times = [f"{dt * index:g}" for index in shown]
    axes.set_title(f"a test target, t = {times[0]}, {times[1]} and {times[2]} s", fontsize=10, color="0.2")


COLORS = {"through the physics": "#d9601a", "DDPG": "#7a4fa3"}


def draw_curves(axes: Any, learning: Learning, over_seconds: bool) -> None:
    """Mean over seeds and one standard deviation to both sides."""
    kernel = np.ones(AVERAGE) / AVERAGE
    smooth = [np.convolve(c.left, kernel, mode="valid") for c in learning.curves]
    values = 100.0 * np.array(smooth)
    x = np.arange(AVERAGE, AVERAGE + values.shape[1], dtype=float)
    if over_seconds:
        x = np.mean([c.seconds for c in learning.curves], axis=0)[AVERAGE - 1 :]
    label = of_seeds(learning.name, len(learning.curves))
    draw_band(axes, x, values, COLORS[learning.name], lw=1.8, label=label)


def draw(learnings: Sequence[Learning], path: Path, draw_scene: Callable[[Any], None]) -> None:
    def fill(figure: Any) -> None:
        scene, episodes, seconds = figure.subplots(1, 3, width_ratios=(1.6, 1.0, 1.0))
        draw_scene(scene)
        for axes, over_seconds, label in ((episodes, False, "episodes"), (seconds, True, "seconds of the processor")):
            for learning in learnings:
                draw_curves(axes, learning, over_seconds)
            axes.axhline(5.0, color="0.6", lw=1.0, ls="--")
            axes.set(xlabel=label, ylabel="distance left at the end [%]", yscale="log", ylim=(0.1, 300.0))
            axes.grid(True, alpha=0.3)
        episodes.legend(frameon=False)
        seconds.set_title("mean and standard deviation", fontsize=10, color="0.2")

    save_figure(path, fill, figsize=(13.8, 4.2))


# ---- the program of both ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Program:
    """One of the two examples: what it is called, and how long it learns."""

    name: str
    description: str
    episodes: int
    quick_episodes: int
    rate: float
    seeds: int = 5  # by default

    def main(
        self,
        argv: Sequence[str] | None,
        build_task: Callable[[], tuple[Any, Distance]],
        check: Callable[[Any, Distance, Learning, Learning | None], bool],
        draw_scene: Callable[[Any, Any, Learning], None],
    ) -> int:
        quick = f"one seed, {self.quick_episodes} episodes, without DDPG"
        parser = make_parser(self.description, quick, "the first")
        parser.add_argument("--seeds", type=int, default=self.seeds, help="how many (default: %(default)s)")
        parser.add_argument("--episodes", type=int, default=self.episodes, help="of each (default: %(default)s)")
        text = f"instead, only say what other rates leave on seeds {CHOOSING[0]} to {CHOOSING[-1]}, and other targets"
        parser.add_argument("--choose-rate", action="store_true", help=text)
        options = parser.parse_args(argv)
        begin = time.perf_counter()
        task, left = build_task()
        if options.choose_rate:
            choose_rate(task, left, options.episodes)
            return 0
        seeds = range(options.seed, options.seed + (1 if options.quick else options.seeds))
        episodes = min(options.episodes, self.quick_episodes) if options.quick else options.episodes
        ours = by_gradient(task, left, seeds, episodes, self.rate)
        ddpg = None if options.quick else by_ddpg(task, left, seeds, episodes)
        if not options.no_picture:
            learnings = [ours] if ddpg is None else [ours, ddpg]
            draw(learnings, options.out / f"{self.name}.png", lambda axes: draw_scene(axes, task, ours))
            save_results(options.out / f"{self.name}.json", summary(learnings))
        passed = check(task, left, ours, ddpg)
        print(f"{'passed' if passed else 'FAILED'} in {time.perf_counter() - begin:.0f} s")
        return 0 if passed else 1
