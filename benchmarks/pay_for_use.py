"""What a scene pays for what it does not need: each feature absent, present but idle, and used.

One thread, times on the processor, in turns, medians over rounds; ratios are medians of ratios within a round, to the
same call with the feature absent. `idle` is there and does nothing: a body far away, a ground far below, a gradient
recorded and not asked for, friction of the cubes on a ground that has none, or of what does not touch: should cost 2 %
and 1 % at most. Bytes are those of the tape, per step. Allocations are those of a step within a call, of whatever
asks for memory: of twice as many steps less those of as many. The last lines are importing diffsim after torch, and
the extension module's size. Prints one CSV line each. What a feature costs where it is absent cannot be measured in
one build: `idle` is an upper bound of it.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from _allocations import counted, run_counting
from _common import (
    STATE_FIELDS,
    advance,
    in_turns,
    make_parser,
    median_ratio,
    print_header,
    print_row,
    tape_bytes,
)

import diffsim as ds
from diffsim import _core

COLUMNS = ("case", "what", "step_us", "ratio", "allocations_per_step", "tape_bytes_per_step", "module_mb")
DT, WAYS = 0.01, ("absent", "idle", "used")
FAR = 50.0  # [m]
CUBES = 10
IMPORT = """
import time, torch
start = time.process_time()
import diffsim
print(time.process_time() - start)
"""


@dataclass(frozen=True)
class Feature:
    """One entry: the scenes of the three ways, and what is called."""

    scenes: Mapping[str, Callable[[], ds.Scene]]
    call: Mapping[str, Callable[[ds.Simulator, ds.State, int], object]]
    options: Mapping[str, Mapping[str, Any]]


# ---- scenes ----------------------------------------------------------------------------------------------------------


def cubes(
    *,
    ground: float | None = None,
    driven: float | None = None,
    sheet: float | None = None,
    friction: tuple[float, float] = (0.0, 0.0),  # of the cubes, of the ground
) -> ds.Scene:
    """Cubes at z = 1; a ground, a driven plate or a pinned sheet, so far below where they begin to be in contact."""
    scene = ds.Scene()
    for k in range(CUBES):
        place = (0.5 * k, 0.0, 1.0)
        scene.add_body(ds.shapes.box(0.2), density=500.0, position=place, friction=friction[0], name=f"cube_{k}")
    top = 0.9 - 1e-3
    if ground is not None:
        scene.add_ground(height=top - ground, friction=friction[1])
    if driven is not None:
        position = (0.25 * CUBES, 0.0, top - driven - 0.1)
        scene.add_body(ds.shapes.box((0.6 * CUBES, 1.0, 0.2)), kind="kinematic", position=position, name="plate")
    if sheet is not None:
        _add_sheet(scene, top - sheet - 2e-3)
    return scene


def _add_sheet(scene: ds.Scene, height: float) -> None:
    size, nodes = (0.6 * CUBES, 0.5), (2 * CUBES, 3)
    pinned = [0, 2, 3 * 2 * CUBES - 3, 3 * 2 * CUBES - 1]
    scene.add_cloth(
        ds.shapes.sheet(size, nodes), pinned=pinned, position=(0.25 * CUBES, 0.0, height), margin=1e-3, name="sheet"
    )


def sheet_with(body: float | None) -> ds.Scene:
    """The sheet, and a cube so far above where it touches."""
    scene = ds.Scene()
    _add_sheet(scene, 0.0)
    if body is not None:
        scene.add_body(ds.shapes.box(0.2), density=50.0, position=(0.25 * CUBES, 0.0, 0.103 + body), name="cube")
    return scene


# ---- calls -----------------------------------------------------------------------------------------------------------


def forward(sim: ds.Simulator, start: ds.State, steps: int) -> object:
    return advance(sim, start, steps)


def step_by_step(sim: ds.Simulator, start: ds.State, steps: int) -> object:
    state = start
    with torch.no_grad():
        for _ in range(steps):
            state = sim(state)
    return state


def read_contacts(sim: ds.Simulator, start: ds.State, steps: int) -> object:
    state = start
    with torch.no_grad():
        for _ in range(steps):
            state = sim.contacts(state).end
    return state


def gradients(
    sim: ds.Simulator, start: ds.State, steps: int, *, recorded: tuple[str, ...], asked: tuple[str, ...]
) -> object:
    """Of a loss on the last state, with `recorded` inputs of which some are asked for."""
    state = {name: getattr(start, name).detach().clone() for name in STATE_FIELDS}
    parameters = {"mass": sim.mass.detach().clone(), "inertia": sim.inertia.detach().clone()}
    leaves = {**state, **parameters}
    for name in recorded:
        leaves[name].requires_grad_()
    end = sim.rollout(ds.State(**state), None, steps, parameters=parameters)[-1]
    if not asked:
        return end
    return torch.autograd.grad(end.position.square().sum(), [leaves[name] for name in asked])


def _with(absent: Any, idle: Any, used: Any) -> dict[str, Any]:
    return dict(zip(WAYS, (absent, idle, used)))


def _feature(scenes: dict[str, Any], call: Any = forward, options: Any = None) -> Feature:
    calls = call if isinstance(call, dict) else _with(call, call, call)
    return Feature(scenes, calls, options or _with({}, {}, {}))


_LANDED = partial(cubes, ground=0.0)
_ABOVE = partial(cubes, ground=FAR)
_ROUGH = {"friction": (0.5, 0.5)}
_ONE_SIDED = _with(_LANDED, partial(_LANDED, friction=(0.5, 0.0)), partial(_LANDED, **_ROUGH))
_STATE, _PARAMETERS = ("position", "velocity"), ("mass", "inertia")
_TO_STATE = partial(gradients, recorded=_STATE, asked=_STATE)
FEATURES = {
    "ground": _feature(_with(cubes, partial(cubes, ground=FAR), _LANDED)),
    "kinematic body": _feature(_with(cubes, partial(cubes, driven=FAR), partial(cubes, driven=0.0))),
    "cloth": _feature(_with(cubes, partial(cubes, sheet=FAR), partial(cubes, sheet=0.0))),
    "bodies beside cloth": _feature(
        _with(partial(sheet_with, None), partial(sheet_with, FAR), partial(sheet_with, 0.0))
    ),
    "contact read-out": _feature(_with(_LANDED, cubes, _LANDED), _with(step_by_step, read_contacts, read_contacts)),
    "hard contacts": _feature(
        _with(_LANDED, cubes, _LANDED), options=_with({}, {"compliance": 0.0}, {"compliance": 0.0})
    ),
    "gradient to the state": _feature(
        _with(_LANDED, _LANDED, _LANDED),
        _with(forward, partial(gradients, recorded=_STATE, asked=()), _TO_STATE),
    ),
    "friction on one side": _feature(_ONE_SIDED),
    "friction on one side with gradients": _feature(_ONE_SIDED, _TO_STATE),
    "friction of what does not touch": _feature(_with(_ABOVE, partial(_ABOVE, **_ROUGH), partial(_LANDED, **_ROUGH))),
    "gradient to parameters": _feature(
        _with(_LANDED, _LANDED, _LANDED),
        _with(
            _TO_STATE,
            partial(gradients, recorded=(*_STATE, *_PARAMETERS), asked=_STATE),
            partial(gradients, recorded=(*_STATE, *_PARAMETERS), asked=(*_STATE, *_PARAMETERS)),
        ),
    ),
}


def print_allocations(steps: int) -> None:
    """For the process that counts."""
    for name, feature in FEATURES.items():
        for way in WAYS:
            sim = ds.Simulator(feature.scenes[way](), DT, num_threads=1, **feature.options[way])
            calls = [partial(feature.call[way], sim, sim.initial_state(), count) for count in (steps, 2 * steps)]
            for call in calls:  # what is kept from call to call is there then
                call()
            few, many = map(counted, calls)
            print(name, way, (many - few) / steps, sep=",")


def allocations(steps: int) -> dict[tuple[str, str], float]:
    """Of a step, by feature and way."""
    lines = run_counting([__file__, "--steps", str(steps), "--count"]).splitlines()
    return {(name, way): float(made) for name, way, made in (line.split(",") for line in lines)}


def measure(name: str, feature: Feature, steps: int, rounds: int, made: Mapping[tuple[str, str], float]) -> None:
    timed, tapes = {}, {}
    for way in WAYS:
        sim = ds.Simulator(feature.scenes[way](), DT, num_threads=1, **feature.options[way])
        start = sim.initial_state()
        timed[way] = partial(feature.call[way], sim, start, steps)
        tapes[way] = tape_bytes(sim, start, steps) / steps
        timed[way]()
    # Each is called once more before it is timed: caches are its own then.
    seconds = in_turns(
        {f"{warm}{way}": timed[way] for way in WAYS for warm in ("warm ", "")}, rounds, time.process_time
    )
    for way in WAYS:
        ratio = median_ratio(seconds[way], seconds["absent"])
        step_us = 1e6 * statistics.median(seconds[way]) / steps
        print_row([name, way, step_us, ratio, made.get((name, way)), tapes[way], None])


def import_seconds(rounds: int, quick: bool) -> float:
    """On the processor, after torch has been imported."""
    with tempfile.TemporaryDirectory() as compiled:  # as an installed package is, whatever the environment says
        environment = dict(os.environ)
        run = partial(
            subprocess.run, [sys.executable, "-c", IMPORT], env=environment, stdout=subprocess.PIPE, text=True
        )
        if not quick:  # else as it is: to compile all of torch takes long
            environment["PYTHONPYCACHEPREFIX"] = compiled
            environment.pop("PYTHONDONTWRITEBYTECODE", None)
            run()
        return statistics.median(float(run(check=True).stdout) for _ in range(rounds))


def main() -> int:
    parser = make_parser(__doc__, rounds=21, cpu_time=False)
    parser.set_defaults(clock=time.process_time)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--count", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.quick:
        options.rounds, options.steps = 1, 5
    torch.set_num_threads(1)
    if options.count:
        print_allocations(options.steps)
        return 0
    print_header(clock=options.clock)
    print_row(COLUMNS)
    made = allocations(options.steps)
    for name, feature in FEATURES.items():
        measure(name, feature, options.steps, options.rounds, made)
    size = Path(_core.__file__).stat().st_size / 1e6
    seconds = import_seconds(1 if options.quick else 5, options.quick)
    print_row(["import", "after torch", 1e6 * seconds, None, None, None, size])
    return 0


if __name__ == "__main__":
    sys.exit(main())
