"""Packages that only some users need: loaded when they are, their absence named with the command that mends it."""

from __future__ import annotations

import importlib
from typing import Any


def require(module: str, extra: str, where: str) -> Any:
    """The module, imported; ModuleNotFoundError with the command that installs the extra it belongs to."""
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name != module.partition(".")[0]:  # it is there, and misses something itself
            raise
        raise ModuleNotFoundError(
            f"{where} needs {error.name}, which is not installed: pip install 'mesh-diffsim[{extra}]'", name=error.name
        ) from None
