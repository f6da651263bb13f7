"""Differentiable simulation of triangle meshes in contact, as a PyTorch layer."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from . import diagnostics, parameters, rotation, shapes, viewer
from ._outcome import ConvergenceWarning, Failure, FastImpactWarning, GradientError, Info, SolverError
from ._units import UnitsWarning
from .contacts import Contacts
from .materials import ClothMaterial
from .scene import BodyHandle, ClothHandle, Scene
from .simulator import Simulator
from .state import Control, State

__all__ = [
    "BodyHandle",
    "ClothHandle",
    "ClothMaterial",
    "Contacts",
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
    "parameters",
    "rotation",
    "shapes",
    "viewer",
]


if TYPE_CHECKING:
    from . import interop as interop


def __getattr__(name: str) -> Any:
    if name == "interop":
        return import_module(".interop", __name__)
    if name == "__version__":
        from importlib.metadata import version

        return version("mesh-diffsim")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
