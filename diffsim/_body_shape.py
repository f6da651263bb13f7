"""Geometry and mass of one body, from what a user gives: the mesh or the radius, and density, mass or inertia."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ._arguments import Kind, inertia_matrix, positive
from ._mass_properties import FloatArray, IntArray, MassProperties, mesh_mass_properties
from ._mesh import edge_defects, is_flat
from ._volume import require_solid

_NO_MASS = "{where}: a dynamic body needs density= [kg/m³] or mass= [kg]; or give kind='static'"


@dataclass(frozen=True, eq=False)
class Shape:
    """Geometry in the frame of the mesh as given."""

    vertices: FloatArray
    faces: IntArray
    center: FloatArray  #: centre of mass [m]
    mass: float  #: [kg]; 0 for static and kinematic bodies, as is the inertia
    inertia: FloatArray
    closed: bool
    margin: float | None
    density: float | None = None  #: of a dynamic body, on average; None where the mesh encloses no volume  [kg/m³]


def mesh_shape(
    vertices: FloatArray, faces: IntArray, density: Any, mass: Any, inertia: Any, kind: Kind, margin: Any, where: str
) -> Shape:
    margin = None if margin is None else positive(margin, f"{where}: margin", "m")
    density, mass, inertia = _mass_arguments(density, mass, inertia, where)
    defects = edge_defects(faces)
    closed = defects.open_count == 0 and defects.misoriented_count == 0
    properties = mesh_mass_properties(vertices, faces)
    solid = closed and not is_flat(properties.mass, vertices)
    if kind != "dynamic":
        center = properties.center if solid else np.zeros(3)
        return Shape(vertices, faces, center, 0.0, np.zeros((3, 3)), closed, margin)
    if density is None and mass is None:
        raise ValueError(_NO_MASS.format(where=where))
    try:
        faces = require_solid(vertices, faces, where)
    except ValueError:
        if mass is None or inertia is None:
            raise
        return Shape(vertices, faces, np.zeros(3), mass, inertia, closed, margin)
    properties = mesh_mass_properties(vertices, faces)
    mass, inertia = _scaled(properties, density, mass, inertia)
    return Shape(vertices, faces, properties.center, mass, inertia, closed, margin, mass / properties.mass)


def round_shape(
    vertices: FloatArray,
    radius: float,
    properties: MassProperties,
    density: Any,
    mass: Any,
    inertia: Any,
    kind: Kind,
    where: str,
) -> Shape:
    density, mass, inertia = _mass_arguments(density, mass, inertia, where)
    shape = Shape(vertices, np.zeros((0, 3), dtype=np.int32), np.zeros(3), 0.0, np.zeros((3, 3)), False, radius)
    if kind != "dynamic":
        return shape
    if density is None and mass is None:
        raise ValueError(_NO_MASS.format(where=where))
    mass, inertia = _scaled(properties, density, mass, inertia)
    return replace(shape, mass=mass, inertia=inertia, density=mass / properties.mass)


def _mass_arguments(density: Any, mass: Any, inertia: Any, where: str) -> tuple[float | None, float | None, Any]:
    if density is not None and mass is not None:
        raise ValueError(f"{where}: give density= or mass=, not both, got density={density} and mass={mass}")
    density = None if density is None else positive(density, f"{where}: density", "kg/m³")
    mass = None if mass is None else positive(mass, f"{where}: mass", "kg")
    return density, mass, None if inertia is None else inertia_matrix(inertia, where)


def _scaled(
    properties: MassProperties, density: float | None, mass: float | None, inertia: FloatArray | None
) -> tuple[float, FloatArray]:
    """Mass [kg] and inertia [kg·m²] from the properties at unit density and what the user gave."""
    if mass is None:
        mass = (density or 0.0) * properties.mass
    return mass, properties.inertia * (mass / properties.mass) if inertia is None else inertia
