"""What moves, and what drives it: tensor dataclasses that are also PyTorch pytrees."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
import torch.utils._pytree as pytree
from torch import Tensor

__all__ = ["Control", "State"]

T = TypeVar("T", bound="_TensorFields")


class _TensorFields:
    """What `State` and `Control` share: operations applied to every tensor they hold."""

    @classmethod
    def _make(cls: type[T], **tensors: Any) -> T:
        """An instance from fields known to be right; pytrees also pass leaves that are not tensors."""
        instance = object.__new__(cls)
        instance.__dict__.update(tensors)
        return instance

    def _map(self: T, function: Callable[[Tensor], Tensor]) -> T:
        return self._make(**{name: None if t is None else function(t) for name, t in self.__dict__.items()})

    def detach(self: T) -> T:
        """The same values, cut from the autograd graph (no copy)."""
        return self._map(Tensor.detach)

    def clone(self: T) -> T:
        """A copy; gradients flow through it."""
        return self._map(Tensor.clone)

    def to(self: T, dtype: torch.dtype) -> T:
        """The same values in another dtype (float32 or float64); gradients flow through it, in the dtype there was."""
        return self._map(lambda t: t.to(dtype))

    def replace(self: T, **tensors: Tensor | None) -> T:
        """A copy with some fields exchanged: ``state.replace(velocity=v)``; TypeError for a name that is no field."""
        names = [field.name for field in fields(self)]  # type: ignore[arg-type]
        for name in tensors:
            if name not in names:
                raise TypeError(f"{type(self).__name__}.replace: no field {name!r}; the fields are {', '.join(names)}")
        return type(self)(**{**self.__dict__, **tensors})

    def __getitem__(self: T, index: Any) -> T:
        """Index the leading axes (time, batch) of every tensor: ``trajectory[-1]``, ``trajectory[:, 3]``.

        Raises: TypeError for an index with ``...``, or one that reaches past the leading axes.
        """
        entries = index if isinstance(index, tuple) else (index,)
        if any(entry is Ellipsis for entry in entries):
            raise TypeError(f"{type(self).__name__}: the index is for leading axes and takes no '...'; index one field")
        used = sum(entry is not None for entry in entries)
        for name, t in self.__dict__.items():
            if t is not None and t.ndim - 2 < used:
                raise TypeError(
                    f"{type(self).__name__}: {used} leading axes (time, batch) are indexed,"
                    f" {name} of shape {tuple(t.shape)} has {t.ndim - 2}"
                )
        return self._map(lambda t: t[index])

    def __iter__(self: T) -> Iterator[T]:
        """The entries of the first leading axis, as in ``for state in trajectory``."""
        lengths = {t.shape[0] for t in self.__dict__.values() if t is not None and t.ndim > 2}
        if len(lengths) != 1:
            raise TypeError(f"{type(self).__name__} without a time or batch axis cannot be iterated over")
        return (self[i] for i in range(lengths.pop()))

    def __repr__(self) -> str:
        entries = [f"{name}={tuple(t.shape)}" for name, t in self.__dict__.items() if isinstance(t, Tensor)]
        dtypes = {str(t.dtype) for t in self.__dict__.values() if isinstance(t, Tensor)}
        return f"{type(self).__name__}({', '.join(entries + sorted(dtypes))})"


@dataclass(frozen=True, init=False, eq=False, repr=False)
class State(_TensorFields):
    """Where everything is and how it moves; a pytree, so torch.func, pickle and torch.save take it.

    Every tensor may carry leading axes: one for a batch of scenes, and what `Simulator.rollout` returns carries
    one more in front, for time. Bodies come in the order they were added, SI units, world frame. Gradients flow through
    all of them.

    Args:
        position: Centres of mass [m], shape (..., n_bodies, 3).
        orientation: Unit quaternions w, x, y, z that turn body axes into world axes, shape (..., n_bodies, 4).
            Default: no rotation.
        velocity: Of the centres of mass [m/s], shape (..., n_bodies, 3). Default: zero.
        angular_velocity: World frame [rad/s], shape (..., n_bodies, 3). Default: zero.
        node_position: Cloth nodes [m], shape (..., n_nodes, 3), all cloths concatenated. Default: no nodes.
        node_velocity: Cloth nodes [m/s], shape (..., n_nodes, 3). Default: zero.

    The other tensors are checked where they are used, by the simulator that knows how many bodies there are.

    Raises: TypeError for a position that is no tensor, ValueError for one of another shape.
    """

    position: Tensor
    orientation: Tensor
    velocity: Tensor
    angular_velocity: Tensor
    node_position: Tensor
    node_velocity: Tensor

    def __init__(
        self,
        position: Tensor,
        orientation: Tensor | None = None,
        velocity: Tensor | None = None,
        angular_velocity: Tensor | None = None,
        node_position: Tensor | None = None,
        node_velocity: Tensor | None = None,
    ) -> None:
        if not isinstance(position, Tensor):
            raise TypeError(f"State: position must be a torch.Tensor, got {type(position).__name__}")
        if position.ndim < 2 or position.shape[-1] != 3:
            raise ValueError(f"State: position must have shape (..., n_bodies, 3), got {tuple(position.shape)}")
        if orientation is None:
            identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=position.dtype, device=position.device)
            orientation = identity.expand(*position.shape[:-1], 4).clone()
        if node_position is None:
            node_position = position.new_zeros(*position.shape[:-2], 0, 3)
        self.__dict__.update(
            position=position,
            orientation=orientation,
            velocity=torch.zeros_like(position) if velocity is None else velocity,
            angular_velocity=torch.zeros_like(position) if angular_velocity is None else angular_velocity,
            node_position=node_position,
            node_velocity=torch.zeros_like(node_position) if node_velocity is None else node_velocity,
        )

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of all tensors: float32 or float64."""
        return self.position.dtype

    @property
    def leading_shape(self) -> torch.Size:
        """The axes in front of (n_bodies, 3): () for one state, (B,) for a batch, (steps[, B]) for a trajectory."""
        return self.position.shape[:-2]


@dataclass(frozen=True, eq=False, repr=False)
class Control(_TensorFields):
    """What drives one step (or, with a leading time axis, a rollout); any field may be None, and then is zero.

    Rows of bodies and nodes a field says nothing to must be zero: a step refuses a control that it would not read.

    Every tensor may carry one leading batch axis of its own. SI units, world frame, dtype of the state. Gradients reach
    all of them.

    Args:
        force: On dynamic bodies at the centre of mass [N], shape (..., n_bodies, 3), constant over the step.
        torque: On dynamic bodies about the centre of mass [N·m], shape (..., n_bodies, 3).
        node_force: On cloth nodes [N], shape (..., n_nodes, 3). What holds a pinned node takes its force.
        body_velocity: Velocity of kinematic bodies [m/s], shape (..., n_bodies, 3). None: they go on with the velocity
            in their state.
        body_angular_velocity: Angular velocity of kinematic bodies [rad/s], shape (..., n_bodies, 3); same rules.
        node_velocity: Velocity of pinned nodes [m/s], shape (..., n_nodes, 3).
    """

    force: Tensor | None = None
    torque: Tensor | None = None
    node_force: Tensor | None = None
    body_velocity: Tensor | None = None
    body_angular_velocity: Tensor | None = None
    node_velocity: Tensor | None = None


def _register(cls: type[_TensorFields]) -> None:
    names = [field.name for field in fields(cls)]  # type: ignore[arg-type]

    # Fields that are None are structure and not leaves: vmap(in_dims=0) takes tensors only.
    def flatten(instance: Any) -> tuple[list[Any], Any]:
        values = instance.__dict__
        present = tuple(name for name in names if values[name] is not None)
        return [values[name] for name in present], present

    def flatten_with_keys(instance: Any) -> tuple[list[tuple[Any, Any]], Any]:
        leaves, present = flatten(instance)
        return [(pytree.GetAttrKey(name), leaf) for name, leaf in zip(present, leaves)], present

    def unflatten(leaves: Any, present: Any) -> Any:
        return cls._make(**{**dict.fromkeys(names), **dict(zip(present, leaves))})

    pytree.register_pytree_node(
        cls,
        flatten,
        unflatten,
        serialized_type_name=f"diffsim.{cls.__name__}",
        to_dumpable_context=list,
        from_dumpable_context=tuple,
        flatten_with_keys_fn=flatten_with_keys,
    )


_register(State)
_register(Control)
torch.serialization.add_safe_globals([State, Control])  # torch.load(weights_only=True), its default, may build them
