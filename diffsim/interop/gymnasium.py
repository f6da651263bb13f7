"""A simulator as a Gymnasium environment, of one scene (`Env`) or a batch of them (`VectorEnv`). Extra ``rl``.

What an environment is about stands in a `Task`, as functions of tensors with a batch axis in front. Its `start` and
`step` are what the environments call, and are differentiable: the same task serves an algorithm that only sees rewards
and one that uses the gradients of the physics.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

try:
    import gymnasium
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ImportError as error:
    raise ImportError('diffsim.interop.gymnasium needs gymnasium: pip install "mesh-diffsim[rl]"') from error

from ..simulator import Simulator
from ..state import Control, State

__all__ = ["Env", "Moment", "Task", "VectorEnv"]

Array = NDArray[Any]


@dataclass(frozen=True)
class Moment:
    """B episodes, each at some time of its own."""

    state: State  #: with a batch axis (B)
    goal: Tensor  #: what else an episode began with, say a target, shape (B, ...); (B, 0) for nothing
    time_left: Tensor  #: to the end of the episode, shape (B,)  [s]

    def __getitem__(self, scenes: Any) -> Moment:
        """Those episodes: a slice, indices or a bool mask of shape (B,)."""
        return Moment(self.state[scenes], self.goal[scenes], self.time_left[scenes])

    @staticmethod
    def cat(moments: Sequence[Moment]) -> Moment:
        """Several, one after the other along the batch axis."""
        return Moment(
            State.cat([moment.state for moment in moments]),
            torch.cat([moment.goal for moment in moments]),
            torch.cat([moment.time_left for moment in moments]),
        )


@dataclass(frozen=True)
class Task:
    """What is to be done in a scene. Functions take and return tensors whose first axis is the batch of episodes.

    Args:
        simulator: Steps the scene. A step that does not converge ends its episode.
        sample: From a random generator to the start of one episode: a `State` without a batch axis, or such a state and
            a goal, a tensor of the state's dtype.
        control: From an action (B, ...) and the `Moment` to what drives the steps.
        observation: From a `Moment` to what the learner sees, shape (B, ...).
        reward: From the `Moment` before, the action, and the `Moment` after it, shape (B,).
        action_space: Of one episode; a Box.
        steps: Actions in an episode.
        substeps: Simulator steps per action, which stays the same in them.
        terminated: From a `Moment` to whether the episode has come to its end, bool, shape (B,). Default: never.
        terminates_in_time: Whether the end of the time belongs to the task and is a termination, as where the
            observation tells the time left and the reward counts at the end. By default it is a truncation.
        observation_space: Of one episode. Default: an unbounded Box of float32.
    Raises: ValueError for counts that are not positive.
    """

    simulator: Simulator
    sample: Callable[[np.random.Generator], State | tuple[State, Tensor]]
    control: Callable[[Tensor, Moment], Control]
    observation: Callable[[Moment], Tensor]
    reward: Callable[[Moment, Tensor, Moment], Tensor]
    action_space: gymnasium.spaces.Box
    steps: int
    substeps: int = 1
    terminated: Callable[[Moment], Tensor] | None = None
    terminates_in_time: bool = False
    observation_space: gymnasium.Space[Any] | None = None

    def __post_init__(self) -> None:
        for name in ("steps", "substeps"):
            if not getattr(self, name) >= 1:
                raise ValueError(f"Task: {name} must be at least 1, got {getattr(self, name)}")

    @property
    def action_seconds(self) -> float:
        """How long an action lasts [s]."""
        return self.substeps * self.simulator.dt

    def start(self, *generators: np.random.Generator) -> Moment:
        """The beginning of one episode for each generator."""
        return Moment.cat([self._start(generator) for generator in generators])

    def _start(self, generator: np.random.Generator) -> Moment:
        sampled = self.sample(generator)
        state, goal = sampled if isinstance(sampled, tuple) else (sampled, None)
        if not isinstance(state, State) or state.leading_shape:
            raise TypeError(f"Task: sample must return one State without a batch axis, or it and a goal, got {state!r}")
        goal = state.position.new_zeros(0) if goal is None else goal
        return Moment(state[None], goal[None], state.position.new_tensor([self.steps * self.action_seconds]))

    def step(self, moment: Moment, action: Tensor) -> Moment:
        """One action later; differentiable with respect to the action and the state.

        Args:
            moment: B episodes.
            action: In the dtype of the state, shape (B, ...).
        """
        return self._step(moment, action)[0]

    def _step(self, moment: Moment, action: Tensor) -> tuple[Moment, Tensor]:
        """Also: which episodes' steps all converged, bool, shape (B,)."""
        control, state = self.control(action, moment), moment.state
        converged = torch.ones(len(moment.time_left), dtype=torch.bool)
        for _ in range(self.substeps):
            state = self.simulator(state, control)
            info = self.simulator.info
            assert info is not None
            converged = converged & info.scenes_converged
        return Moment(state, moment.goal, moment.time_left - self.action_seconds), converged


class _Episodes:
    """B episodes of a task in numpy: what `Env` and `VectorEnv` share."""

    def __init__(self, task: Task) -> None:
        self.task = task
        self.action_space = task.action_space
        if task.observation_space is None:
            shape = task.observation(task.start(np.random.default_rng(0))).shape[1:]
            self.observation_space: Any = gymnasium.spaces.Box(-np.inf, np.inf, tuple(shape), np.float32)
        else:
            self.observation_space = task.observation_space

    def start(self, generators: Sequence[np.random.Generator]) -> Moment:
        with torch.no_grad():
            return self.task.start(*generators)

    def observe(self, moment: Moment) -> Array:
        with torch.no_grad():
            seen = self.task.observation(moment)
        return np.array(seen.numpy(), dtype=self.observation_space.dtype)

    def step(self, moment: Moment, actions: Any) -> tuple[Moment, Array, Array, Array, Array]:
        """The moment after, rewards, terminated, truncated, converged."""
        task = self.task
        numbers = np.asarray(actions)
        expected = (len(moment.time_left), *self.action_space.shape)
        if numbers.shape != expected:
            raise ValueError(f"step: action must have shape {expected}, got {numbers.shape}")
        action = torch.from_numpy(numbers.astype(np.float64)).to(moment.state.dtype)
        with torch.no_grad():
            after, converged = task._step(moment, action)
            rewards = task.reward(moment, action, after).numpy().astype(np.float64)
            over = (after.time_left < 0.5 * task.action_seconds).numpy()
            terminated = np.zeros_like(over) if task.terminated is None else task.terminated(after).numpy().copy()
        truncated = ~converged.numpy()
        if task.terminates_in_time:
            terminated |= over
        else:
            truncated |= over
        return after, rewards, terminated, truncated & ~terminated, converged.numpy()


class Env(gymnasium.Env[Array, Array]):
    """One scene. ``info["converged"]`` says whether the steps of the last action did; if not, the episode is truncated.

    Args:
        task: See `Task`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as Gymnasium declares it

    def __init__(self, task: Task) -> None:
        self._episodes = _Episodes(task)
        self.action_space = self._episodes.action_space
        self.observation_space = self._episodes.observation_space
        self.moment: Moment | None = None  #: where the episode is, a batch of one

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; `options` has no meaning here."""
        super().reset(seed=seed)
        self.moment = self._episodes.start([self.np_random])
        return self._episodes.observe(self.moment)[0], {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One action: observation, reward, terminated, truncated, info.

        Raises: RuntimeError before the first reset; ValueError for an action of another shape.
        """
        if self.moment is None:
            raise RuntimeError("Env: call reset before step")
        self.moment, *results = self._episodes.step(self.moment, np.asarray(action)[None])
        reward, terminated, truncated, converged = (r[0].item() for r in results)
        return self._episodes.observe(self.moment)[0], reward, terminated, truncated, {"converged": converged}


class VectorEnv(gymnasium.vector.VectorEnv[Array, Array, Array]):
    """Many scenes of one task, stepped by one call of the simulator on its batch axis.

    Episode i is the one an `Env` seeded with ``seed + i`` plays, bit by bit. ``infos["converged"]`` says of which
    episodes the steps converged, ``infos["_converged"]`` which made any: with autoreset in the next step, one that has
    ended begins anew instead. With autoreset in the same step ``infos["final_obs"]`` and ``infos["final_info"]`` hold
    what was seen and told last, for the episodes in ``infos["_final_obs"]``.

    Args:
        task: See `Task`.
        num_envs: Episodes at a time.
        autoreset_mode: When an episode that ended begins anew: in the next step, in the same, or not at all; then
            ``reset(options={"reset_mask": ended})`` begins those again.
    Raises: ValueError for a number of episodes that is not positive.
    """

    def __init__(self, task: Task, num_envs: int, autoreset_mode: AutoresetMode = AutoresetMode.NEXT_STEP) -> None:
        if num_envs < 1:
            raise ValueError(f"VectorEnv: num_envs must be at least 1, got {num_envs}")
        self._episodes = _Episodes(task)
        self.num_envs = num_envs
        self._mode = AutoresetMode(autoreset_mode)
        self.metadata = {"render_modes": [], "autoreset_mode": self._mode}
        self.single_action_space = self._episodes.action_space
        self.single_observation_space = self._episodes.observation_space
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self._generators: list[np.random.Generator] = []
        self._ended = np.zeros(num_envs, dtype=bool)
        self.moment: Moment | None = None  #: where the episodes are

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin all episodes.

        Args:
            seed: Of the first; the next have the following numbers. Or a sequence of seeds. Default: the generators go
                on.
            options: ``{"reset_mask": mask}`` begins only those episodes; bool, shape (num_envs,).
        Raises: ValueError for another number of seeds, or a mask of another shape or before the first reset.
        """
        seeds = self._seeds(seed)
        for i, value in enumerate(seeds):
            if len(self._generators) <= i:
                self._generators.append(gymnasium.utils.seeding.np_random(value)[0])
            elif value is not None:
                self._generators[i] = gymnasium.utils.seeding.np_random(value)[0]
        mask = np.ones(self.num_envs, dtype=bool)
        if options is not None and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            if mask.shape != (self.num_envs,) or mask.dtype != bool or self.moment is None:
                raise ValueError(
                    f"VectorEnv: reset_mask must be bool of shape ({self.num_envs},), after a first reset, got"
                    f" {mask.dtype} of shape {mask.shape}"
                )
        self._begin(mask)
        assert self.moment is not None
        return self._episodes.observe(self.moment), {}

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One action each: observations, rewards, terminated, truncated, infos.

        Raises: RuntimeError before the first reset, or for an episode that ended and was not reset; ValueError for
            actions of another shape.
        """
        if self.moment is None:
            raise RuntimeError("VectorEnv: call reset before step")
        if self._mode is AutoresetMode.DISABLED and self._ended.any():
            raise RuntimeError(f"VectorEnv: reset the episodes that ended: {np.flatnonzero(self._ended).tolist()}")
        actions = np.asarray(actions)
        if actions.shape[:1] != (self.num_envs,):
            raise ValueError(f"VectorEnv: actions must have {self.num_envs} rows, got shape {actions.shape}")
        live = ~self._ended
        rewards, terminated, truncated, converged = (
            np.zeros(self.num_envs, dtype=t) for t in (float, bool, bool, bool)
        )
        before = self.moment
        if live.any():
            which = slice(None) if live.all() else torch.from_numpy(live)
            after, *results = self._episodes.step(before[which], actions[live])
            for of_all, of_live in zip((rewards, terminated, truncated, converged), results):
                of_all[live] = of_live
            self.moment = after if live.all() else _scattered(before, live, after)
        if self._ended.any():  # only with autoreset in the next step
            self._begin(self._ended)
        infos: dict[str, Any] = {"converged": converged, "_converged": live}
        self._ended = terminated | truncated
        observations = self._episodes.observe(self.moment)
        if self._mode is AutoresetMode.SAME_STEP and self._ended.any():
            observations = self._begin_in_the_same_step(observations, infos)
        return observations, rewards, terminated, truncated, infos

    def _begin_in_the_same_step(self, observations: Array, infos: dict[str, Any]) -> Array:
        ended = self._ended
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(ended):
            final[i] = observations[i]
        converged = infos["converged"]
        last = {"converged": converged & ended, "_converged": ended}
        infos.update(converged=converged & ~ended, _converged=~ended)
        infos.update(final_obs=final, _final_obs=ended, final_info=last, _final_info=ended)
        self._begin(ended)
        assert self.moment is not None
        return self._episodes.observe(self.moment)

    def _begin(self, mask: Array) -> None:
        fresh = self._episodes.start([self._generators[i] for i in np.flatnonzero(mask)])
        self.moment = fresh if self.moment is None or mask.all() else _scattered(self.moment, mask, fresh)
        self._ended = self._ended & ~mask

    def _seeds(self, seed: int | Sequence[int | None] | None) -> Sequence[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, (int, np.integer)):
            return [int(seed) + i for i in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"VectorEnv: seed must be one number or {self.num_envs}, got {len(seed)}")
        return seed


def _scattered(whole: Moment, mask: Array, part: Moment) -> Moment:
    """The whole with the episodes of the mask exchanged for those of the part."""
    order = np.arange(len(mask))
    order[mask] = len(mask) + np.arange(int(mask.sum()))
    return Moment.cat([whole, part])[torch.from_numpy(order)]
