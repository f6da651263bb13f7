"""The examples, run as their users run them."""

from __future__ import annotations

import importlib.util
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

import diffsim as ds

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
pytest.importorskip("pymeshfix", reason="the examples' packages: pip install .[examples]")
sys.path.insert(0, str(EXAMPLES))  # as Python does for a script: they share _stage.py


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look it up there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module", autouse=True)
def _figures_repaired_once() -> Iterator[None]:
    """To close the scan of the bunny takes seconds, and five tests begin with it."""
    stage = importlib.import_module("_stage")
    found: dict[bytes, Any] = {}
    repair = stage.repaired

    def repaired(mesh: Any) -> Any:
        key = mesh.vertices.tobytes() + mesh.faces.tobytes()
        if key not in found:
            found[key] = repair(mesh)
        return found[key].copy()

    stage.repaired = repaired
    yield
    stage.repaired = repair


@pytest.fixture(scope="module")
def bunny() -> ModuleType:
    return load("throw_bunny")


def test_throw_bunny_check_fails_without_optimisation(bunny: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert bunny.main(["--iterations", "1", "--no-picture"]) == 1
    assert "FAIL  squared distance fell 1 times" in capsys.readouterr().out


def test_throw_bunny_sees_where_gravity_is_less(bunny: ModuleType) -> None:
    throw = bunny.Throw(bunny.load_mesh())
    assert bunny.flight_error(throw, bunny.optimise(throw, 1, quiet=True).first) <= bunny.FLIGHT_ERROR
    with torch.no_grad():
        throw.sim.gravity *= 0.9
    assert bunny.flight_error(throw, bunny.optimise(throw, 1, quiet=True).first) > 1e-3


def test_throw_bunny_takes_another_mesh(bunny: ModuleType, tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / "ellipsoid.ply"
    mesh = trimesh.creation.icosphere(subdivisions=4)
    mesh.apply_scale([3.0, 2.0, 1.5])
    mesh.export(path)
    loaded = bunny.load_mesh(str(path))
    assert loaded.is_watertight
    assert len(loaded.faces) <= bunny.FACES
    assert loaded.extents.max() == pytest.approx(bunny.SIZE)
    np.testing.assert_allclose(loaded.center_mass, 0.0, atol=1e-6 * bunny.SIZE)


def test_throw_bunny_judge_sees_what_overlaps(bunny: ModuleType) -> None:
    throw = bunny.Throw(bunny.load_mesh())
    judge = bunny.Judge(throw)
    at_rest = throw.sim.initial_state(batch=1)  # taken for a trajectory of one step
    assert judge.penetrations(at_rest) == []
    chute, wedge = (throw.sim.body_names.index(name) for name in ("chute", "wedge"))
    wall = torch.tensor([0.0, 0.16, 0.0], dtype=torch.float64)
    for place, partner in (
        (throw.rest.position[chute] + wall, "chute"),
        (throw.rest.position[wedge], "wedge"),  # swallowed whole
        (torch.tensor([0.0, 0.0, 0.01], dtype=torch.float64), "the ground"),
    ):
        position = at_rest.position.clone()
        position[:, throw.bunny] = place
        (found,) = judge.penetrations(at_rest.replace(position=position))
        assert "bunny" in found
        assert partner in found


def test_throw_bunny_closes_what_decimation_opens(bunny: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    trimesh = pytest.importorskip("trimesh")

    def decimated(mesh: object, face_count: int) -> object:
        whole = trimesh.creation.icosphere(subdivisions=3)
        return trimesh.Trimesh(whole.vertices, whole.faces[1:])

    monkeypatch.setattr(trimesh.Trimesh, "simplify_quadric_decimation", decimated)
    assert bunny.load_mesh().is_watertight


def test_throw_bunny_says_in_a_line_that_there_is_no_such_mesh(
    bunny: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        bunny.main(["--mesh", "/nope.ply"])
    assert "error: --mesh: " in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("name", "arguments", "fails"),
    [
        ("dominoes", ["--no-sills", "--duration", "1.0"], ("dominoes fall", "the last domino does not reach")),
        ("dominoes", ["--missing", "3", "--duration", "1.0"], ("dominoes fall", "the last domino does not reach")),
        ("trampoline", ["--quick", "--dt", "0.04"], ("comes up to",)),  # such steps take its energy away
    ],
)
def test_cloth_example_fails_where_it_should(
    name: str, arguments: list[str], fails: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert load(name).main([*arguments, "--no-picture"]) == 1
    wrong = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAIL ")]
    for text in fails:
        assert any(text in line for line in wrong), wrong


@pytest.mark.parametrize(
    ("name", "arguments", "fails"),
    [
        ("dominoes", ["--duration", "0.3"], "presses on the ground with its weight"),
        ("learn_sticks", ["--episodes", "1"], "what carries it bears its weight"),
    ],
)
def test_example_fails_where_gravity_is_less(
    name: str, arguments: list[str], fails: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = ds.Simulator.__init__

    def make(sim: ds.Simulator, *args: object, **settings: object) -> None:
        made(sim, *args, **settings)  # type: ignore[arg-type]
        with torch.no_grad():
            sim.gravity *= 0.9

    monkeypatch.setattr(ds.Simulator, "__init__", make)
    assert load(name).main(["--quick", "--no-picture", *arguments]) == 1
    wrong = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAIL ")]
    assert any(fails in line for line in wrong), wrong


def test_balance_ball_plays_ppo(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stable_baselines3", reason="pip install 'mesh-diffsim[rl]'")
    module = load("balance_ball")
    monkeypatch.setattr(module, "EPISODES", 2)
    task = module.build_task()
    curve = module.by_ppo(task, 0, 2 * module.STEPS)
    assert curve.steps == [0, 2 * module.STEPS]
    assert 0.0 < curve.held[-1] < module.SIDE


def test_dominoes_need_friction_or_sills() -> None:
    dominoes = load("dominoes")
    rough, smooth = (
        dominoes.run_scene(0.01, 0.7, sills=False, friction=friction, quiet=True) for friction in (0.3, 0.0)
    )
    fallen, short = (int((run.tilts()[-1] > dominoes.TOPPLED).sum()) for run in (rough, smooth))
    assert rough.failed == []
    assert fallen >= 3
    assert short <= 1


def test_card_house_slides_apart_where_it_is_slippery() -> None:
    house = load("card_house")
    stands, slides = (house.stand(friction, 0.04, levels=2) for friction in (0.5, 0.25))
    assert stands.drift < house.DRIFT < slides.drift
    assert stands.slipping == 0 < slides.slipping


EVERY = sorted(path.stem for path in EXAMPLES.glob("[a-z]*.py"))
PARTS = {  # what each checks
    "balance_ball": 5,
    "card_house": 11,
    "dominoes": 8,
    "estimate_mass": 8,
    "hanging_cloth": 10,
    "learn_cloth": 7,
    "learn_sticks": 6,
    "lift_figurines": 11,
    "marble_inverse": 8,
    "mujoco_interop": 6,
    "throw_bunny": 10,
    "train_distributed": 7,
    "trampoline": 10,
}


@pytest.mark.parametrize("name", EVERY)
def test_every_example_passes_and_leaves_a_result_and_a_picture(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for package in ("cma", "gymnasium", "mujoco", "scipy"):
        pytest.importorskip(package, reason="pip install .[examples]")
    assert load(name).main(["--quick", "--out", str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "FAIL" not in output
    assert output.count("ok  ") == PARTS[name]
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"{name}.json", f"{name}.png"]
    assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    found = json.loads((tmp_path / f"{name}.json").read_text(encoding="utf-8"))
    assert any(isinstance(value, (list, dict)) and len(value) > 0 for value in found.values())


def test_results_are_read_back_as_they_were(tmp_path: Path) -> None:
    path = tmp_path / "a folder" / "found.json"
    found = {"m²": torch.tensor([[0.1, 2.0]], dtype=torch.float64), "b": {"c": np.arange(2)}, "d": [None, 0.3]}
    load("_stage").save_results(path, found)
    text = path.read_text(encoding="utf-8")
    assert json.loads(text) == {"m²": [[0.1, 2.0]], "b": {"c": [0, 1]}, "d": [None, 0.3]}
    assert text.count("\n") == len(found) + 2


@pytest.mark.parametrize("name", EVERY)
def test_every_example_is_told_the_same(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    for package in ("cma", "gymnasium", "mujoco", "scipy"):
        pytest.importorskip(package, reason="pip install .[examples]")
    module = load(name)
    assert callable(module.check)
    with pytest.raises(SystemExit):
        module.main(["--help"])
    told = capsys.readouterr().out
    assert [option for option in ("--seed", "--quick", "--out", "--no-picture") if option not in told] == []


def test_marble_inverse_fails_where_gradients_are_wrong(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = load("marble_inverse")
    objective = module.Problem.objective

    def half(self: object, unknowns: torch.Tensor) -> torch.Tensor:
        return objective(self, 0.5 * (unknowns + unknowns.detach()))

    monkeypatch.setattr(module.Problem, "objective", half)
    assert module.main(["--quick", "--seeds", "1", "--iterations", "1", "--no-picture"]) == 1
    assert "FAIL  gradients at no force" in capsys.readouterr().out


def test_marble_inverse_fails_where_the_marble_is_heavier(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = load("marble_inverse")
    table = module.Table()
    with torch.no_grad():
        table.sim.mass *= 1.5
    assert not module.check(table, module.run_trials(table, [0], 1, 1), 1)
    assert "FAIL  without force, in the last 10 steps" in capsys.readouterr().out


def test_learning_chooses_its_rate_on_seeds_and_targets_that_are_not_tested(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("gymnasium", reason="pip install .[examples]")
    sticks, learning = load("learn_sticks"), sys.modules["_learning"]
    assert not set(learning.CHOOSING) & set(range(sticks.PROGRAM.seeds))
    drawn = []

    def starts(task: object, first: int = learning.TESTED) -> object:
        drawn.append(first)
        return task.start(*(np.random.default_rng(first + i) for i in range(2)))  # type: ignore[attr-defined]

    monkeypatch.setattr(learning, "held_out_starts", starts)
    monkeypatch.setattr(learning, "CHOOSING", range(10, 11))
    monkeypatch.setattr(learning, "RATES", (1e-5, 1e-2))
    assert sticks.main(["--choose-rate", "--episodes", "2"]) == 0
    assert set(drawn) == {learning.CHOSEN}
    assert "the least is left by rate 0.01" in capsys.readouterr().out


def test_mujoco_interop_fails_where_the_layer_has_another_mass(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco", reason="pip install .[examples]")
    module = load("mujoco_interop")
    made = module.Task.__init__

    def make(task: object, seed: int) -> None:
        made(task, seed)
        with torch.no_grad():
            task.sim.mass[task.cubes[1]] *= 3.0  # type: ignore[attr-defined]

    monkeypatch.setattr(module.Task, "__init__", make)
    assert module.main(["--no-picture"]) == 1
    assert "FAIL  gradient through contact" in capsys.readouterr().out


def test_estimate_mass_fails_where_velocities_are_damped(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    module = load("estimate_mass")
    forward = module.Rollout.forward

    def damped(self: object, state: ds.State, control: ds.Control | None) -> ds.State:
        trajectory = forward(self, state, control)
        return trajectory.replace(velocity=0.673 * trajectory.velocity)

    monkeypatch.setattr(module.Rollout, "forward", damped)
    descent = module.descend(1.0)
    assert descent.masses[-1] == pytest.approx(5.46, abs=0.01)  # as the paper has it
    recording = module.Recording()
    count = len(module.NAMES)
    jacobian = torch.eye(count, dtype=torch.float64).repeat(43, 1)
    fit = module.Fit(torch.zeros(count, dtype=torch.float64), jacobian, module.NOISE, [])
    ones = torch.ones(count, dtype=torch.float64)
    assert not module.check(descent, recording, fit, module.Coverage(40, 38 * ones, ones))
    wrong = [line for line in capsys.readouterr().out.splitlines() if line.startswith("FAIL ")]
    assert len(wrong) == 2
    assert all("collision: " in line for line in wrong)


def test_learn_sticks_fails_without_training(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("gymnasium", reason="pip install .[examples]")
    assert load("learn_sticks").main(["--quick", "--episodes", "3", "--no-picture"]) == 1
    assert "FAIL  at 32 test targets" in capsys.readouterr().out


def test_trampoline_leaves_mujoco_out_where_it_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert load("trampoline").peers(5, 0.01, 0.0, 0.1) == []
    told = 'mujoco is not installed (pip install "mesh-diffsim[mujoco]"): its ball is left out\n'
    assert capsys.readouterr().out == told


def test_learning_leaves_ddpg_out_where_stable_baselines_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("gymnasium", reason="pip install .[examples]")
    monkeypatch.setitem(sys.modules, "stable_baselines3", None)
    assert load("_learning").by_ddpg(None, lambda moment: moment, [0], 1) is None
    told = 'stable_baselines3 is not installed (pip install "mesh-diffsim[rl]"): DDPG is left out\n'
    assert capsys.readouterr().out == told


@pytest.mark.parametrize(
    ("name", "package", "extra"),
    [
        ("learn_sticks", "gymnasium", "rl"),
        ("mujoco_interop", "mujoco", "examples"),
        ("marble_inverse", "cma", "examples"),
        ("estimate_mass", "scipy.stats", "examples"),
    ],
)
def test_an_example_ends_with_a_line_where_a_package_is_missing(
    name: str, package: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(sys.modules, "_learning", raising=False)
    with pytest.raises(SystemExit) as end:
        load(name)
    assert str(end.value) == f'{package} is not installed: pip install "mesh-diffsim[{extra}]"'


def test_judge_of_the_cloth_examples_sees_what_overlaps() -> None:
    trampoline, stage = load("trampoline"), load("_stage")
    scene = trampoline.build_scene(5, 0.0)
    sim = ds.Simulator(scene, dt=0.01)
    judge, state = stage.Judge(scene, sim), sim.initial_state()
    assert judge.problems(state) == []
    low = state.position.clone()
    low[0, 2] = trampoline.HEIGHT + 0.9 * trampoline.RADIUS
    (found,) = judge.problems(state.replace(position=low))
    assert "ball is 0.008 m deep" in found
    folded = state.node_position.clone()
    folded[0] = folded[24] + torch.tensor(
        [-0.1, -0.05, 0.1], dtype=torch.float64
    )  # corner over, and through, the far one
    folded[1] = folded[18] - torch.tensor([0.0, 0.0, 0.1], dtype=torch.float64)
    assert judge.problems(state.replace(node_position=folded)) == ["ipctk: surfaces cross"]


def test_judge_of_the_cloth_examples_sees_bodies_in_cloth_and_ground() -> None:
    dominoes, stage = load("dominoes"), load("_stage")
    scene = dominoes.build_scene()
    sim = ds.Simulator(scene, dt=0.01)
    judge, state = stage.Judge(scene, sim), sim.initial_state()
    assert judge.problems(state) == []
    for body, place, text in (
        (0, (-0.1, 0.0, dominoes.BAR), "surfaces cross"),  # through the cloth
        (0, tuple((state.position[1] + 0.01).tolist()), "surfaces cross"),  # through its neighbour
        (3, (1.0, 0.0, 0.05), "domino 3 is in the ground"),
    ):
        position = state.position.clone()
        position[body] = torch.tensor(place, dtype=torch.float64)
        assert any(text in found for found in judge.problems(state.replace(position=position)))
