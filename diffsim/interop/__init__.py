"""Bridges to other libraries. Each is loaded when it is first used, and needs the extra of its name.

`mujoco` (extra ``mujoco``): scenes from MJCF, states from and to MjData. `gymnasium` (extra ``rl``): a simulator as a
reinforcement-learning environment.
"""

from importlib import import_module
from typing import Any

__all__ = ["gymnasium", "mujoco"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        return import_module(f".{name}", __name__)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
