"""Differentiable simulation of triangle meshes in contact, as a PyTorch layer."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from . import parameters, rotation, shapes
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
    "interop",
    "parameters",
    "rotation",
    "shapes",
    "viewer",
]


if TYPE_CHECKING:
    from . import diagnostics as diagnostics
    from . import interop as interop
    from . import viewer as viewer

_LOADED_WHEN_USED = ("diagnostics", "interop", "viewer")


def __getattr__(name: str) -> Any:
    if name in _LOADED_WHEN_USED:
        return import_module(f".{name}", __name__)
    if name == "__version__":
        from importlib.metadata import version

        return version("mesh-diffsim")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
