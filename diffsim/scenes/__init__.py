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
from .heaps import boxes_in_bin, collapsing_stack, heap_of_boxes_and_balls, touching_boxes, tumbling_layers
from .masonry import arch
from .piles import falling_cubes, row_of_cubes, two_layer_stack

__all__ = [
    "arch",
    "box_on_box",
    "boxes_in_bin",
    "collapsing_stack",
    "falling_cubes",
    "heap_of_boxes_and_balls",
    "kinematic_pusher",
    "nonconvex_pair",
    "resting_box",
    "row_of_cubes",
    "tetrahedron_in_groove",
    "tetrahedron_on_box",
    "tilted_box",
    "touching_boxes",
    "tumbling_layers",
    "two_layer_stack",
    "two_spheres",
]
