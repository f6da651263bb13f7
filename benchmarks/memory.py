"""Peak memory of long and of large rollouts with gradients, each in a process of its own.

`long`: 100 cubes, 10,000 steps, `checkpoint_every` 100; should stay under 1 GiB. `large`: 10,000 cubes, 2 s in 200
steps, everything recorded; should stay under 4 GiB. The loss is a function of the final state, the gradient is with
respect to the initial state and the masses. Prints one CSV line per case: the peak of resident memory of the whole
process, Python and torch included, what was resident before the rollout, seconds, and the tape's bytes per step and
body.
"""

from __future__ import annotations

import resource
import sys
import time

import torch
from _common import in_fresh_process, make_parser, print_header, print_row, tape_bytes

import diffsim as ds
from diffsim import scenes

COLUMNS = ("case", "cubes", "steps", "checkpoint_every", "peak_mb", "before_mb", "seconds", "tape_bytes_per_body_step")
CASES = {"long": (100, 10_000, 100), "large": (10_000, 200, None)}
QUICK = {"long": (20, 200, 20), "large": (100, 50, None)}
DT = 0.01


def peak_megabytes() -> float:
    """Of this process so far; the unit is kB on Linux, bytes on macOS."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1024.0 if sys.platform != "darwin" else 1024.0**2)


def run(count: int, steps: int, every: int | None, threads: int) -> dict[str, float]:
    """In a fresh process."""
    torch.set_num_threads(1)
    sim = ds.Simulator(scenes.falling_cubes(count), dt=DT, num_threads=threads, on_failure="raise")
    sim.mass.requires_grad_()
    start = sim.initial_state()
    fields = ("position", "orientation", "velocity", "angular_velocity")
    inputs = {name: getattr(start, name).requires_grad_() for name in fields}
    before = peak_megabytes()
    clock = time.perf_counter()
    final = sim.rollout(start.replace(**inputs), None, steps, checkpoint_every=every)[-1]
    loss = final.position.square().sum() + final.velocity.square().sum()
    gradients = torch.autograd.grad(loss, [*inputs.values(), sim.mass])
    seconds = time.perf_counter() - clock
    assert all(bool(g.isfinite().all()) for g in gradients)
    peak = peak_megabytes()
    return {"peak": peak, "before": before, "seconds": seconds, "tape": tape_bytes(sim, start, 100) / (100 * count)}


def main() -> int:
    parser = make_parser(__doc__, cpu_time=False)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    print_header(clock=options.clock)
    print_row(COLUMNS)
    for name, (count, steps, every) in (QUICK if options.quick else CASES).items():
        found = in_fresh_process(run, count, steps, every, options.threads)
        print_row([name, count, steps, every, *(found[key] for key in ("peak", "before", "seconds", "tape"))])
    return 0


if __name__ == "__main__":
    sys.exit(main())
