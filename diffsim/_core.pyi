"""The C++ core of diffsim. Not a public interface: use the diffsim package.

Written by hand after pybind11-stubgen; tests/python/test_stub.py compares it with the compiled module. Arrays are
C-contiguous: another layout or dtype is a TypeError, not a copy.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

class Model:
    """Bodies, cloths, their collision meshes and the ground."""

    def __init__(
        self,
        *,
        names: Sequence[str],
        kind: NDArray[np.int32],
        margin: NDArray[np.float64],
        vertex_count: NDArray[np.int32],
        vertices: NDArray[np.float64],
        face_count: NDArray[np.int32],
        faces: NDArray[np.int32],
        has_ground: bool,
        ground_height: float,
        ground_margin: float | None,
        thickness: NDArray[np.float64],
        cloth_names: Sequence[str],
        cloth_margin: NDArray[np.float64],
        cloth_poisson: NDArray[np.float64],
        node_count: NDArray[np.int32],
        triangle_count: NDArray[np.int32],
        triangles: NDArray[np.int32],
        node_rest: NDArray[np.float64],
        warp: NDArray[np.float64],
        pinned: NDArray[np.uint8],
    ) -> None: ...
    @property
    def names(self) -> list[str]: ...
    @property
    def body_count(self) -> int: ...
    @property
    def cloth_count(self) -> int: ...
    @property
    def node_count(self) -> int: ...
    def hinges(
        self,
    ) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]: ...

class Options:
    """How steps are taken."""

    def __init__(
        self,
        *,
        dt: float,
        compliance: float = 0.0001,
        adjoint: str = "exact",
        tolerance: float = 1e-10,
        max_iterations: int = 200,
        coupling: str = "monolithic",
        zones: str = "local",
        newton_iterations: int | None = None,
        integrator: str = "implicit_euler",
    ) -> None: ...
    dt: float
    compliance: float
    adjoint: str
    tolerance: float
    max_iterations: int
    coupling: str
    zones: str
    @property
    def newton_iterations(self) -> int | None: ...
    integrator: str

class Input:
    """A line of the table of inputs."""

    @property
    def label(self) -> str: ...
    @property
    def name(self) -> str: ...
    @property
    def kind(self) -> str: ...
    @property
    def axis(self) -> str: ...
    @property
    def row_shape(self) -> tuple[int, ...]: ...
    @property
    def unit(self) -> str: ...
    @property
    def allowed(self) -> str: ...

def inputs() -> list[Input]: ...

class Tape:
    """What the backward of a rollout needs."""

    @property
    def nbytes(self) -> int: ...

class GradientFault(RuntimeError): ...  # of a backward; its args are scene, step, gradients, objects, nodes

class Info:
    """Statistics of a rollout; counts are those of its last step."""

    @property
    def converged(self) -> bool: ...
    @property
    def failed_steps(self) -> int: ...
    @property
    def refined_steps(self) -> int: ...
    @property
    def fast_impacts(self) -> int: ...
    @property
    def failure(self) -> str: ...
    @property
    def failures(self) -> list[tuple[int, int, list[int], str, str, int, float]]: ...
    @property
    def scenes_converged(self) -> NDArray[np.bool]: ...
    @property
    def contacts(self) -> int: ...
    @property
    def sticking(self) -> int: ...
    @property
    def slipping(self) -> int: ...
    @property
    def zones(self) -> int: ...
    @property
    def largest_zone(self) -> int: ...
    @property
    def iterations(self) -> int: ...
    @property
    def residual(self) -> float: ...
    @property
    def max_compression(self) -> float: ...
    @property
    def milliseconds(self) -> dict[str, float]: ...

class Rollout:
    """Trajectory, tape and statistics."""

    @property
    def trajectory(self) -> tuple[NDArray[np.float64] | None, ...]: ...
    @property
    def tape(self) -> Tape | None: ...
    @property
    def info(self) -> Info: ...
    @property
    def signature(self) -> NDArray[np.uint64]: ...

def rollout(
    model: Model,
    options: Options,
    inputs: list[NDArray[np.float64] | None],
    *,
    steps: int,
    controls_have_time: bool,
    keep_time: bool,
    record: bool,
    num_threads: int,
    first_step: int,
) -> Rollout: ...
def rollout_backward(
    tape: Tape,
    inputs: list[NDArray[np.float64] | None],
    upstream: list[NDArray[np.float64] | None],
    *,
    needs: Sequence[bool],
    num_threads: int,
    limit: float,
) -> tuple[NDArray[np.float64] | None, ...]: ...
def contact_systems(
    tape: Tape, inputs: list[NDArray[np.float64] | None]
) -> tuple[
    tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]], ...
]: ...
def contacts(tape: Tape, inputs: list[NDArray[np.float64] | None]) -> dict[str, NDArray[Any]]: ...
def separate(
    model: Model,
    options: Options,
    position: NDArray[np.float64],
    orientation: NDArray[np.float64],
    node_position: NDArray[np.float64],
    parameters: list[NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64], float]: ...
def min_distance(
    model: Model, position: NDArray[np.float64], orientation: NDArray[np.float64], node_position: NDArray[np.float64]
) -> tuple[float, int, int]: ...
def vertex_polygon_ccd(
    vertex: NDArray[np.float64],
    polygon0: NDArray[np.float64],
    polygon1: NDArray[np.float64],
    min_distance: float,
    tolerance: float,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]: ...
def edge_edge_ccd(
    a0: NDArray[np.float64],
    a1: NDArray[np.float64],
    b0: NDArray[np.float64],
    b1: NDArray[np.float64],
    min_distance: float,
    tolerance: float,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]: ...
