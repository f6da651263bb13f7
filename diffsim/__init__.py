"""Differentiable simulation of triangle meshes in contact, as a PyTorch layer."""

from typing import Any

from . import diagnostics, rotation, shapes, viewer
from ._units import UnitsWarning
from .materials import ClothMaterial
from .ops import ConvergenceWarning, Failure, FastImpactWarning, GradientError, Info, SolverError
from .scene import BodyHandle, ClothHandle, Scene
from .simulator import Simulator
from .state import Control, State

__all__ = [
    "BodyHandle",
    "ClothHandle",
    "ClothMaterial",
    "Control",
    "ConvergenceWarning",
    "Failure",
    "FastImpactWarning",
    "GradientError",
    "Info",
    "Scene",
    "Simulator",
    "SolverError",
    "State",
    "UnitsWarning",
    "diagnostics",
    "rotation",
    "shapes",
    "viewer",
]


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("mesh-diffsim")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
