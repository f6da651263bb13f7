"""Differentiable simulation of triangle meshes in contact, as a PyTorch layer."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .state import Control, State  # at once: torch.load has to know them before it meets one

if TYPE_CHECKING:
    from . import diagnostics, interop, parameters, rotation, shapes, viewer
    from ._handles import BodyHandle, ClothHandle
    from ._outcome import ConvergenceWarning, Failure, FastImpactWarning, GradientError, Info, SolverError
    from ._units import UnitsWarning
    from .contacts import Contacts
    from .materials import ClothMaterial
    from .scene import Scene
    from .simulator import Simulator

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


# Loaded when it is first asked for: modules, and by its module what else is public.
_MODULES = ("diagnostics", "interop", "parameters", "rotation", "shapes", "viewer")
_HOMES = {
    "BodyHandle": "_handles",
    "ClothHandle": "_handles",
    "ClothMaterial": "materials",
    "Contacts": "contacts",
    "ConvergenceWarning": "_outcome",
    "Failure": "_outcome",
    "FastImpactWarning": "_outcome",
    "GradientError": "_outcome",
    "Info": "_outcome",
    "Scene": "scene",
    "Simulator": "simulator",
    "SolverError": "_outcome",
    "UnitsWarning": "_units",
}


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f".{name}", __name__)
    if name in _HOMES:
        found = globals()[name] = getattr(import_module(f".{_HOMES[name]}", __name__), name)
        return found
    if name == "__version__":
        from importlib.metadata import version

        return version("mesh-diffsim")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
