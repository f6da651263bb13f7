"""The contacts of a step, and their forces, with gradients: what a tactile sensor feels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from . import rotation

if TYPE_CHECKING:
    from .state import State

__all__ = ["Contacts"]

_PARALLEL_LIMIT = 1e-3  # squared sine below which a pair of edges is mollified: kParallelLimit of the core

# Why some forces have no gradient: a hard contact's distance is always the same, and what sticks does not slip.
_HARD = "forces of hard contacts (compliance=0) have no gradient; with the default compliance they have"
_STICKING = "forces of friction have no gradient; take normal_force, or the momentum of the state itself"

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True, eq=False, repr=False)
class Contacts:
    """The k contacts that push at the end of a step, from `Simulator.contacts`.

    A face on a face has several, one per corner, or where edges cross. All in the world frame. `position`, `normal`,
    `distance` and `normal_force` are differentiable with respect to what the step is differentiable in; which contacts
    there are is not. `friction`, and with it `force`, refuses a gradient where there is some: where the step ends does
    not tell what holds a contact that sticks.
    """

    #: indices of the two objects, numbered as `Simulator.friction`: bodies, cloths, the ground; int64, shape (k, 2)
    objects: Tensor
    #: the middle between the closest points of the two meshes, shape (k, 3)  [m]
    position: Tensor
    #: unit, from the second object to the first, shape (k, 3)
    normal: Tensor
    #: between the meshes, margins not taken off, shape (k,)  [m]
    distance: Tensor
    #: on the first object, at the end of the step; the second gets the opposite, shape (k, 3)  [N]
    force: Tensor
    #: what of `force` is along `normal`, shape (k, 3)  [N]
    normal_force: Tensor
    #: what of it is across: Coulomb friction, at most μ times the other, shape (k, 3)  [N]
    friction: Tensor
    #: whether the contact has friction and does not slip; bool, shape (k,)
    sticking: Tensor
    #: index along the batch axis, 0 without one; int64, shape (k,)
    scene: Tensor
    #: after the step: what ``sim(state, control)`` returns
    end: State
    #: names of all objects, as `objects` numbers them
    object_names: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.scene)

    def names(self) -> list[tuple[str, str]]:
        """Names of the two objects of each contact; the ground's is "ground"."""
        return [(self.object_names[a], self.object_names[b]) for a, b in self.objects.tolist()]

    def net_force(self) -> Tensor:
        """Sum of the contact forces on each body, shape ([B,] n_bodies, 3) [N]. Times dt it is what contact changes of
        the body's momentum in the step. Differentiable.
        """
        return self._sum_over_bodies(self.force, -self.force)

    def net_torque(self) -> Tensor:
        """Sum of the contacts' torques on each body about its centre of mass, shape ([B,] n_bodies, 3) [N·m].
        Differentiable.
        """
        centre = self.end.position.reshape(-1, *self.end.position.shape[-2:])
        bodies = centre.shape[-2]
        on_body = []
        for side, force in enumerate((self.force, -self.force)):
            body = self.objects[:, side].clamp(max=max(bodies - 1, 0))
            arm = self.position - (centre[self.scene, body] if bodies else 0.0)
            on_body.append(torch.linalg.cross(arm, force))
        return self._sum_over_bodies(*on_body)

    def _sum_over_bodies(self, on_first: Tensor, on_second: Tensor) -> Tensor:
        shape = self.end.position.shape
        scenes, bodies = shape[:-2].numel(), shape[-2]
        total = on_first.new_zeros(scenes * bodies, 3)
        for side, values in enumerate((on_first, on_second)):
            index = self.objects[:, side]
            keep = index < bodies
            total = total.index_add(0, self.scene[keep] * bodies + index[keep], values[keep])
        return total.reshape(shape)

    def __repr__(self) -> str:
        scenes = self.end.position.shape[:-2].numel()
        batch = f" of {scenes} scenes" if scenes > 1 else ""
        return f"Contacts({len(self)} contacts{batch}, at most {self._largest():.4g} N)"

    def _largest(self) -> float:
        return float(self.force.detach().norm(dim=-1).max()) if len(self) else 0.0


def contacts_from(
    arrays: Arrays,
    end: State,
    mass: Tensor,
    cloth_density: Tensor,
    cloth_of_node: Tensor,
    object_names: tuple[str, ...],
    hard: bool,
) -> Contacts:
    """The core's arrays as differentiable tensors.

    The closest points of a contact lie on a point, a line or a plane of each object, which move with its pose or with
    its nodes: that is written here as a function of the end of the step. Along the distance and the masses the force's
    derivatives are the core's. So are all values, which are more exact than world coordinates can be.
    """
    core = {name: torch.from_numpy(value) for name, value in arrays.items()}
    first, second = (_Side(core, side, end) for side in range(2))
    # Each closest point slides so far that the offset is across the slides of both.
    directions = torch.cat([first.slides, -second.slides], dim=1).transpose(1, 2)  # (k, 3, 4)
    offset = first.point - second.point
    slid = -(torch.linalg.pinv(directions, rtol=1e-10) @ offset[:, :, None])
    offset = offset + (directions @ slid)[..., 0]
    distance = offset.norm(dim=-1)
    normal = offset / distance[:, None]
    point = first.point + (first.slides.transpose(1, 2) @ slid[:, :2])[..., 0]
    magnitude = core["force"] - core["stiffness"] * _change(distance)
    for side in range(2):
        log_mass = _mass_of_side(core, side, mass, cloth_density, cloth_of_node).log()
        magnitude = magnitude + core["force"] * core["mass_exponent"][:, side] * _change(log_mass)
    if hard:
        magnitude = _WithoutGradient.apply(magnitude, _HARD)  # type: ignore[no-untyped-call]
    magnitude = magnitude * (1.0 + _change(_log_mollifier(core["sine_sq"], first, second)))
    change_of_normal = _change(normal)
    normal = core["normal"] + change_of_normal
    normal_force = magnitude[:, None] * normal
    force, friction = normal_force, core["friction"]
    if friction.any():
        friction = _WithoutGradient.apply(friction + change_of_normal, _STICKING)  # type: ignore[no-untyped-call]
        force = normal_force + friction
    middle = core["point"].mean(dim=1) + _change(point - 0.5 * offset)
    return Contacts(
        objects=core["objects"],
        position=middle.to(end.dtype),
        normal=normal.to(end.dtype),
        distance=(core["distance"] + _change(distance)).to(end.dtype),
        force=force.to(end.dtype),
        normal_force=normal_force.to(end.dtype),
        friction=friction.to(end.dtype),
        sticking=core["sticking"].to(torch.bool),
        scene=core["scene"],
        end=end,
        object_names=object_names,
    )


class _WithoutGradient(torch.autograd.Function):
    """A force that where the step ends does not tell: its gradient is refused, with the reason."""

    @staticmethod
    def forward(ctx: Any, force: Tensor, reason: str) -> Tensor:
        ctx.reason = reason
        return force.view_as(force)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None]:
        raise NotImplementedError(f"contacts: {ctx.reason}")


def _change(value: Tensor) -> Tensor:
    """Zero, with the derivative of the value."""
    return value - value.detach()


def _mass_of_side(
    core: dict[str, Tensor], side: int, mass: Tensor, cloth_density: Tensor, cloth_of_node: Tensor
) -> Tensor:
    """Of a body its mass, of a cloth its density, 1 of what does not yield; shape (k,)."""
    scene, index, node = core["scene"], core["objects"][:, side], core["nodes"][:, side, 0]
    result = torch.ones(len(scene), dtype=torch.float64)
    yields = core["mass_exponent"][:, side] != 0.0
    for mask, values, column in (
        (yields & (node < 0), mass, index),
        (yields & (node >= 0), cloth_density, cloth_of_node[node.clamp(min=0)] if len(cloth_of_node) else node),
    ):
        if mask.any():
            row = values.to(torch.float64).reshape(-1, values.shape[-1])
            of_scene = scene[mask] if len(row) > 1 else torch.zeros_like(scene[mask])
            result = result.index_put((mask,), row[of_scene, column[mask]])
    return result


def _log_mollifier(sine_sq: Tensor, first: _Side, second: _Side) -> Tensor:
    """Of pairs of edges that are nearly parallel, 0 of others; see `edge_mollifier` of the core."""
    result = torch.zeros(len(sine_sq), dtype=torch.float64)
    mask = sine_sq < _PARALLEL_LIMIT
    if mask.any():
        a, b = first.edge[mask], second.edge[mask]
        cross = torch.linalg.cross(a, b).square().sum(dim=-1)
        ratio = cross / (a.square().sum(dim=-1) * b.square().sum(dim=-1)) / _PARALLEL_LIMIT
        result = result.index_put((mask,), (ratio * (2.0 - ratio)).log())
    return result


class _Side:
    """One object's closest points (k, 3), unit directions of their slides (k, 2, 3), zero where there are fewer, and of
    pairs of edges its edges (k, 3), which move with its bodies or nodes.
    """

    def __init__(self, core: dict[str, Tensor], side: int, end: State) -> None:
        self.point, self.edge = core["point"][:, side], core["edge"][:, side]
        used = torch.arange(2) < core["slide_count"][:, side, None]
        self.slides = core["slides"][:, side] * used[..., None]
        on_body = core["objects"][:, side] < end.position.shape[-2]
        if on_body.any():
            self._move_with_bodies(on_body, core, side, end)
        on_cloth = core["nodes"][:, side, 0] >= 0
        if on_cloth.any():
            self._move_with_nodes(on_cloth, core, side, end)

    def _move_with_bodies(self, mask: Tensor, core: dict[str, Tensor], side: int, end: State) -> None:
        where = core["scene"][mask], core["objects"][mask, side]
        position = _by_scene(end.position)[where]
        turn = rotation.to_matrix(_by_scene(end.orientation)[where])
        moved = turn @ turn.detach().transpose(-1, -2)  # the unit matrix, with the derivative of a turn
        arm = self.point[mask] - position.detach()
        self._put(
            mask,
            position + (moved @ arm[..., None])[..., 0],
            self.slides[mask] @ moved.transpose(-1, -2),
            (moved @ self.edge[mask][..., None])[..., 0],
        )

    def _move_with_nodes(self, mask: Tensor, core: dict[str, Tensor], side: int, end: State) -> None:
        nodes = core["nodes"][mask, side].clamp(min=0)
        corners = _by_scene(end.node_position)[core["scene"][mask, None], nodes]  # (k, 3 nodes, 3)
        weights, slide_weights = core["weights"][mask, side], core["slide_weights"][mask, side]
        point = (weights[:, None] @ corners)[:, 0]
        is_edge = self.edge[mask].any(dim=-1)
        self._put(mask, point, slide_weights @ corners, (corners[:, 1] - corners[:, 0]) * is_edge[:, None])

    def _put(self, mask: Tensor, point: Tensor, slides: Tensor, edge: Tensor) -> None:
        self.point = self.point.index_put((mask,), point)
        self.slides = self.slides.index_put((mask,), slides)
        self.edge = self.edge.index_put((mask,), edge)


def _by_scene(tensor: Tensor) -> Tensor:
    """In float64, with one batch axis in front."""
    return tensor.to(torch.float64).reshape(-1, *tensor.shape[-2:])
