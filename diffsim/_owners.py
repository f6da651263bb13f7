"""Numbers by which code that was compiled finds its simulator: ops take numbers, and no objects."""

from __future__ import annotations

import itertools
from typing import Any, Protocol
from weakref import WeakValueDictionary

from torch import Tensor

from ._core_calls import OptionalTensors, RolloutCall


class Owner(Protocol):
    """What a simulator is asked for where an op runs."""

    def _make_call(self, steps: int, **settings: Any) -> RolloutCall: ...
    def _check_unread(self, restitution: Tensor) -> None: ...
    def _finish_traced(self, info: Any, first_step: int, outputs: OptionalTensors) -> None: ...


_numbers = itertools.count()
_owners: WeakValueDictionary[int, Owner] = WeakValueDictionary()


def enlist(owner: Owner) -> int:
    """A number by which ops find the simulator, as long as it lives."""
    number = next(_numbers)
    _owners[number] = owner
    return number


def owner_of(number: int) -> Owner:
    owner = _owners.get(number)
    if owner is None:
        raise RuntimeError("diffsim: the simulator this code was compiled with is no more; compile it again")
    return owner
