"""Recordings and pictures: every kind of file is written, plays, and shows what the simulation did."""

from __future__ import annotations

import io
import json
import shutil
import struct
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import diffsim as ds
from diffsim.viewer._forces import with_forces
from diffsim.viewer._recording import make_recording

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
BROWSER = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium")


@pytest.fixture(scope="module")
def fall() -> tuple[ds.Simulator, ds.State]:
    """A box, a ball and a cloth fall onto the ground beside a static wedge."""
    scene = ds.Scene()
    scene.add_ground()
    turned = (1.0, 0.2, 0.4, 0.1)
    scene.add_body(ds.shapes.box(0.3), density=300.0, position=(0.0, 0.0, 0.6), orientation=turned, name="box")
    scene.add_sphere(0.12, density=500.0, position=(-0.5, 0.0, 0.4), velocity=(0.5, 0.0, 0.0), name="ball")
    scene.add_body(ds.shapes.box(0.2), kind="static", position=(0.6, 0.3, 0.11), name="block")
    scene.add_cloth(ds.shapes.sheet(0.6, 5), position=(0.0, 0.0, 0.9), name="sheet")
    sim = ds.Simulator(scene, dt=0.02)
    start = sim.initial_state()
    return sim, sim.rollout(start, None, steps=20)


def test_recording_has_the_vertices_of_the_simulator(fall: tuple[ds.Simulator, ds.State]) -> None:
    sim, trajectory = fall
    recording = make_recording("test", sim, trajectory, [0, 7, 19])
    np.testing.assert_allclose(recording.times, [0.0, 0.14, 0.38])
    assert [part.name for part in recording.parts] == ["box", "ball", "block", "sheet"]
    for index, frame in enumerate((0, 7, 19)):
        for handle, part in enumerate(recording.parts):
            np.testing.assert_allclose(part.at(index), sim.mesh(trajectory[frame], handle).vertices, atol=1e-12)
    assert recording.parts[2].poses is None  # it never moves
    np.testing.assert_array_less(recording.bounds[0] - 1e-9, recording.parts[0].at(2).min(axis=0))


def test_a_list_of_states_is_a_trajectory(fall: tuple[ds.Simulator, ds.State]) -> None:
    sim, trajectory = fall
    for part, other in zip(
        make_recording("test", sim, list(trajectory)).parts, make_recording("test", sim, trajectory).parts, strict=True
    ):
        np.testing.assert_array_equal(part.at(11), other.at(11))


def test_what_cannot_be_recorded_is_refused(fall: tuple[ds.Simulator, ds.State], tmp_path: Path) -> None:
    sim, trajectory = fall
    batch = trajectory._map(lambda t: t[:, None].expand(-1, 2, *t.shape[1:]))
    with pytest.raises(ValueError, match=r"record: trajectory must have one leading axis, time, got \(20, 2\)"):
        ds.viewer.record(sim, batch, tmp_path / "a.html")
    with pytest.raises(ValueError, match=r"path must end in one of \.html, .*, got 'a\.avi'"):
        ds.viewer.record(sim, trajectory, "a.avi")
    with pytest.raises(ValueError, match=r"trajectory has no states"):
        ds.viewer.record(sim, trajectory[:0], tmp_path / "a.html")
    with pytest.raises(ValueError, match=r"colors: no object is named 'bxo'; there are box, ball, block, sheet"):
        ds.viewer.record(sim, trajectory, tmp_path / "a.html", colors={"bxo": (1, 0, 0)})
    with pytest.raises(ValueError, match=r"colors: 'box' must have red, green and blue from 0 to 1"):
        ds.viewer.record(sim, trajectory, tmp_path / "a.html", colors={"box": (255, 0, 0)})
    with pytest.raises(ValueError, match=r"record: speed must be positive"):
        ds.viewer.record(sim, trajectory, tmp_path / "a.html", speed=0.0)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("package", "file", "extra"),
    [
        ("k3d", "a.html", "viewer"),
        ("rerun", "a.rrd", "rerun"),
        ("imageio_ffmpeg", "a.mp4", "viewer"),
        ("matplotlib", "a.webp", "viewer"),
    ],
)
def test_a_missing_package_is_named_with_the_command_that_mends_it(
    package: str,
    file: str,
    extra: str,
    fall: tuple[ds.Simulator, ds.State],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Absent:
        @staticmethod
        def find_spec(name: str, *_: Any) -> None:
            if name == package:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    sim, trajectory = fall
    for loaded in [name for name in sys.modules if name.partition(".")[0] == package]:
        monkeypatch.delitem(sys.modules, loaded)
    monkeypatch.setattr(sys, "meta_path", [Absent, *sys.meta_path])
    mend = rf"needs {package}, which is not installed: pip install 'mesh-diffsim\[{extra}\]'"
    with pytest.raises(ModuleNotFoundError, match=mend):
        ds.viewer.record(sim, trajectory, tmp_path / file)
    assert not list(tmp_path.iterdir())
    if package in ("k3d", "matplotlib"):
        with pytest.raises(ModuleNotFoundError, match=mend):
            ds.viewer.show(sim, trajectory) if package == "k3d" else ds.viewer.picture(sim, trajectory)


@BROWSER
def test_page_plays_without_network(fall: tuple[ds.Simulator, ds.State], tmp_path: Path) -> None:
    pytest.importorskip("k3d", reason="pip install 'mesh-diffsim[viewer]'")
    sim, trajectory = fall
    page = ds.viewer.record(sim, trajectory, tmp_path / "fall.html", colors={"box": (1.0, 0.0, 0.0)})
    assert page.stat().st_size < 2_000_000
    pictures, controls = shots(page, (0.0, 0.36))
    assert "time" in controls and "Play loop" in controls
    rows = [np.argwhere((p[..., 0] > 2 * p[..., 1]) & (p[..., 0] > 60))[:, 0] for p in pictures]  # of the red box
    assert min(len(r) for r in rows) > 100
    assert np.mean(rows[1]) > np.mean(rows[0]) + 20  # it fell


@BROWSER
def test_page_shows_contact_forces(fall: tuple[ds.Simulator, ds.State], tmp_path: Path) -> None:
    pytest.importorskip("k3d", reason="pip install 'mesh-diffsim[viewer]'")
    sim, trajectory = fall
    page = ds.viewer.record(sim, trajectory, tmp_path / "fall.html", contacts=True)
    pictures, _ = shots(page, (0.0, 0.36))  # in the air, and on the ground
    crimson = [((p[..., 0] > 2 * p[..., 1]) & (p[..., 0] > p[..., 2] + 30)).sum() for p in pictures]
    assert crimson[0] == 0
    assert crimson[1] > 30


def shots(page_path: Path, times: tuple[float, ...]) -> tuple[list[np.ndarray], str]:
    """What a page shows at these times, and the text of its controls; fails if it asks the network for anything."""
    playwright = pytest.importorskip("playwright.sync_api", reason="pip install playwright")
    asked: list[str] = []
    wrong: list[str] = []
    with playwright.sync_playwright() as p:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        browser = p.chromium.launch(executable_path=CHROMIUM, args=flags)
        page = browser.new_page(viewport={"width": 640, "height": 480})
        page.on("request", lambda request: asked.append(request.url))
        page.on("pageerror", lambda error: wrong.append(str(error)))
        page.goto(page_path.as_uri())
        page.wait_for_function("K3DInstance && 'then' in K3DInstance")
        pictures = []
        for time in times:
            # Three frames of the browser: one may be on its way when the time is set.
            page.evaluate(
                """(time) => K3DInstance.then((plot) => { plot.stopAutoPlay(); return plot.setTime(time); })
                .then(() => new Promise((done) => { let left = 3; const next = () => left-- ?
                requestAnimationFrame(next) : done(); next(); }))""",
                time,
            )
            shot = page.screenshot(clip={"x": 0, "y": 0, "width": 420, "height": 480})  # without the controls
            pictures.append(pixels(shot))
        controls = page.inner_text("body")
        browser.close()
    assert not wrong
    assert [url for url in asked if not url.startswith(("file:", "blob:", "data:"))] == []
    return pictures, controls


def pixels(png: bytes) -> np.ndarray:
    image = pytest.importorskip("PIL.Image", reason="pip install 'mesh-diffsim[viewer]'")
    return np.asarray(image.open(io.BytesIO(png)).convert("RGB")).astype(int)


def gltf(path: Path) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The document of a .glb file, and its accessors."""
    raw = path.read_bytes()
    magic, version, size, length, kind = struct.unpack("<IIIII", raw[:20])
    assert (magic, version, size, kind) == (0x46546C67, 2, len(raw), 0x4E4F534A)
    document, data = json.loads(raw[20 : 20 + length]), raw[28 + length :]
    arrays = []
    for accessor in document["accessors"]:
        view = document["bufferViews"][accessor["bufferView"]]
        values = np.frombuffer(
            data[view["byteOffset"] : view["byteOffset"] + view["byteLength"]],
            np.uint32 if accessor["componentType"] == 5125 else np.float32,
        )
        arrays.append(values.reshape(accessor["count"], {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]))
    return document, arrays


def test_gltf_moves_as_the_simulation(fall: tuple[ds.Simulator, ds.State], tmp_path: Path) -> None:
    sim, trajectory = fall
    path = ds.viewer.record(sim, trajectory, tmp_path / "fall.glb", fps=25)
    document, arrays = gltf(path)
    nodes = {node["name"]: index for index, node in enumerate(document["nodes"])}
    (animation,) = document["animations"]
    samplers = animation["samplers"]
    tracks = {(c["target"]["node"], c["target"]["path"]): samplers[c["sampler"]] for c in animation["channels"]}
    shown = [*range(0, 19, 2), 19]
    track = tracks[nodes["box"], "translation"]
    np.testing.assert_allclose(arrays[track["output"]], trajectory.position[shown, 0], atol=1e-6)
    np.testing.assert_allclose(arrays[track["input"]][:, 0], sim.dt * np.array(shown), atol=1e-6)
    turns = arrays[tracks[nodes["box"], "rotation"]["output"]][:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs((turns * trajectory.orientation[shown, 0].numpy()).sum(1)), 1.0, atol=1e-6)

    (primitive,) = document["meshes"][document["nodes"][nodes["sheet"]]["mesh"]]["primitives"]
    weights = arrays[tracks[nodes["sheet"], "weights"]["output"]].reshape(len(shown), -1)
    targets = np.stack([arrays[target["POSITION"]] for target in primitive["targets"]])
    nodes_shown = arrays[primitive["attributes"]["POSITION"]] + np.tensordot(weights, targets, axes=1)
    np.testing.assert_allclose(nodes_shown, trajectory.node_position[shown], atol=1e-6)


def test_gltf_is_read_by_trimesh(fall: tuple[ds.Simulator, ds.State], tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh")
    sim, trajectory = fall
    loaded = trimesh.load(ds.viewer.record(sim, trajectory, tmp_path / "fall.glb"), force="scene")
    assert set(loaded.geometry) == {"box", "ball", "block", "sheet", "ground"}
    box = loaded.geometry["box"].copy()
    box.apply_transform(loaded.graph["box"][0])
    # y points up there.
    expected = sim.mesh(trajectory[0], 0).bounds[:, [0, 2, 1]] * [1, 1, -1]
    np.testing.assert_allclose(box.bounds, np.sort(expected, axis=0), atol=1e-5)


def test_rerun_recording_has_every_object(fall: tuple[ds.Simulator, ds.State], tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="pip install 'mesh-diffsim[rerun]'")
    sim, trajectory = fall
    raw = ds.viewer.record(sim, trajectory, tmp_path / "fall.rrd").read_bytes()
    assert raw[:4] == b"RRF2"
    for name in (b"world/box", b"world/ball", b"world/block", b"world/sheet", b"world/ground"):
        assert name in raw


@pytest.mark.parametrize("suffix", [".gif", ".webp"])
def test_moving_picture_moves(fall: tuple[ds.Simulator, ds.State], tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("matplotlib", reason="pip install 'mesh-diffsim[viewer]'")
    image = pytest.importorskip("PIL.Image", reason="pip install 'mesh-diffsim[viewer]'")
    sim, trajectory = fall
    path = ds.viewer.record(
        sim, trajectory, tmp_path / f"fall{suffix}", fps=10, size=(160, 120), colors={"box": (1.0, 0.0, 0.0)}
    )
    film = image.open(path)
    assert film.n_frames == 5  # at 0, 0.1 … 0.38 s
    assert film.size == (160, 120)
    heights = []
    for index in (0, film.n_frames - 1):
        film.seek(index)
        frame = np.asarray(film.convert("RGB")).astype(int)
        heights.append(np.argwhere(frame[..., 0] > 3 * frame[..., 1] + 30)[:, 0].mean())
    assert heights[1] > heights[0] + 5  # rows count downwards


def test_film_has_every_frame(fall: tuple[ds.Simulator, ds.State], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="pip install 'mesh-diffsim[viewer]'")
    ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="pip install 'mesh-diffsim[viewer]'")
    sim, trajectory = fall
    path = ds.viewer.record(sim, trajectory, tmp_path / "new" / "fall.mp4", speed=0.5, fps=10, size=(161, 120))
    frames, seconds = ffmpeg.count_frames_and_secs(str(path))
    assert frames == 9
    assert seconds == pytest.approx(0.9, abs=0.11)


def test_picture_shows_each_moment(fall: tuple[ds.Simulator, ds.State], tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="pip install 'mesh-diffsim[viewer]'")
    sim, trajectory = fall
    slopes = []
    for times in ([0.38], [0.0, 0.38]):
        figure = ds.viewer.picture(sim, trajectory, tmp_path / "fall.png", times=times, colors={"box": (1.0, 0.0, 0.0)})
        assert len(figure.axes) == 1
        shot = pixels((tmp_path / "fall.png").read_bytes())
        red = np.argwhere((shot[..., 0] > 1.2 * shot[..., 1]) & (shot[..., 0] > 60))
        assert len(red) > 500
        slopes.append(np.divide(*np.ptp(red, axis=0)))
    assert slopes[1] > 1.3 * slopes[0]  # a second box above it


def test_picture_shows_float32_states(fall: tuple[ds.Simulator, ds.State]) -> None:
    pytest.importorskip("matplotlib", reason="pip install 'mesh-diffsim[viewer]'")
    sim, trajectory = fall
    figure = ds.viewer.picture(sim, trajectory[-1].to(torch.float32))
    assert len(figure.axes[0].collections) == 5  # four shadows, and what casts them
    assert pixels(figure._repr_png_()).std() > 10  # as notebooks show it


# ---- contact forces --------------------------------------------------------------------------------------------------

STEPS, MASS, GRAVITY = 5, 2.0, 9.81


@pytest.fixture(scope="module")
def pushed() -> tuple[ds.Simulator, ds.State, ds.Control]:
    """Two boxes on each other and on a static one; the upper one is pushed down, harder in every step."""
    scene = ds.Scene()
    for name, height, mass in (("table", 0.0, None), ("lower", 0.201, MASS), ("upper", 0.402, MASS)):
        kind = "static" if mass is None else "dynamic"
        scene.add_body(ds.shapes.box(0.2), mass=mass, kind=kind, position=(0.0, 0.0, height), name=name)
    sim = ds.Simulator(scene, dt=0.01)
    rest = sim.rollout(sim.initial_state(), steps=50)[-1]
    force = torch.zeros(STEPS, 3, 3, dtype=torch.float64)
    force[:, 2, 2] = -10.0 * torch.arange(STEPS)
    controls = ds.Control(force=force)
    return sim, sim.rollout(rest, controls, STEPS), controls


def record_forces(pushed: Any, frames: list[int], controls: Any, scale: float | None = 1.0) -> list[Any]:
    sim, trajectory, _ = pushed
    recording = make_recording("test", sim, trajectory, frames)
    arrows = with_forces("test", recording, sim, trajectory, np.array(frames), controls, scale).arrows
    assert arrows is not None
    return arrows


def test_arrows_are_the_forces_of_the_step_that_ended_there(pushed: tuple[ds.Simulator, ds.State, ds.Control]) -> None:
    sim, _, controls = pushed
    before = sim.info
    frames = [0, 1, 4]
    for given in (controls, list(controls), list(controls)[1:]):
        for frame, arrows in zip(frames, record_forces(pushed, frames, given), strict=True):
            push = 10.0 * max(frame, 1)  # of the first state's own step nothing is known
            weight = 2.0 * MASS * GRAVITY + push  # from the table on the lower box; no arrow on the table
            np.testing.assert_allclose(arrows.vectors.sum(axis=0), [0.0, 0.0, weight], atol=1e-2 * weight)
            between = MASS * GRAVITY + push  # on both boxes
            lengths = np.linalg.norm(arrows.vectors, axis=1).sum()
            np.testing.assert_allclose(lengths, weight + 2.0 * between, rtol=1e-2)
            assert np.isclose(arrows.starts[:, 2], 0.1, atol=1e-2).any()
    assert sim.info is before
    held = record_forces(pushed, [4], controls[4])
    np.testing.assert_allclose(held[0].vectors, record_forces(pushed, [4], controls)[0].vectors)


def test_arrows_fit_the_scene_where_nobody_says_how_long(pushed: tuple[ds.Simulator, ds.State, ds.Control]) -> None:
    sim, trajectory, controls = pushed
    size = make_recording("test", sim, trajectory).size
    lengths = [np.linalg.norm(a.vectors, axis=1).max() for a in record_forces(pushed, [0, 2, 4], controls, None)]
    assert 0.1 * size < max(lengths) <= 0.5 * size


def test_controls_that_do_not_fit_the_states_are_refused(pushed: tuple[ds.Simulator, ds.State, ds.Control]) -> None:
    sim, trajectory, controls = pushed
    with pytest.raises(ValueError, match=r"record: controls must have an entry for each of the 5 states.*got 3"):
        ds.viewer.record(sim, trajectory, "a.glb", contacts=True, controls=controls[:3])
    with pytest.raises(ValueError, match=r"picture: force_scale must be positive"):
        ds.viewer.picture(sim, trajectory, contacts=True, force_scale=0.0)


def test_gltf_has_an_arrow_for_every_force(pushed: tuple[ds.Simulator, ds.State, ds.Control], tmp_path: Path) -> None:
    sim, trajectory, controls = pushed
    path = ds.viewer.record(
        sim, trajectory, tmp_path / "a.glb", fps=100, contacts=True, controls=controls, force_scale=1e-2
    )
    document, arrays = gltf(path)
    (animation,) = document["animations"]
    total = np.zeros((STEPS, 3))
    for index, node in enumerate(document["nodes"]):
        if node["name"].startswith("contact force"):
            tracks = {
                c["target"]["path"]: animation["samplers"][c["sampler"]]
                for c in animation["channels"]
                if c["target"]["node"] == index
            }
            assert {track["interpolation"] for track in tracks.values()} == {"STEP"}
            turns, sizes = (arrays[tracks[name]["output"]] for name in ("rotation", "scale"))
            matrices = ds.rotation.to_matrix(torch.from_numpy(turns[:, [3, 0, 1, 2]].astype(np.float64))).numpy()
            total += matrices[:, :, 2] * sizes[:, 2:]
    weights = 2.0 * MASS * GRAVITY + 10.0 * np.array([1, 1, 2, 3, 4])
    np.testing.assert_allclose(total[:, 2], 1e-2 * weights, rtol=1e-2)
    assert all(material["alphaMode"] == "BLEND" for material in document["materials"][:-1])  # the last is the arrows'


def test_rerun_recording_has_contact_forces(pushed: tuple[ds.Simulator, ds.State, ds.Control], tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="pip install 'mesh-diffsim[rerun]'")
    sim, trajectory, controls = pushed
    raw = ds.viewer.record(sim, trajectory, tmp_path / "a.rrd", contacts=True, controls=controls).read_bytes()
    assert b"world/contact_forces" in raw


def test_pictures_and_films_show_contact_forces(
    pushed: tuple[ds.Simulator, ds.State, ds.Control], tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib", reason="pip install 'mesh-diffsim[viewer]'")
    image = pytest.importorskip("PIL.Image", reason="pip install 'mesh-diffsim[viewer]'")
    sim, trajectory, controls = pushed

    def crimson(shot: np.ndarray) -> int:
        return int(((shot[..., 0] > 2 * shot[..., 1]) & (shot[..., 0] > 100) & (shot[..., 2] > shot[..., 1])).sum())

    for contacts in (False, True):
        path = tmp_path / "a.webp"
        ds.viewer.record(sim, trajectory, path, size=(320, 240), contacts=contacts, controls=controls)
        assert (crimson(np.asarray(image.open(path).convert("RGB")).astype(int)) > 10) == contacts
        figure = ds.viewer.picture(sim, trajectory, count=2, contacts=contacts, controls=controls)
        assert (crimson(pixels(figure._repr_png_())) > 50) == contacts
