"""What moves, and what drives it: tensor dataclasses that are also PyTorch pytrees."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeVar

import torch
import torch.utils._pytree as pytree
from torch import Tensor
from torch.utils.data._utils.collate import default_collate_fn_map

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

    def __len__(self) -> int:
        """The length of the first leading axis, time or batch."""
        lengths: set[int] = {t.shape[0] for t in self.__dict__.values() if t is not None and t.ndim > 2}
        if len(lengths) != 1:
            raise TypeError(
                f"{type(self).__name__} without a time or batch axis has no length, and cannot be iterated over"
            )
        return lengths.pop()

    def __bool__(self) -> bool:
        """True, as if there were no length: `control or default` asks for None."""
        return True

    def __iter__(self: T) -> Iterator[T]:
        """The entries of the first leading axis, as in ``for state in trajectory``."""
        return (self[i] for i in range(len(self)))

    @classmethod
    def stack(cls: type[T], entries: Sequence[T], dim: int = 0) -> T:
        """One with a new leading axis: ``State.stack([a, b])`` is a batch of two scenes, or a trajectory of two states.

        Args:
            entries: One or more of the same scene and dtype, with the same fields and leading axes.
            dim: Where among the leading axes the new one is: 0 in front of all, the default, 1 behind the first.
        Raises: TypeError, ValueError for entries that do not fit together, by name; IndexError for a wrong `dim`.
        Gradients: flow to all entries.
        """
        return cls._joined("stack", torch.stack, entries, dim, new_axes=1)

    @classmethod
    def cat(cls: type[T], entries: Sequence[T], dim: int = 0) -> T:
        """One along a leading axis there is: ``State.cat([batch, other])`` has the scenes of both, and
        ``State.cat([start[None], trajectory])`` the first state, too.

        Args:
            entries: One or more of the same scene and dtype, with the same fields and leading axes.
            dim: Which of the leading axes, 0 the first.
        Raises: TypeError, ValueError for entries that do not fit together, by name; IndexError for a wrong `dim`.
        Gradients: flow to all entries.
        """
        return cls._joined("cat", torch.cat, entries, dim, new_axes=0)

    @classmethod
    def where(cls: type[T], mask: Tensor, a: T, b: T) -> T:
        """`a` where the mask is true, `b` elsewhere. Starts some scenes of a batch again:
        ``state = ds.State.where(done, sim.initial_state(), state)``.

        Args:
            mask: bool, of the shape of the leading axes, such as (B,), or one that broadcasts to it.
            a: Of the same scene and dtype as `b`; leading axes broadcast.
            b: Likewise.
        Raises: TypeError, ValueError for what does not fit together, by name.
        Gradients: flow to what was taken, and zeros to the rest.
        """
        where = f"{cls.__name__}.where"
        if not isinstance(mask, Tensor) or mask.dtype is not torch.bool:
            got = mask.dtype if isinstance(mask, Tensor) else type(mask).__name__
            raise TypeError(f"{where}: mask must be a tensor of torch.bool, got {got}")
        _check_alike(where, cls, {"a": a, "b": b})
        taken: dict[str, Any] = {}
        for name, of_a in a.__dict__.items():
            of_b = getattr(b, name)
            taken[name] = None
            if of_a is not None:
                shapes = mask.shape, of_a.shape[:-2], of_b.shape[:-2]
                try:
                    torch.broadcast_shapes(*shapes)
                except RuntimeError:
                    leading = ", ".join(str(tuple(shape)) for shape in shapes)
                    raise ValueError(
                        f"{where}: leading axes must broadcast; those of mask, a.{name} and b.{name} are {leading}"
                    ) from None
                taken[name] = torch.where(mask[..., None, None], of_a, of_b)
        return cls._make(**taken)

    @classmethod
    def _joined(
        cls: type[T], method: str, join: Callable[..., Tensor], entries: Sequence[T], dim: int, new_axes: int
    ) -> T:
        where = f"{cls.__name__}.{method}"
        entries = list(entries)
        if not entries:
            raise ValueError(f"{where}: there must be at least one entry, got none")
        _check_alike(where, cls, {f"entries[{i}]": entry for i, entry in enumerate(entries)})
        rows = [entry._with_equal_axes() for entry in entries]
        joined: dict[str, Any] = {}
        for name, first in rows[0].items():
            joined[name] = None
            if first is None:
                continue
            column = [row[name] for row in rows]
            count = first.ndim - 2 + new_axes
            if not -1 < dim < count:
                raise IndexError(f"{where}: dim must be that of a leading axis, of which there are {count}, got {dim}")
            for i, t in enumerate(column):
                if t.ndim != first.ndim or any(
                    t.shape[k] != first.shape[k] for k in range(t.ndim) if new_axes or k != dim
                ):
                    raise ValueError(
                        f"{where}: entries[{i}].{name} has shape {tuple(t.shape)}, which does not fit"
                        f" {tuple(first.shape)} of entries[0]"
                    )
            joined[name] = join(column, dim)
        return cls._make(**joined)

    def _with_equal_axes(self) -> dict[str, Any]:
        """The fields, each with all leading axes that any has."""
        leading = torch.broadcast_shapes(*(t.shape[:-2] for t in self.__dict__.values() if t is not None))
        return {name: None if t is None else t.expand(*leading, *t.shape[-2:]) for name, t in self.__dict__.items()}

    def __repr__(self) -> str:
        entries = [f"{name}={tuple(t.shape)}" for name, t in self.__dict__.items() if isinstance(t, Tensor)]
        dtypes = {str(t.dtype) for t in self.__dict__.values() if isinstance(t, Tensor)}
        return f"{type(self).__name__}({', '.join(entries + sorted(dtypes))})"


def _check_alike(where: str, kind: type[Any], entries: dict[str, Any]) -> None:
    """All of one class, and each field in all of them or in none, of one dtype and as many bodies or nodes."""
    first_label, first = next(iter(entries.items()))
    for label, entry in entries.items():
        if type(entry) is not kind:
            raise TypeError(f"{where}: {label} must be a diffsim.{kind.__name__}, got {type(entry).__name__}")
        for name, t in entry.__dict__.items():
            other = getattr(first, name)
            if (t is None) != (other is None):
                there, absent = (first_label, label) if t is None else (label, first_label)
                raise ValueError(f"{where}: {there} has {name}, {absent} has None; give it in all or none")
            if t is not None and t.dtype != other.dtype:
                raise TypeError(f"{where}: {label}.{name} has dtype {t.dtype}, that of {first_label} has {other.dtype}")
            if t is not None and t.shape[-2:] != other.shape[-2:]:
                raise ValueError(
                    f"{where}: {label}.{name} has shape {tuple(t.shape)}, that of {first_label} {tuple(other.shape)}:"
                    " are they of different scenes?"
                )


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

    Every tensor may carry one leading batch axis of its own, and be float32 or float64, whatever the state is: a step
    is float64 inside. SI units, world frame. Gradients reach all of them, in the dtype they came in.

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


def _collate(batch: list[Any], *, collate_fn_map: Any = None) -> Any:
    """What torch's DataLoader makes of the entries of a batch."""
    return type(batch[0]).stack(batch)


for _cls in (State, Control):
    _register(_cls)
    default_collate_fn_map[_cls] = _collate
torch.serialization.add_safe_globals([State, Control])  # torch.load(weights_only=True), its default, may build them
