"""Sizes and densities that look like a slip of units, and cloth too small for what double precision resolves."""

from __future__ import annotations

import numpy as np

from ._packed import PackedScene

# Longest sides of what moves, from a grain of dust to a ship: a mesh in millimetres taken for metres is mostly longer.
_SMALLEST, _LARGEST = 1e-4, 100.0  # [m]
# Less than foam: 1 to 8 g/cm³ taken for kg/m³ are mostly below, as is any mass in a mesh 1000 times too large.
_LIGHTEST = 5.0  # [kg/m³]

# A sheet whose bending forces, by rounding of its positions alone, are this many times its weight does not fall: the
# free motion is below what a step resolves. A sheet of 1e-5 m at 1 m from the origin has 10 to 1000, depending on its
# triangles, one of 1e-4 m about 0.01.
_MOST_ROUNDING = 1.0
_LEAST_GRAVITY = 1.0  # what stands for it where there is none [m/s²]


class UnitsWarning(UserWarning):
    """A size or a density that looks like a slip of units: see `scale` of `Scene.add_body`. Warned once per scene."""


def size_slip(where: str, extent: float, mend: str) -> str | None:
    """What to say about something that moves and is `extent` [m] long, or None."""
    if _SMALLEST <= extent <= _LARGEST:
        return None
    what = f"{extent:.4g} m long" if extent > _LARGEST else f"only {extent:.3g} m long"
    return f"{where}: it is {what}. If that is not meant: lengths are in metres; {mend}"


def density_slip(where: str, density: float, mend: str) -> str | None:
    """What to say about a body of this mean density [kg/m³], or None."""
    if density >= _LIGHTEST:
        return None
    return (
        f"{where}: its density is {density:.3g} kg/m³. If that is not meant: densities are in kg/m³ (that of water is "
        f"1000), masses in kg, and lengths in metres; {mend}"
    )


def require_resolvable_cloth(packed: PackedScene) -> None:
    """Refuse cloth so small or stiff that rounding of its positions bends it with more force than its weight.

    A position x [m] is known to eps |x|. In triangles of area A that is an angle of about eps |x| / √A at an edge, and
    with the bending stiffness B [N·m] a force of B eps |x| / A; a node weighs about ρ g A.

    Raises: ValueError naming the cloth, the numbers, and the mend.
    """
    gravity = max(float(np.linalg.norm(packed.gravity)), _LEAST_GRAVITY)
    nodes = np.concatenate([[0], np.cumsum(packed.node_count)])
    ends = np.concatenate([[0], np.cumsum(packed.triangle_count)])
    for k, name in enumerate(packed.cloth_names):
        corners = packed.node_rest[nodes[k] : nodes[k + 1]][packed.triangles[ends[k] : ends[k + 1]]]
        sides = corners[:, 1:] - corners[:, :1]
        area = 0.5 * float(np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).mean())
        reach = float(np.abs(packed.node_position[nodes[k] : nodes[k + 1]]).max())
        rounding = np.finfo(np.float64).eps * reach * packed.cloth_bend[k] / area
        weight = packed.cloth_density[k] * gravity * area
        if rounding > _MOST_ROUNDING * weight:
            raise ValueError(
                f"cloth {name!r}: its triangles, {np.sqrt(area):.2g} m wide on average, are too small for double "
                f"precision: at {reach:.3g} m from the origin rounding alone bends them with {rounding / weight:.2g} "
                f"times their weight (bend is {packed.cloth_bend[k]:.3g} N·m). If lengths are not in metres, give "
                "scale=, the metres in a unit of the mesh; else use larger triangles, a smaller bend, or a place"
                " nearer to the origin"
            )
