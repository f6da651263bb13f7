"""A step kept in a file is the same step when it is taken again."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from small_scenes import only_read
from test_robustness import PRESS, squeeze

import diffsim as ds
from diffsim import diagnostics


def everything() -> ds.Scene:
    scene = ds.Scene(gravity=(0.1, 0, -9.81))
    scene.add_ground(height=-0.1)
    scene.add_body(
        ds.shapes.box(0.3), density=700.0, position=(0.5, 0.5, 0.9), orientation=(1, 0.2, 0, 0), name="box é"
    )
    scene.add_sphere(0.1, density=500.0, position=(0, 0, 0.3))
    scene.add_body(
        ds.shapes.icosphere(0.2, subdivisions=1), kind="kinematic", position=(2, 0, 0.5), velocity=(-1, 0, 0)
    )
    scene.add_body(ds.shapes.box(0.3), kind="static", position=(-2, 0, 0.5), margin=0.01)
    scene.add_cloth(ds.shapes.sheet((1, 1), (5, 5)), ds.ClothMaterial(), pinned=[0, 3], position=(0.5, 0.5, 0.6))
    return scene


def assert_same(a: ds.State, b: ds.State) -> None:
    for name, value in a.__dict__.items():
        assert getattr(b, name).dtype is value.dtype
        assert torch.equal(getattr(b, name), value), name


def kept_step(path: Path, batch: int | None, dtype: torch.dtype) -> tuple[ds.Simulator, ds.State, ds.State]:
    """A simulator, where it was when a step was kept in a file, and where that step led."""
    options = {"thickness": 2e-3, "compliance": 1e-3, "adjoint": "qr", "coupling": "split", "max_iterations": 321}
    sim = ds.Simulator(everything(), dt=0.007, tolerance=1e-9, num_threads=1, on_failure="raise", **options)
    with torch.no_grad():
        sim.mass.mul_(1.1)
        sim.cloth_bend.mul_(1.2)
    start = sim.initial_state(batch).to(dtype)
    state = sim.rollout(start, None, 20)[-1]
    control = ds.Control(
        force=torch.full_like(state.position, 0.3), node_velocity=torch.full_like(state.node_position, 0.1)
    )
    control = only_read(sim, control)
    diagnostics.dump(sim, state.replace(velocity=state.velocity.clone().requires_grad_()), control, path)
    return sim, state, sim(state, control)


KEPT = [(batch, dtype) for batch in (None, 2) for dtype in (torch.float32, torch.float64)]


@pytest.mark.parametrize(("batch", "dtype"), KEPT)
def test_a_step_is_replayed_bit_by_bit(tmp_path: Path, batch: int | None, dtype: torch.dtype) -> None:
    path = tmp_path / "step.kept"
    sim, state, expected = kept_step(path, batch, dtype)
    kept = diagnostics.replay(path)
    assert_same(kept.state, state)
    assert kept.control is not None
    assert kept.control.torque is None
    assert_same(kept.step(), expected)
    assert repr(kept.sim) == repr(sim)
    assert kept.sim.body_names == sim.body_names
    assert sim.info is not None
    assert kept.sim.info is not None
    assert kept.sim.info.iterations == sim.info.iterations > 0
    assert kept.sim._on_failure == "raise"
    assert_same(kept.sim.initial_state(), sim.initial_state())


def test_another_process_replays_it(tmp_path: Path) -> None:
    """As a user would, elsewhere."""
    expected = [kept_step(tmp_path / str(k), *case)[-1] for k, case in enumerate(KEPT)]
    code = """if True:
        import sys, torch, diffsim
        for path in sys.argv[1:]:
            torch.save(diffsim.diagnostics.replay(path).step(), path + ".end")
    """
    subprocess.run([sys.executable, "-c", code, *(str(tmp_path / str(k)) for k in range(len(KEPT)))], check=True)
    for k, end in enumerate(expected):
        assert_same(torch.load(tmp_path / f"{k}.end"), end)


def test_a_failed_step_of_a_batch_is_kept(tmp_path: Path) -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    start = sim.initial_state(batch=2)
    with pytest.warns(ds.ConvergenceWarning):
        trajectory = sim.rollout(start, PRESS, 12)
    assert sim.info is not None
    failure = sim.info.failures[1]
    assert failure.scene == 1
    state = (trajectory[failure.step - 1] if failure.step else start)[failure.scene]
    diagnostics.dump(sim, state, PRESS, tmp_path / "failed.npz")
    kept = diagnostics.replay(str(tmp_path / "failed.npz"))
    with pytest.warns(ds.ConvergenceWarning):
        end = kept.step()
    assert kept.sim.info is not None
    assert [f.bodies for f in kept.sim.info.failures] == [failure.bodies]
    assert_same(end, trajectory[failure.step, failure.scene])


def test_without_a_control(tmp_path: Path) -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    diagnostics.dump(sim, sim.initial_state(), None, tmp_path / "step")
    kept = diagnostics.replay(tmp_path / "step")
    assert kept.control is None
    assert_same(kept.step(), sim(sim.initial_state()))


def test_the_file_holds_no_pickle_and_no_place(tmp_path: Path) -> None:
    sim = ds.Simulator(everything(), dt=0.01)
    diagnostics.dump(sim, sim.initial_state(), None, tmp_path / "step")
    with np.load(tmp_path / "step", allow_pickle=False) as file:
        assert all(file[name].dtype != object for name in file.files)
        assert str(tmp_path) not in str(file["about"])


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    sim = ds.Simulator(squeeze(), dt=0.01)
    state = sim.initial_state()
    with pytest.raises(TypeError, match=r"dump: sim must be a diffsim.Simulator"):
        diagnostics.dump(state, state, None, tmp_path / "step")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"dump: state.position must have shape \(2, 3\)"):
        diagnostics.dump(sim, ds.State(torch.zeros(3, 3, dtype=torch.float64)), None, tmp_path / "step")
    assert not (tmp_path / "step").exists()


def test_other_files_are_refused_by_name(tmp_path: Path) -> None:
    path = tmp_path / "other"
    with pytest.raises(FileNotFoundError):
        diagnostics.replay(path)
    path.write_bytes(b"solid cube")
    with pytest.raises(ValueError, match=r"replay: .*other must be a file that diffsim.diagnostics.dump wrote"):
        diagnostics.replay(path)
    torch.save({"about": 1}, path)
    with pytest.raises(ValueError, match="must be a file that"):
        diagnostics.replay(path)
    np.save(path.with_suffix(".npy"), np.zeros(3))
    with pytest.raises(ValueError, match="must be a file that"):
        diagnostics.replay(path.with_suffix(".npy"))
    sim = ds.Simulator(squeeze(), dt=0.01)
    diagnostics.dump(sim, sim.initial_state(), None, path)
    with np.load(path) as file:
        arrays = dict(file)
    later = {**arrays, "about": np.array(str(arrays["about"]).replace('"format": 1', '"format": 2'))}
    with path.open("wb") as file:
        np.savez(file, **later)
    with pytest.raises(ValueError, match="must be of format 1, the one this version of diffsim reads, got 2"):
        diagnostics.replay(path)
    del arrays["scene/margin"]
    with path.open("wb") as file:
        np.savez(file, **arrays)
    with pytest.raises(ValueError, match=r"lacks, or has too many, .*margin"):
        diagnostics.replay(path)
