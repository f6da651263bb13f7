"""The progress bar of a rollout or a recording: tqdm's, or a plain line where tqdm is missing."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def progress_bar(
    steps: int, shown: bool, name: str = "rollout", unit: str = "step"
) -> Iterator[Callable[[int], object]]:
    """Gives a function that is told how many more steps are done."""
    if not shown:
        yield lambda count: None
        return
    try:
        from tqdm.auto import tqdm
    except ImportError:
        done = 0

        def advance(count: int) -> None:
            nonlocal done
            done += count
            sys.stderr.write(f"\r{name}: {unit} {done} of {steps}" + ("\n" if done == steps else ""))
            sys.stderr.flush()

        yield advance
        return
    with tqdm(total=steps, desc=name, unit=unit) as bar:
        yield bar.update
