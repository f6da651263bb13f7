"""A simulator as a Gymnasium environment."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
import torch

import diffsim as ds

gymnasium = pytest.importorskip("gymnasium", reason='pip install "mesh-diffsim[rl]"')
from gymnasium.utils.env_checker import check_env  # noqa: E402
from gymnasium.vector import AutoresetMode, SyncVectorEnv  # noqa: E402


def make_task(**changes: Any) -> Any:
    """Push a box on smooth ground to a place, with a wall in the way."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.2), mass=1.0, position=(0.0, 0.0, 0.1))
    scene.add_body(ds.shapes.box((0.1, 1.0, 0.4)), kind="static", position=(0.4, 0.0, 0.2))
    sim = ds.Simulator(scene, dt=0.02)
    rest = sim.initial_state()

    def sample(rng: np.random.Generator) -> Any:
        return rest, torch.from_numpy(rng.uniform(-0.5, 0.5, 2))

    def control(action: torch.Tensor, moment: Any) -> ds.Control:
        force = torch.nn.functional.pad(10.0 * action, (0, 1))
        return ds.Control(force=torch.stack([force, torch.zeros_like(force)], dim=1))

    def observation(moment: Any) -> torch.Tensor:
        here, way = moment.state.position[:, 0, :2], moment.state.velocity[:, 0, :2]
        return torch.cat([moment.goal - here, way, moment.time_left[:, None]], dim=1)

    def reward(before: Any, action: torch.Tensor, after: Any) -> torch.Tensor:
        return -(after.goal - after.state.position[:, 0, :2]).norm(dim=-1) - 1e-3 * action.square().sum(-1)

    settings = {
        "simulator": sim,
        "sample": sample,
        "control": control,
        "observation": observation,
        "reward": reward,
        "action_space": gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32),
        "steps": 5,
        "substeps": 2,
        "terminated": lambda moment: moment.state.position[:, 0, 0] > 0.05,
    }
    return ds.interop.gymnasium.Task(**{**settings, **changes})


@pytest.mark.filterwarnings("ignore:.*(minimum|maximum) value is|.*alternative render modes:UserWarning")
def test_gymnasiums_own_checker_passes() -> None:
    check_env(ds.interop.gymnasium.Env(make_task()))


@pytest.mark.filterwarnings("ignore:.*(minimum|maximum) value is:UserWarning")
def test_stable_baselines_own_checker_passes() -> None:
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason='pip install "mesh-diffsim[rl]"')
    checker.check_env(ds.interop.gymnasium.Env(make_task()))


def same(a: Any, b: Any) -> None:
    for key, value in a.items():
        if key not in b:
            assert not a[f"_{key.lstrip('_')}"].any(), key  # it holds for no episode
        elif isinstance(value, dict):
            same(value, b[key])
        else:
            np.testing.assert_equal(list(value), list(b[key]))


@pytest.mark.parametrize("mode", ["NEXT_STEP", "SAME_STEP"])
def test_a_batch_plays_what_gymnasiums_vector_of_single_environments_plays(mode: str) -> None:
    autoreset = AutoresetMode[mode]
    task, count = make_task(), 4
    many = ds.interop.gymnasium.VectorEnv(task, count, autoreset)
    singles = SyncVectorEnv([lambda: ds.interop.gymnasium.Env(task)] * count, autoreset_mode=autoreset)
    assert many.metadata["autoreset_mode"] is autoreset
    assert (many.observation_space, many.action_space) == (singles.observation_space, singles.action_space)
    many.action_space.seed(1)
    np.testing.assert_array_equal(many.reset(seed=7)[0], singles.reset(seed=7)[0])
    ended = np.zeros((2, count), dtype=int)
    for _ in range(20):
        action = many.action_space.sample()
        found, expected = many.step(action), singles.step(action)
        for mine, theirs in zip(found[:4], expected[:4]):
            np.testing.assert_array_equal(mine, theirs)  # bit by bit
        same(found[4], expected[4])
        ended += found[2], found[3]
    assert (ended > 0).any(axis=1).all(), "both kinds of ends were seen"
    np.testing.assert_array_equal(many.reset(seed=[3, None, 3, 4])[0][[0, 2]], singles.reset(seed=3)[0][[0, 0]])


def test_without_autoreset_ended_episodes_wait_for_their_mask() -> None:
    many = ds.interop.gymnasium.VectorEnv(make_task(), 3, AutoresetMode.DISABLED)
    first, _ = many.reset(seed=0)
    action = np.array([[1.0, 0.0], [-1.0, 0.0], [-1.0, 0.0]])
    for _ in range(3):
        observations, _, terminated, _, _ = many.step(action)
        if terminated.any():
            break
    assert terminated.tolist() == [True, False, False]
    with pytest.raises(RuntimeError, match=r"reset the episodes that ended: \[0\]"):
        many.step(action)
    again, _ = many.reset(options={"reset_mask": terminated})
    np.testing.assert_array_equal(again[1:], observations[1:])
    assert (again[0, 2:] == first[0, 2:]).all()
    assert (again[0, :2] != first[0, :2]).all()  # another goal: the generator went on
    many.step(action)


def test_the_end_of_the_time_is_a_truncation_unless_it_belongs_to_the_task() -> None:
    for belongs in (False, True):
        env = ds.interop.gymnasium.Env(make_task(terminated=None, terminates_in_time=belongs))
        env.reset(seed=0)
        ends = [env.step(np.zeros(2))[2:4] for _ in range(5)]
        assert ends == [(False, False)] * 4 + [(belongs, not belongs)]


def test_a_step_that_does_not_converge_truncates_its_episode_alone() -> None:
    task = make_task()
    task.simulator._options.max_iterations = 0
    rest = task.simulator.initial_state()
    flies = rest.replace(position=rest.position + torch.tensor([[0.0, 0.0, 5.0], [0.0, 0.0, 0.0]], dtype=torch.float64))
    starts = iter([rest, rest, flies])  # the first shows the shape of an observation
    sample = lambda rng: (next(starts), torch.zeros(2, dtype=torch.float64))  # noqa: E731
    many = ds.interop.gymnasium.VectorEnv(make_task(simulator=task.simulator, sample=sample, terminated=None), 2)
    many.reset()
    with pytest.warns(ds.ConvergenceWarning):
        _, _, terminated, truncated, infos = many.step(np.zeros((2, 2)))
    assert (terminated.tolist(), truncated.tolist()) == ([False, False], [True, False])
    assert infos["converged"].tolist() == [False, True]


def test_the_same_task_carries_gradients() -> None:
    task = make_task()
    moment = task.start(np.random.default_rng(0), np.random.default_rng(1))
    action = torch.full((2, 2), 0.3, dtype=torch.float64, requires_grad=True)
    after = task.step(moment, action)
    task.reward(moment, action, after).sum().backward()
    assert action.grad is not None
    assert (action.grad.abs() > 1e-4).all()
    with torch.no_grad():
        nudge = torch.tensor([[1e-6, 0.0], [0.0, 0.0]], dtype=torch.float64)
        values = [task.reward(moment, a, task.step(moment, a))[0] for a in (action + nudge, action - nudge)]
    assert float(values[0] - values[1]) / 2e-6 == pytest.approx(action.grad[0, 0].item(), rel=1e-6)


def test_what_is_wrong_is_named() -> None:
    env = ds.interop.gymnasium.Env(make_task())
    with pytest.raises(RuntimeError, match="call reset before step"):
        env.step(np.zeros(2))
    env.reset(seed=0)
    with pytest.raises(ValueError, match=r"action must have shape \(1, 2\), got \(1, 3\)"):
        env.step(np.zeros(3))
    many = ds.interop.gymnasium.VectorEnv(make_task(), 3)
    with pytest.raises(ValueError, match="reset_mask must be bool"):
        many.reset(options={"reset_mask": np.ones(3, dtype=bool)})
    with pytest.raises(ValueError, match="seed must be one number or 3, got 2"):
        many.reset(seed=[1, 2])
    with pytest.raises(ValueError, match="steps must be at least 1, got 0"):
        make_task(steps=0)
    batched = make_task().simulator.initial_state(batch=2)
    with pytest.raises(TypeError, match="sample must return one State without a batch axis"):
        make_task(sample=lambda rng: batched).start(np.random.default_rng(0))


def test_a_missing_gymnasium_is_named_with_what_mends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "diffsim.interop.gymnasium", raising=False)
    monkeypatch.delattr(ds.interop, "gymnasium", raising=False)
    with pytest.raises(ImportError) as error:
        ds.interop.gymnasium  # noqa: B018
    assert str(error.value) == 'diffsim.interop.gymnasium needs gymnasium: pip install "mesh-diffsim[rl]"'
