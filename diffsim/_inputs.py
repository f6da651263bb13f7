"""Between what users hand over and the operator: state, controls and parameters in, the next state out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from . import _core
from ._check import (
    check_control,
    check_count,
    check_float_tensor,
    check_instance,
    check_shape,
    check_state,
    message,
)
from ._input_table import CONTROL_FIELDS, INPUT_COUNT, INPUTS, OF_CLOTH, STATE_FIELDS
from .state import Control, State

Controls = Control | Sequence[Control] | None
#: Of the operator, in the order of the table; those of cloth are None in a scene without.
Inputs = tuple[Tensor | None, ...]


class CheckedInputs(NamedTuple):
    """What a call hands to the operator."""

    inputs: Inputs
    controls_have_time: bool
    single: bool  #: whether an input came in float32, so that its gradient will be


#: Where an input goes among the operator's (None: nowhere), its name, and the shape that needs no thought.
_Entries = list[tuple[int | None, str, torch.Size | None]]


class PlainInputs:
    """The operator's inputs where nothing has to be converted or complained about: float64 tensors, all of the state
    and the controls with a batch axis or none. Kept fast: it is a good part of what a small step costs in Python.

    Args:
        counts: How many rows there are along each axis of the table.
    """

    def __init__(self, counts: Mapping[str, int]) -> None:
        self._counts = counts
        self._position = torch.Size((counts["bodies"], 3))
        self._single = self._moving(())
        self._batched = 0, self._single  # the batch size seen last
        self._parameters = self._entries("parameter", ())

    def _moving(self, leading: tuple[int, ...]) -> tuple[_Entries, _Entries]:
        return self._entries("state", leading), self._entries("control", leading)

    def _entries(self, kind: str, leading: tuple[int, ...]) -> _Entries:
        entries: _Entries = []
        for index, entry in enumerate(INPUTS):
            if entry.kind != kind:
                continue
            shape: torch.Size | None = torch.Size((*leading, *shape_of(entry, self._counts)))
            used = not _unused(entry.name, self._counts["nodes"])
            if used or kind == "state":  # a state of another scene must not pass
                entries.append((index if used else None, entry.name, shape))
            elif kind == "control":
                entries.append((None, entry.name, None))
        return entries

    def find(self, state: Any, control: Any, parameters: Mapping[str, Tensor]) -> Inputs | None:
        """Them, or None."""
        if type(state) is not State or not (control is None or type(control) is Control):
            return None
        inputs: list[Tensor | None] = [None] * INPUT_COUNT
        try:
            shape = state.position.shape
            of_state, of_control = self._single
            if shape != self._position:
                if len(shape) != 3:
                    return None
                if shape[0] != self._batched[0]:
                    self._batched = shape[0], self._moving((shape[0],))
                of_state, of_control = self._batched[1]
            plain = (
                _take(of_state, state.__dict__, inputs)
                and (control is None or _take(of_control, control.__dict__, inputs))
                and _take(self._parameters, parameters, inputs)
            )
        except AttributeError:  # not a tensor
            return None
        return tuple(inputs) if plain else None


def _take(entries: _Entries, values: Mapping[str, Tensor | None], inputs: list[Tensor | None]) -> bool:
    """Whether all values are plain; then they are among the inputs."""
    f64 = torch.float64
    for index, name, shape in entries:
        t = values[name]
        if t is None:
            continue
        if t.dtype is not f64 or t.shape != shape or not t.is_cpu:
            return False
        if index is not None:
            inputs[index] = t
    return True


def shape_of(entry: _core.Input, counts: Mapping[str, int]) -> torch.Size:
    """Of an input without time and batch axes."""
    return torch.Size((*((counts[entry.axis],) if entry.axis else ()), *entry.row_shape))


def checked_inputs(
    where: str,
    state: Any,
    controls: Any,
    parameters: Mapping[str, tuple[Tensor, tuple[int, ...]]],
    steps: int | None,
    body_count: int,
    node_count: int,
) -> CheckedInputs:
    """The operator's inputs from anything that is allowed, or an error that says why not.

    Args:
        where: Who is asking, for error messages.
        state: As for `Simulator.forward`.
        controls: As for `Simulator.rollout`, or with `steps` None as for `Simulator.forward`.
        parameters: In the order of the operator: name -> value and the shape it must have without a batch axis.
        steps: Of the rollout; None for a step.
        body_count: n_bodies.
        node_count: n_nodes.
    """
    batch = check_state(where, state, body_count, node_count)
    now = [None if _unused(name, node_count) else getattr(state, name) for name in STATE_FIELDS]
    if batch is not None:
        now = [None if t is None else t.expand(batch, *t.shape[-2:]) for t in now]
    checked, batch = _parameters(where, parameters, node_count, batch)
    driven: list[Tensor | None] = [None] * len(CONTROL_FIELDS)
    has_time = False
    if steps is not None:
        driven, has_time, batch = over_time(where, controls, steps, body_count, node_count, batch)
    elif controls is not None:
        check_control(where, controls, body_count, node_count, batch)
        driven = [None if _unused(name, node_count) else getattr(controls, name) for name in CONTROL_FIELDS]
    inputs = tuple(None if t is None else t.to(torch.float64) for t in (*now, *driven, *checked))
    return CheckedInputs(inputs, has_time, _has_single(state, controls, parameters))


def _has_single(state: State, controls: Any, parameters: Mapping[str, tuple[Tensor, Any]]) -> bool:
    """Whether any tensor is float32. All are known to be right."""
    each = controls if isinstance(controls, Sequence) else [] if controls is None else [controls]
    driving = (t for control in each for t in control.__dict__.values())
    tensors = (*state.__dict__.values(), *driving, *(value for value, _ in parameters.values()))
    return any(t is not None and t.dtype is torch.float32 for t in tensors)


def _unused(name: str, node_count: int) -> bool:
    """Whether the scene has nothing a field speaks of."""
    return node_count == 0 and name in OF_CLOTH


def over_time(
    where: str, controls: Any, steps: int, body_count: int, node_count: int, batch: int | None
) -> tuple[list[Tensor | None], bool, int | None]:
    """The controls in the order of the core; whether they have a time axis; the batch size known now."""
    if controls is None:
        return [None] * len(CONTROL_FIELDS), False, batch
    if isinstance(controls, Sequence) and not isinstance(controls, (str, bytes)):
        return _stacked(where, controls, steps, body_count, node_count, batch)
    check_instance(where, "controls", controls, Control, "be None, a diffsim.Control or a sequence of them")
    arranged: dict[str, tuple[Tensor | None, bool]] = {}
    for name, value in controls.__dict__.items():
        arranged[name] = None, False
        if value is not None:
            tensor = check_float_tensor(where, f"controls.{name}", value)
            shape = (node_count if name in OF_CLOTH else body_count, 3)
            tensor, has_time, batch = _arranged(where, f"controls.{name}", tensor, steps, shape, batch)
            if not _unused(name, node_count):
                arranged[name] = tensor, has_time
    fields = [arranged[name] for name in CONTROL_FIELDS]
    if not any(has_time for _, has_time in fields):
        return [t for t, _ in fields], False, batch
    return [t if t is None or has_time else t.expand(steps, *t.shape) for t, has_time in fields], True, batch


def _arranged(
    where: str, name: str, t: Tensor, steps: int, shape: tuple[int, int], batch: int | None
) -> tuple[Tensor, bool, int | None]:
    """([steps,] [B,] n, 3): which of its leading axes is time, and the batch size known now."""
    got, (count, width) = tuple(t.shape), shape
    if t.ndim <= 2 or (t.ndim == 3 and batch is not None and got[0] != steps):
        if got == shape or (t.ndim == 3 and got == (batch, *shape)):
            return t, False, batch
    elif t.ndim == 3 and got == (steps, *shape):
        if steps == batch:
            raise ValueError(
                f"{where}: {name} of shape {got} is ambiguous, because there are as many steps as scenes in the batch;"
                f" write {name}[:, None] if its first axis is time, {name}[None] if it is the batch"
            )
        return t, True, batch
    elif t.ndim == 4 and got[2:] == shape and got[0] in (1, steps) and (batch is None or got[1] in (1, batch)):
        if got[0] == got[1] != 1:
            raise ValueError(
                f"{where}: {name} of shape {got} is ambiguous, because there are as many steps as scenes in the batch;"
                " write list(controls), one Control per step, if its first axis is time, and exchange the two axes"
                f" before that, {name}.transpose(0, 1), if it is the batch"
            )
        batch = got[1] if batch is None else batch
        return t.expand(steps, batch, count, width), True, batch
    size = "B" if batch is None else batch
    forms = [f"({count}, 3)", f"({steps}, {count}, 3)", f"({steps}, {size}, {count}, 3)"]
    if batch is not None:
        forms.insert(1, f"({batch}, {count}, 3)")
    raise ValueError(message(where, name, f"have shape {', '.join(forms[:-1])} or {forms[-1]}", got))


def _stacked(
    where: str,
    controls: Sequence[Any],
    steps: int,
    body_count: int,
    node_count: int,
    batch: int | None,
) -> tuple[list[Tensor | None], bool, int | None]:
    if len(controls) != steps:
        raise ValueError(message(where, "controls", f"have one entry per step, {steps}", len(controls)))
    for step, control in enumerate(controls):
        batch = check_control(f"{where}: controls[{step}]", control, body_count, node_count, batch)
    stacked: list[Tensor | None] = []
    for name in CONTROL_FIELDS:
        column = [None if _unused(name, node_count) else getattr(control, name) for control in controls]
        given = [t for t in column if t is not None]
        if len(given) not in (0, steps):
            if name.startswith("body"):  # None is not zero here, but "as it goes"
                step = next(i for i, t in enumerate(column) if t is None)
                raise ValueError(
                    f"{where}: controls[{step}].{name} is None, others are not; give it in all steps or none"
                )
            count = node_count if name in OF_CLOTH else body_count
            column = [torch.zeros(count, 3, device="cpu") if t is None else t for t in column]
        cast = [t.to(torch.float64) for t in column if t is not None]  # steps may differ in their dtype
        stacked.append(torch.stack(torch.broadcast_tensors(*cast)) if given else None)
    return stacked, any(t is not None for t in stacked), batch


def checked_parameters(where: str, parameters: Any, shapes: Mapping[str, tuple[int, ...]]) -> Mapping[str, Tensor]:
    """What is to take the place of parameters in a call: known names, tensors of the right shapes or batches of it."""
    check_instance(where, "parameters", parameters, Mapping, "be a mapping of names to tensors or None")
    batch: int | None = None
    for name, value in parameters.items():
        if name not in shapes:
            raise ValueError(message(where, "parameters", f"have names among {', '.join(shapes)}", repr(name)))
        label = f"parameters[{name!r}]"
        batch = check_shape(where, label, check_float_tensor(where, label, value), shapes[name], batch)
    return parameters  # type: ignore[no-any-return]


def checked_steps(where: str, steps: Any, controls: Any) -> int:
    """The number of steps of a rollout."""
    if steps is None and isinstance(controls, Sequence):
        steps = len(controls)
    if steps is None:
        raise TypeError(message(where, "steps", "be given, as in sim.rollout(state, steps=100)", None))
    return check_count(where, "steps", steps)


def _parameters(
    where: str, parameters: Mapping[str, tuple[Any, tuple[int, ...]]], node_count: int, batch: int | None
) -> tuple[list[Tensor | None], int | None]:
    checked: list[Tensor | None] = []
    for name, (value, shape) in parameters.items():
        if _unused(name, node_count):
            checked.append(None)
            continue
        tensor = check_float_tensor(where, name, value)
        batch = check_shape(where, name, tensor, shape, batch)
        checked.append(tensor)
    return checked, batch


def check_unused(name: str, tensor: Tensor, shape: tuple[int, ...], objects: Sequence[str]) -> None:
    """Refuse values other than 0 of a parameter that contact makes no use of yet. `objects`: their names."""
    if type(tensor) is not nn.Parameter or tensor.shape != shape:  # exchanged for this call
        check_shape("Simulator", name, check_float_tensor("Simulator", name, tensor), shape, None)
    values = _unwrapped_values(tensor) if torch._C._are_functorch_transforms_active() else tensor.numpy(force=True)
    if values.tobytes().strip(b"\0") and values.any():  # .any() alone takes half as long as a small step
        whose = ""
        if values.shape == shape:
            index = int(np.flatnonzero(values)[0])
            whose = f"; that of {(*objects, 'ground')[index]!r} (index {index}) is {values[index]:g}"
        raise NotImplementedError(f"Simulator: {name} must be 0, contact has none in this version yet{whose}")


def _unwrapped_values(tensor: Tensor) -> np.ndarray:
    """What torch.func's transforms have wrapped: all values, mapped axes of vmap among the axes."""
    while torch._C._functorch.is_functorch_wrapped_tensor(tensor):
        tensor = torch._C._functorch.get_unwrapped(tensor)
    with torch._C._DisableFuncTorch():  # or they would wrap what is done here, too
        return tensor.numpy(force=True)


def state_from(outputs: tuple[Tensor | None, ...], state: State) -> State:
    """The operator's outputs as a state of the given state's dtype; without cloth, with the given state's empty one."""
    if state.position.dtype is not torch.float64:
        dtype = state.position.dtype
        outputs = tuple(None if t is None else t.to(dtype) for t in outputs)
    position, orientation, velocity, angular_velocity, node_position, node_velocity = outputs
    assert position is not None  # bodies always are, if only none of them
    if node_position is None or node_velocity is None:
        node_position, node_velocity = state.node_position, state.node_velocity
    if node_position.ndim != position.ndim or node_position.shape[:-2] != position.shape[:-2]:
        leading = position.shape[:-2]
        node_position = node_position.expand(*leading, *node_position.shape[-2:])
        node_velocity = node_velocity.expand(*leading, *node_velocity.shape[-2:])
    return State._make(
        position=position,
        orientation=orientation,
        velocity=velocity,
        angular_velocity=angular_velocity,
        node_position=node_position,
        node_velocity=node_velocity,
    )
