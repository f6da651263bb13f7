"""Mass, centre of mass and inertia of solids: exact integrals over closed meshes, closed forms for round bodies."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int32]

_ROUNDING = 16.0 * np.finfo(np.float64).eps  # relative, of sums over faces


class MassProperties(NamedTuple):
    """Of a solid of density 1 kg/m³; all three scale linearly with the density."""

    mass: float  #: the volume; negative when the faces point inwards  [m³ · 1 kg/m³]
    center: FloatArray  #: centre of mass in the mesh's frame, shape (3,)  [m]
    inertia: FloatArray  #: about the centre of mass, along the mesh's axes, shape (3, 3)  [m⁵ · 1 kg/m³]


def mesh_mass_properties(vertices: FloatArray, faces: IntArray) -> MassProperties:
    """Integrate over the volume a closed mesh encloses; exact for polyhedra, up to rounding.

    Args:
        vertices: Shape (n, 3) [m].
        faces: Shape (m, 3), closed and consistently oriented. Parts that overlap count as often as they are covered.
    Returns: The properties at unit density. The centre is that of the vertices when the volume is exactly zero.
    """
    # Each face (a, b, c) spans with the origin a tetrahedron of signed volume V = a·(b × c) / 6. With barycentric
    # weights w_i of (origin, a, b, c), ∫ w_i dV = V/4 and ∫ w_i w_j dV = V (1 + δ_ij) / 20, hence
    #   ∫ x dV = V/4 (a + b + c),   ∫ x xᵀ dV = V/20 (a aᵀ + b bᵀ + c cᵀ + s sᵀ)   with s = a + b + c.
    # The origin is moved to the middle of the vertices first: far from it the sums would cancel.
    origin = vertices.mean(axis=0)
    corners = (vertices - origin)[faces]
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    sums = corners.sum(axis=1)
    volume = float(volumes.sum())
    if volume == 0.0:
        return MassProperties(0.0, origin, np.zeros((3, 3)))
    center = volumes @ sums / (4.0 * volume)
    second = (
        np.einsum("f,fki,fkj->ij", volumes, corners, corners) + np.einsum("f,fi,fj->ij", volumes, sums, sums)
    ) / 20.0
    second -= volume * np.outer(center, center)  # parallel axes: about the centre of mass
    inertia = np.trace(second) * np.eye(3) - second
    inertia = 0.5 * (inertia + inertia.T)
    # What symmetry makes zero comes out as rounding. Zero it is: so a body is exactly where it was put.
    center = origin + center
    center[np.abs(center) < _ROUNDING * np.abs(vertices).max()] = 0.0
    inertia[np.abs(inertia) < _ROUNDING * np.abs(inertia).max()] = 0.0
    return MassProperties(volume, center, inertia)


def sphere_mass_properties(radius: float) -> MassProperties:
    """A solid sphere about its centre."""
    mass = 4.0 / 3.0 * math.pi * radius**3
    return MassProperties(mass, np.zeros(3), 0.4 * mass * radius**2 * np.eye(3))


def capsule_mass_properties(radius: float, length: float) -> MassProperties:
    """A solid capsule about its centre: a cylinder of `length` along z with two half-spheres of `radius`."""
    cylinder = math.pi * radius**2 * length
    sphere = 4.0 / 3.0 * math.pi * radius**3  # the two halves together
    along = 0.5 * cylinder * radius**2 + 0.4 * sphere * radius**2
    # A half-sphere of mass m has 83/320 m r² about a transverse axis through its own centre of mass, which lies 3/8 r
    # beyond the end of the cylinder; 83/320 + (3/8)² = 2/5.
    across = cylinder * (length**2 / 12.0 + radius**2 / 4.0) + sphere * (
        0.4 * radius**2 + 0.25 * length**2 + 0.375 * radius * length
    )
    return MassProperties(cylinder + sphere, np.zeros(3), np.diag([across, across, along]))
