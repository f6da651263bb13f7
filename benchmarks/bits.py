"""Fingerprints of states and gradients: what a change that should change nothing is held to.

Eight scenes in which all of the step takes part: free fall and impacts, a heap, a stack at rest, hard contacts, a
driven body, cloth with a body on it, cloth in split coupling, and a batch. One CSV line each, with the first digits of
the SHA-256 of the final state's bits and of those of a loss's gradient. They are equal on one machine for as long as no
sum changes its order; nothing is timed.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Callable, Iterable

import numpy as np
import torch
from _common import STATE_FIELDS, Recorded, Table, make_parser, print_header
from torch import Tensor

import diffsim as ds
from diffsim import scenes

COLUMNS = ("scene", "steps", "state", "gradient")


def ball_on_sheet() -> ds.Scene:
    scene = ds.Scene()
    scene.add_cloth(ds.shapes.sheet(1.0, 9), pinned=[0, 8, 72, 80], name="sheet")
    scene.add_body(ds.shapes.icosphere(0.15, 1), density=300.0, position=(0.03, 0.01, 0.17), name="ball")
    return scene


def heap(**options: object) -> ds.Simulator:
    return ds.Simulator(scenes.tumbling_layers(2, layers=2), dt=0.01, **options)


CASES: dict[str, Callable[[], ds.Simulator]] = {
    "falling_cubes": lambda: ds.Simulator(scenes.falling_cubes(5, drop=0.2), dt=0.01),
    "heap": heap,
    "stack": lambda: ds.Simulator(scenes.two_layer_stack(5), dt=0.01),
    "hard": lambda: heap(compliance=0.0),
    "driven": lambda: ds.Simulator(scenes.kinematic_pusher(), dt=0.01),
    "cloth": lambda: ds.Simulator(ball_on_sheet(), dt=0.01),
    "split": lambda: ds.Simulator(ball_on_sheet(), dt=0.01, coupling="split"),
    "batch": lambda: ds.Simulator(scenes.touching_boxes(4), dt=0.01),
}


def fingerprint(tensors: Iterable[Tensor]) -> str:
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(np.ascontiguousarray(tensor.detach().numpy()).tobytes())
    return digest.hexdigest()[:16]


def main() -> int:
    parser = make_parser(__doc__, cpu_time=False)
    parser.add_argument("--steps", type=int, default=80)
    options = parser.parse_args()
    steps = 2 if options.quick else options.steps
    torch.set_num_threads(1)
    print_header(clock=options.clock)
    table = Table(COLUMNS)
    for name, make in CASES.items():
        sim = make()
        start = sim.initial_state(batch=3) if name == "batch" else sim.initial_state()
        if name == "batch":
            start = start.replace(velocity=start.velocity + torch.linspace(-0.3, 0.3, 9).reshape(3, 1, 3))
        final = sim.rollout(start, None, steps)[-1]
        gradient = Recorded(sim, start, steps).backward()
        state = fingerprint(getattr(final, field) for field in STATE_FIELDS)
        table.add({"scene": name, "steps": steps, "state": state, "gradient": fingerprint(gradient)})
    return 0


if __name__ == "__main__":
    sys.exit(main())
