"""One step in one file: a scene, its parameters, a state and a control, to be taken again elsewhere."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, fields
from os import PathLike
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ._check import check_instance
from ._packed import PackedScene
from .simulator import Simulator
from .state import Control, State

_FORMAT = 1  # of the file; raised by whoever changes what is in it
_FIELDS = {field.name: field for field in fields(PackedScene)}


@dataclass(frozen=True, eq=False)
class Replay:
    """A step that `dump` kept, ready to be taken again."""

    sim: Simulator  #: with the parameters and options that the simulator had
    state: State
    control: Control | None

    def step(self) -> State:
        """Take the step: bitwise what it was, on a machine of the same kind; `sim.info` says how it went."""
        result: State = self.sim(self.state, self.control)
        return result


def dump(sim: Simulator, state: State, control: Control | None, path: str | PathLike[str]) -> None:
    """Keep a step, one that failed say, in one file that needs nothing else: scene, meshes, parameters, options, state,
    control. For reports: `replay` takes the step again.

    Args:
        sim: The simulator; its parameters are kept as they are now. Those exchanged for a call are not seen.
        state: Where the step starts, with or without a batch axis: of the failed step ``f = sim.info.failures[0]`` of
            ``trajectory = sim.rollout(start, ...)`` it is ``start`` where ``f.step`` is 0, else
            ``trajectory[f.step - 1]``; of a batch, scene ``f.scene`` of it.
        control: Of that step, or None.
        path: Of the file to write, whatever its suffix. It is an npz of arrays, without pickles.
    Raises: TypeError, ValueError as the step does for inputs that do not fit the scene; OSError where nothing can be
        written.
    """
    check_instance("dump", "sim", sim, Simulator, "be a diffsim.Simulator")
    sim._checked_inputs("dump", state, control, None)
    arrays: dict[str, Any] = {}
    scene: dict[str, Any] = {}
    for name in _FIELDS:
        value = getattr(sim._packed, name)
        if isinstance(value, np.ndarray):
            arrays[f"scene/{name}"] = value
        else:
            scene[name] = value
    for kind, tensors in (
        ("parameter", dict(sim.named_parameters())),
        ("state", state.__dict__),
        ("control", {} if control is None else control.__dict__),
    ):
        arrays.update({f"{kind}/{name}": t.numpy(force=True) for name, t in tensors.items() if t is not None})
    about = {
        "format": _FORMAT,
        "scene": scene,
        "settings": sim._settings,
        "num_threads": sim._num_threads,
        "on_failure": sim._on_failure,
        "check": sim._check,
        "has_control": control is not None,
    }
    with open(path, "wb") as file:  # a path would be given another suffix
        np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)


def replay(path: str | PathLike[str]) -> Replay:
    """Read what `dump` wrote. Nothing in the file is run as code.

    Args:
        path: Of the file.
    Returns: Simulator, state and control. ``replay(path).step()`` takes the step.
    Raises: OSError where nothing can be read, ValueError for a file that `dump` did not write, or a later version's.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays.pop("about")))
        version = about["format"]
    except (KeyError, TypeError, ValueError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise ValueError(f"replay: {path} must be a file that diffsim.diagnostics.dump wrote ({error})") from error
    if version != _FORMAT:
        raise ValueError(
            f"replay: {path} must be of format {_FORMAT}, the one this version of diffsim reads, got {version}"
        )
    packed = _part("scene", arrays)
    packed.update(about["scene"])
    if packed.keys() != _FIELDS.keys():
        raise ValueError(
            f"replay: {path} lacks, or has too many, {sorted(packed.keys() ^ _FIELDS.keys())} of its scene"
        )
    sim = Simulator._of_packed(
        PackedScene(**packed),
        about["settings"],
        num_threads=about["num_threads"],
        on_failure=about["on_failure"],
        check=about["check"],
    )
    for name, value in _part("parameter", arrays).items():
        getattr(sim, name).data = torch.from_numpy(value)
    state = State(**_tensors("state", arrays))
    return Replay(sim, state, Control(**_tensors("control", arrays)) if about["has_control"] else None)


def _part(kind: str, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    return {name.split("/", 1)[1]: array for name, array in arrays.items() if name.startswith(f"{kind}/")}


def _tensors(kind: str, arrays: Mapping[str, np.ndarray]) -> dict[str, Tensor]:
    return {name: torch.from_numpy(array) for name, array in _part(kind, arrays).items()}
