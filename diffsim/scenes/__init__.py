"""Scenes shared by tests, examples and benchmarks: each function returns a fresh `Scene`. SI units, z up."""

from .contact import (
    box_on_box,
    kinematic_pusher,
    nonconvex_pair,
    resting_box,
    tetrahedron_in_groove,
    tetrahedron_on_box,
    tilted_box,
    two_spheres,
)
from .piles import falling_cubes, row_of_cubes, two_layer_stack

__all__ = [
    "box_on_box",
    "falling_cubes",
    "kinematic_pusher",
    "nonconvex_pair",
    "resting_box",
    "row_of_cubes",
    "tetrahedron_in_groove",
    "tetrahedron_on_box",
    "tilted_box",
    "two_layer_stack",
    "two_spheres",
]
