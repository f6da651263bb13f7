"""What the examples share: figures to put into scenes, an independent judge of penetration, results and pictures."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray

import diffsim as ds

FloatArray = NDArray[np.float64]


def needed(package: str, extra: str = "examples") -> Any:
    """The package; where it is missing, the program ends with a line that says how to get it."""
    try:
        return importlib.import_module(package)
    except ModuleNotFoundError as error:
        raise SystemExit(f'{error.name} is not installed: pip install "mesh-diffsim[{extra}]"') from None


def present(package: str, extra: str, otherwise: str) -> bool:
    """Whether a package is there; where it is missing, it is said what is left out, and how to get it."""
    if importlib.util.find_spec(package) is not None:
        return True
    print(f'{package} is not installed (pip install "mesh-diffsim[{extra}]"): {otherwise} is left out')
    return False


ipctk, pymeshfix = needed("ipctk"), needed("pymeshfix")


# ---- meshes ----------------------------------------------------------------------------------------------------------


def repaired(mesh: Any) -> Any:
    """The mesh, closed."""
    fixed = pymeshfix.MeshFix(mesh.vertices, mesh.faces)
    fixed.repair()
    return trimesh.Trimesh(fixed.points, fixed.faces)


def load_figure(path: str | None, faces: int, size: float) -> Any:
    """The mesh in a file, or the Stanford bunny: closed, decimated to `faces`, centred, its longest side `size` [m]."""
    if path is None:
        package = importlib.util.find_spec("pymeshfix")
        assert package is not None and package.origin is not None
        path = str(Path(package.origin).parent / "examples" / "StanfordBunny.ply")
    mesh: Any = repaired(trimesh.load(path, force="mesh"))
    if len(mesh.faces) > faces:
        mesh = repaired(mesh.simplify_quadric_decimation(face_count=faces))  # which may open it
    if not mesh.is_watertight:
        raise ValueError(f"{path}: the decimated mesh is not closed")
    mesh.apply_translation(-mesh.center_mass)
    mesh.apply_scale(size / mesh.extents.max())
    return mesh


# ---- programs --------------------------------------------------------------------------------------------------------


def make_parser(description: str | None, quick: str, seed: str) -> argparse.ArgumentParser:
    """What every example can be told. `quick`: what it then does; `seed`: what that changes."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help=f"{seed} (default: %(default)s)")
    parser.add_argument("--quick", action="store_true", help=quick)
    parser.add_argument("--out", type=Path, default=Path("out"), help="folder for the results (default: %(default)s)")
    parser.add_argument("--no-picture", action="store_true", help="write neither the picture nor the result")
    return parser


def shift(seed: int, size: float) -> float:
    """A change of a start, at most so large, for an example in which nothing is random; none for seed 0."""
    return float(np.random.default_rng(seed).uniform(-size, size)) if seed else 0.0


# ---- checks ----------------------------------------------------------------------------------------------------------


def report(results: Iterable[tuple[str, bool]]) -> bool:
    """Print what must hold and whether it does."""
    passed = True
    for text, holds in results:
        print(f"{'ok  ' if holds else 'FAIL'}  {text}")
        passed = passed and holds
    return passed


def weight_errors(
    sim: ds.Simulator,
    states: Sequence[ds.State],
    drives: Mapping[int, ds.Control],
    masses: Mapping[int, float],
    gravity: float = 9.81,
) -> dict[int, float]:
    """Of bodies over some steps: the impulse of their contacts less that of gravity less the momentum they gained, over
    their weight's impulse.

    Args:
        sim: What stepped the states.
        states: All of them.
        drives: What drove steps that follow each other, by the number of the state they were taken from.
        masses: Of those bodies [kg]; not the simulator's, which is what is judged.
        gravity: Downwards [m/s²]; likewise.
    """
    first, last = min(drives), max(drives) + 1
    impulse = torch.zeros(len(sim.body_names), 3, dtype=torch.float64)
    for step, control in drives.items():
        impulse += sim.dt * sim.contacts(states[step], control).net_force()
    errors = {}
    for body, mass in masses.items():
        weight = torch.tensor([0.0, 0.0, mass * gravity * sim.dt * len(drives)], dtype=torch.float64)
        gained = mass * (states[last].velocity[body] - states[first].velocity[body])
        errors[body] = float((impulse[body] - weight - gained).norm() / weight.norm())
    return errors


class Judge:
    """Does anything intersect? By ipctk on the bare meshes, and numpy for spheres and the ground."""

    def __init__(self, scene: ds.Scene, sim: ds.Simulator) -> None:
        p = self._packed = scene.pack(sim.thickness)
        self._sim = sim
        names = [*p.names, *p.cloth_names]
        vertex_ends = np.cumsum([*p.vertex_count, *p.node_count])
        self.names = names
        self._vertices = [slice(end - n, end) for end, n in zip(vertex_ends, [*p.vertex_count, *p.node_count])]
        body_faces = np.split(p.faces, np.cumsum(p.face_count)[:-1]) if len(p.face_count) else []
        cloth_faces = np.split(p.triangles, np.cumsum(p.triangle_count)[:-1]) if len(p.triangle_count) else []
        # Faces of bodies count from the body's first vertex, triangles of cloths from the cloth's first node.
        self._faces = [f + v.start for f, v in zip([*body_faces, *cloth_faces], self._vertices)]
        faces = np.concatenate(self._faces)
        self._owner = np.repeat(np.arange(len(names)), [len(f) for f in self._faces])
        self._mesh = ipctk.CollisionMesh(np.zeros((vertex_ends[-1], 3)), ipctk.edges(faces), faces)
        self._all_faces = faces
        self._spheres = [i for i, n in enumerate(p.vertex_count) if n == 1]
        self._movable = [i for i in range(len(names)) if i >= len(p.names) or p.kind[i] == 0]

    def problems(self, state: ds.State) -> list[str]:
        """What is wrong with a state, in words; empty if all is well."""
        with torch.no_grad():
            x = self._sim.vertices(state).numpy()
        p, found = self._packed, []
        if ipctk.has_intersections(self._mesh, x):
            found.append("ipctk: surfaces cross")
        if p.has_ground:
            low = [name for name, v in zip(self.names, self._vertices) if x[v, 2].min() < p.ground_height]
            found += [f"{self.names[i]} is in the ground" for i in self._movable if self.names[i] in low]
        for i in self._spheres:
            distance = self.sphere_distance(i, state)
            # The margin is the radius; with the thickness of what it touches there is more room than this.
            if distance < 0.0:
                found.append(f"{self.names[i]} is {-distance:g} m deep in a surface")
        return found

    def count(self, states: Iterable[ds.State]) -> list[str]:
        """The problems of all states, each with its step."""
        return [f"{problem}, step {step}" for step, state in enumerate(states, 1) for problem in self.problems(state)]

    def sphere_distance(self, sphere: int, state: ds.State) -> float:
        """From the surface of a sphere to the nearest bare triangle [m]."""
        with torch.no_grad():
            x = self._sim.vertices(state).numpy()
        triangles = x[self._all_faces]
        centre = x[self._vertices[sphere]][0]
        return float(point_triangle_distance(centre, triangles).min() - self._packed.margin[sphere])


def point_triangle_distance(point: FloatArray, triangles: FloatArray) -> FloatArray:
    """Distance of one point from each triangle, shapes (3,) and (n, 3, 3) [m]."""
    a, b, c = triangles.transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    inside = np.min([(np.cross(q - p, point - p) * normal).sum(1) for p, q in ((a, b), (b, c), (c, a))], axis=0) >= 0.0
    to_edges = []
    for p, q in ((a, b), (b, c), (c, a)):
        along = np.clip(((point - p) * (q - p)).sum(1) / ((q - p) ** 2).sum(1), 0.0, 1.0)
        to_edges.append(np.linalg.norm(p + along[:, None] * (q - p) - point, axis=1))
    return np.asarray(np.where(inside, np.abs(((point - a) * normal).sum(1)), np.min(to_edges, axis=0)))


# ---- results and pictures --------------------------------------------------------------------------------------------


def save_results(path: Path, results: Mapping[str, Any]) -> None:
    """Write what was found, as JSON: a line for each name. Arrays and tensors become lists."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write = json.JSONEncoder(ensure_ascii=False, default=lambda array: array.tolist()).encode
    lines = (f" {write(name)}: {write(value)}" for name, value in results.items())
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n", encoding="utf-8")
    print(f"result: {path}")


def draw_band(axes: Any, x: Any, values: Any, color: str, log: bool = True, **line: Any) -> None:
    """Mean over seeds, the rows of `values`, and one standard deviation to both sides; where the axis is logarithmic,
    down to a fifth of the mean at most.
    """
    mean, deviation = np.mean(values, axis=0), np.std(values, axis=0)
    low = np.maximum(mean - deviation, 0.2 * mean) if log else mean - deviation
    axes.plot(x, mean, color=color, **line)
    axes.fill_between(x, low, mean + deviation, color=color, alpha=0.2, lw=0.0)


def continued(rows: Sequence[Sequence[float]]) -> FloatArray:
    """Searches of different lengths as one array: who has arrived stays there."""
    longest = max(map(len, rows))
    return np.array([[*row, *[row[-1]] * (longest - len(row))] for row in rows])


def of_seeds(name: str, count: int) -> str:
    """The label of a curve."""
    return f"{name}, {count} seeds" if count > 1 else f"{name}, one seed"


def save_figure(path: Path, draw: Callable[[Any], None], **layout: Any) -> None:
    """Make a figure, let `draw(figure)` fill it, write it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure = plt.figure(layout="constrained", **layout)
    draw(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110, bbox_inches="tight", pad_inches=0.08)
    plt.close(figure)
    print(f"picture: {path}")
