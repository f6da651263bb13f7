"""Checks of what a user gives to a scene, each with an error that names the object, the field and the value."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from ._mass_properties import FloatArray
from ._mesh import to_numpy

Kind = Literal["dynamic", "static", "kinematic"]
KINDS: tuple[Kind, ...] = ("dynamic", "static", "kinematic")  #: the code of a kind in `PackedScene.kind` is its index

# Symmetry of a given inertia, relative to its largest entry: more than the rounding of any file format's decimals.
_ASYMMETRY = 1e-6


def inertia_matrix(value: Any, where: str) -> FloatArray:
    inertia = finite_array(value, f"{where}: inertia", (3, 3))
    if np.abs(inertia - inertia.T).max() > _ASYMMETRY * np.abs(inertia).max():
        raise ValueError(f"{where}: inertia must be symmetric, got {inertia.tolist()} [kg·m²]")
    inertia = np.asarray(0.5 * (inertia + inertia.T))
    lowest, _, highest = np.linalg.eigvalsh(inertia)
    if not lowest > 1e-14 * highest:
        raise ValueError(
            f"{where}: inertia must be positive definite, got {inertia.tolist()} [kg·m²] with smallest principal "
            f"moment {lowest:.3g}; leave it out to take it from the mesh"
        )
    return inertia


def body_kind(value: Any, where: str) -> Kind:
    if value not in KINDS:
        raise ValueError(f"{where}: kind must be one of {', '.join(map(repr, KINDS))}, got {value!r}")
    return value  # type: ignore[no-any-return]


def unit_quaternion(value: Any, where: str) -> FloatArray:
    q = finite_array(value, f"{where}: orientation", (4,))
    norm = float(np.linalg.norm(q))
    if norm < 1e-6:
        raise ValueError(
            f"{where}: orientation must be a quaternion (w, x, y, z) other than zero, got {q.tolist()}; no rotation is "
            "(1, 0, 0, 0)"
        )
    return np.asarray(q / norm)


def coefficient(value: Any, where: str) -> float:
    """Coulomb's coefficient of friction."""
    result = number(value, f"{where}: friction")
    if result < 0.0:
        raise ValueError(f"{where}: friction must not be negative, got {result:g}")
    return result


def unavailable_restitution(value: Any, where: str) -> float:
    """Checked as it will be, but only 0 is implemented."""
    result = number(value, f"{where}: restitution")
    if not 0.0 <= result <= 1.0:
        raise ValueError(f"{where}: restitution must lie between 0 and 1, got {result:g}")
    if result != 0.0:
        raise NotImplementedError(
            f"{where}: restitution={result:g} is not implemented yet: contact is inelastic for now; use 0"
        )
    return result


def positive(value: Any, where: str, unit: str) -> float:
    result = number(value, where)
    if not result > 0.0:
        raise ValueError(f"{where} must be positive, got {result:g} [{unit}]")
    return result


def number(value: Any, where: str) -> float:
    return float(finite_array(value, where, ()))


def finite_array(value: Any, where: str, shape: tuple[int, ...]) -> FloatArray:
    """A fresh finite float64 array of the given shape."""
    array = to_numpy(value, where)
    expected = f"shape {shape}" if shape else "a number"
    if array.dtype.kind not in "fiu":
        raise TypeError(f"{where} must be {'numbers of ' + expected if shape else expected}, got {value!r}")
    if array.shape != shape:
        raise ValueError(f"{where} must {'have ' if shape else 'be '}{expected}, got {f'shape {array.shape}'}")
    if not np.isfinite(array).all():
        raise ValueError(f"{where} must be finite, got {array.tolist()}")
    return np.array(array, dtype=np.float64)
