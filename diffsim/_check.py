"""The one place that checks arguments, with one message format: ``where: name must ..., got ...``."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from ._input_table import OF_CLOTH
from .state import Control, State

FLOAT_DTYPES = (torch.float32, torch.float64)


def message(where: str, name: str, must: str, got: object) -> str:
    return f"{where}: {name} must {must}, got {got}"


def check_instance(where: str, name: str, value: object, kind: type, must: str) -> None:
    if not isinstance(value, kind):
        raise TypeError(message(where, name, must, type(value).__name__))


def check_choice(where: str, name: str, value: object, choices: Sequence[str]) -> None:
    if value not in choices:
        raise ValueError(message(where, name, f"be one of {', '.join(map(repr, choices))}", repr(value)))


def check_number(
    where: str, name: str, value: object, *, above: float | None = None, least: float | None = None
) -> float:
    """A finite real number, larger than `above` or not smaller than `least`, as float."""
    if isinstance(value, (bool, str, bytes)) or not hasattr(value, "__float__"):
        raise TypeError(message(where, name, "be a number", type(value).__name__))
    number = float(value)
    if above is not None and not (math.isfinite(number) and number > above):
        raise ValueError(message(where, name, f"be finite and larger than {above:g}", repr(number)))
    if least is not None and not (math.isfinite(number) and number >= least):
        raise ValueError(message(where, name, f"be finite and at least {least:g}", repr(number)))
    return number


def check_count(where: str, name: str, value: object) -> int:
    """A whole number, at least 1."""
    if isinstance(value, bool) or not (isinstance(value, int) or hasattr(value, "__index__")):
        raise TypeError(message(where, name, "be a whole number", type(value).__name__))
    count = value if isinstance(value, int) else int(value.__index__())
    if count < 1:
        raise ValueError(message(where, name, "be at least 1", count))
    return count


def check_float_tensor(where: str, name: str, value: Any, dtype: torch.dtype | None = None) -> Tensor:
    """A float32 or float64 tensor on the CPU, of the given dtype if there is one."""
    if not isinstance(value, Tensor):
        raise TypeError(message(where, name, "be a torch.Tensor", type(value).__name__))
    if value.device.type != "cpu":
        raise ValueError(message(where, name, "be on the cpu, the only device diffsim runs on", value.device))
    if value.layout is not torch.strided:
        raise TypeError(message(where, name, "be a dense tensor (use .to_dense())", value.layout))
    if value.dtype not in FLOAT_DTYPES:
        raise TypeError(message(where, name, "have dtype torch.float32 or torch.float64", value.dtype))
    if dtype is not None and value.dtype is not dtype:
        raise TypeError(message(where, name, f"have the dtype of the state, {dtype}", value.dtype))
    return value


def check_shape(where: str, name: str, tensor: Tensor, shape: tuple[int, ...], batch: int | None) -> int | None:
    """The tensor has `shape`, behind a batch axis or not, and agrees with `batch`; returns the batch size known now."""
    got = tuple(tensor.shape)
    if got == shape:
        return batch
    if len(got) == len(shape) + 1 and got[1:] == shape and batch in (None, got[0]):
        return got[0]
    text = ", ".join(map(str, shape))
    batched = f"({'B' if batch is None else batch}, {text})"
    one = f"({text},)" if len(shape) == 1 else f"({text})"
    raise ValueError(message(where, name, f"have shape {one} or {batched}", got))


def check_state(where: str, state: Any, body_count: int, node_count: int) -> int | None:
    """The state fits the scene: types, device, one dtype, shapes. Returns its batch size, None without a batch axis."""
    check_instance(where, "state", state, State, "be a diffsim.State")
    dtype = check_float_tensor(where, "state.position", state.position).dtype
    batch: int | None = None
    for name, value in state.__dict__.items():
        count, width = (node_count if name in OF_CLOTH else body_count), (4 if name == "orientation" else 3)
        tensor = check_float_tensor(where, f"state.{name}", value, dtype)
        if tensor.ndim in (2, 3) and tensor.shape[-2] != count and tensor.shape[-1] == width:
            bodies = "1 body" if body_count == 1 else f"{body_count} bodies"
            must = f"have shape ({count}, {width}) or (B, {count}, {width})"
            text = message(where, f"state.{name}", must, tuple(tensor.shape))
            nodes = f"{node_count} cloth nodes" if node_count else "no cloth"
            raise ValueError(f"{text}; is it of another scene? This one has {bodies} and {nodes}")
        batch = check_shape(where, f"state.{name}", tensor, (count, width), batch)
    return batch


def check_placing(where: str, name: str, value: Any, width: int, state: State) -> Tensor | None:
    """Where something is to be put: a tensor, or numbers that make one, of shape (..., width), in the state's dtype."""
    if value is None:
        return None
    if not isinstance(value, Tensor):
        try:
            value = torch.as_tensor(value, dtype=state.dtype, device="cpu")
        except (TypeError, ValueError, RuntimeError) as error:
            raise TypeError(message(where, name, f"be a torch.Tensor or {width} numbers", repr(value))) from error
    tensor = check_float_tensor(where, name, value)
    if tensor.ndim == 0 or tensor.shape[-1] != width:
        raise ValueError(message(where, name, f"have shape (..., {width})", tuple(tensor.shape)))
    looked_at = not (torch.compiler.is_compiling() or torch._C._are_functorch_transforms_active())
    if width == 4 and looked_at:
        length = torch.linalg.vector_norm(tensor.detach(), dim=-1)
        if not ((length > 1e-6) & length.isfinite()).all():
            raise ValueError(message(where, name, "be quaternions w, x, y, z other than zero", tensor.tolist()))
    return tensor


def check_control(where: str, control: Any, body_count: int, node_count: int, batch: int | None) -> int | None:
    """The control fits the scene and the state's batch size. Returns the batch size known now."""
    check_instance(where, "control", control, Control, "be a diffsim.Control or None")
    for name, value in control.__dict__.items():
        if value is not None:
            tensor = check_float_tensor(where, f"control.{name}", value)
            count = node_count if name in OF_CLOTH else body_count
            batch = check_shape(where, f"control.{name}", tensor, (count, 3), batch)
    return batch
