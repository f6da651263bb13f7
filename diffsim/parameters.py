"""Physical parameters that belong together, for ``parameters=`` of `Simulator.forward` and `Simulator.rollout`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, SupportsIndex

import torch
from torch import Tensor

from ._check import message
from ._handles import ClothHandle

if TYPE_CHECKING:
    from .simulator import Simulator

_WHERE = "scaled_density"


def scaled_density(
    sim: Simulator, factor: float | Tensor | Mapping[SupportsIndex | ClothHandle, float | Tensor]
) -> dict[str, Tensor]:
    """The parameters of a simulator whose objects are made of a material of another density.

    Mass and inertia are parameters of their own, since a body need not be homogeneous. Who looks for one unknown, how
    heavy a body of known shape is, wants them to move together: a gradient of `mass` alone belongs to a body whose
    inertia stays, and leads to another mass wherever the body turns. ::

        factor = torch.ones((), dtype=torch.float64, requires_grad=True)
        trajectory = sim.rollout(state, steps=50, parameters=ds.parameters.scaled_density(sim, {crate: factor}))

    The mass is then ``factor * sim.mass[crate]``, so that the factor of a wanted mass is ``m / sim.mass[crate]``.

    Args:
        sim: Its `mass`, `inertia` and `cloth_density` are scaled.
        factor: By handle, or index of an object, bodies first: a positive number, or a tensor of shape () or, one value
            per scene, (B,). Objects that are not named stay as they are. Or one for all dynamic bodies: a number, or a
            tensor of shape (), (n_bodies,), (B, 1) or (B, n_bodies).
    Returns: "mass" and "inertia", and "cloth_density" if cloths are named, float64; to be merged with others as in
        ``{**ds.parameters.scaled_density(sim, factor), "gravity": g}``.
    Raises: TypeError for a factor that is no number; ValueError for one of another shape, a handle of another scene, or
        a static or kinematic body, which has no mass; IndexError for an object there is not. That factors are positive
        is checked by the step that uses them.
    Gradients: with respect to the factors and the simulator's parameters.
    """
    body_count, cloth_count = len(sim.body_names), len(sim.cloth_names)
    if not isinstance(factor, Mapping):
        factors = _tensor("factor", factor)
        if factors.ndim and (factors.ndim > 2 or factors.shape[-1] not in (1, body_count)):
            must = f"have shape (), ({body_count},), (B, 1) or (B, {body_count})"
            raise ValueError(message(_WHERE, "factor", must, tuple(factors.shape)))
        return _bodies(sim, factors if factors.ndim else factors.expand(body_count))
    one = torch.ones((), dtype=torch.float64, device="cpu")
    columns = [one] * (body_count + cloth_count)
    for handle, value in factor.items():
        index = sim._object(_WHERE, handle)
        name = f"factor of {[*sim.body_names, *sim.cloth_names][index]!r}"
        if index < body_count and sim._packed.kind[index] != 0:
            raise ValueError(f"{_WHERE}: {name} has no meaning: static and kinematic bodies have no mass")
        columns[index] = _tensor(name, value)
        if columns[index].ndim > 1:
            raise ValueError(message(_WHERE, name, "have shape () or (B,)", tuple(columns[index].shape)))
    scenes = {c.shape for c in columns if c.ndim}
    if len(scenes) > 1:
        raise ValueError(message(_WHERE, "factor", "be of one number of scenes", sorted(map(tuple, scenes))))
    result: dict[str, Tensor] = {}
    of_bodies, of_cloths = columns[:body_count], columns[body_count:]
    if any(c is not one for c in of_bodies):
        result |= _bodies(sim, _side_by_side(of_bodies))
    if any(c is not one for c in of_cloths):
        result["cloth_density"] = _side_by_side(of_cloths) * sim.cloth_density
    return result


def _tensor(name: str, value: Any) -> Tensor:
    if isinstance(value, Tensor):
        if not value.is_floating_point():
            raise TypeError(message(_WHERE, name, "be of floating point", value.dtype))
        return value.to(torch.float64)
    if isinstance(value, (bool, str)) or not hasattr(value, "__float__"):
        raise TypeError(message(_WHERE, name, "be a number or a torch.Tensor", type(value).__name__))
    return torch.tensor(float(value), dtype=torch.float64, device="cpu")


def _side_by_side(columns: list[Tensor]) -> Tensor:
    return torch.stack(torch.broadcast_tensors(*columns), dim=-1)


def _bodies(sim: Simulator, factors: Tensor) -> dict[str, Tensor]:
    return {"mass": factors * sim.mass, "inertia": factors[..., None, None] * sim.inertia}
