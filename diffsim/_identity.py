"""Which scene parameters belong to, so that a `state_dict` is not taken for that of another one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ._packed import PackedScene

_KEY = "_extra_state"  # PyTorch's name for it


class SceneIdentity(nn.Module):
    """Mixed into `Simulator`: its `state_dict` names the scene, and `load_state_dict` refuses that of another one.

    Strict or not, since ``strict=False`` is about keys that are missing; parameters alone can be loaded by leaving out
    the key "_extra_state".
    """

    _packed: PackedScene
    _dt: float

    def get_extra_state(self) -> Tensor:
        """The names of bodies and cloths in their order, and dt, as JSON in a uint8 tensor: whatever handles a
        `state_dict` may take all of its values for tensors.
        """
        return torch.from_numpy(np.frombuffer(json.dumps(self._identity()).encode(), dtype=np.uint8).copy())

    def set_extra_state(self, state: Any) -> None:
        """Nothing: it was compared before the parameters were loaded."""

    def _identity(self) -> dict[str, Any]:
        return {"body": list(self._packed.names), "cloth": list(self._packed.cloth_names), "dt": self._dt}

    def _load_from_state_dict(
        self,
        state_dict: Mapping[str, Any],
        prefix: str,
        local_metadata: Any,
        strict: bool,
        missing_keys: list[str],
        unexpected_keys: list[str],
        error_msgs: list[str],
    ) -> None:
        given = state_dict.get(prefix + _KEY)
        problem = None if given is None else _difference(given, self._identity())
        if problem is not None:  # PyTorch raises the messages it finds; no parameter is touched
            error_msgs.append(
                f"{type(self).__name__}: the state_dict is of another scene: {problem}. Load it into a simulator of its"
                f' own scene; or, to take the parameters nevertheless, remove its key "{prefix}{_KEY}" and pass'
                " strict=False"
            )
            return
        super()._load_from_state_dict(
            state_dict, prefix, local_metadata, strict, missing_keys, unexpected_keys, error_msgs
        )


def _difference(given: Any, own: dict[str, Any]) -> str | None:
    """What differs first, in words; None if nothing does."""
    try:
        theirs = json.loads(bytes(given.detach().cpu().numpy()))
        names = {what: list(theirs[what]) for what in ("body", "cloth")}
        dt = float(theirs["dt"])
    except (AttributeError, KeyError, TypeError, ValueError):
        return f"its key {_KEY!r} was not written by a diffsim.Simulator"
    for what, plural in (("body", "bodies"), ("cloth", "cloths")):
        for index, (there, here) in enumerate(zip(names[what], own[what])):
            if there != here:
                return f"{what} {index} is {there!r} there and {here!r} here"
        if len(names[what]) != len(own[what]):
            return f"there are {len(names[what])} {plural} there and {len(own[what])} here"
    if dt != own["dt"]:
        return f"dt is {dt!r} s there and {own['dt']!r} s here"
    return None
