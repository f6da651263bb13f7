"""Ctrl-C: a rollout and its backward stop between two steps, long before their end, and leave all as it was."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch

import diffsim as ds

DELAY = 0.1  # s, until the signal comes


def resting_boxes(num_threads: int) -> ds.Simulator:
    scene = ds.Scene()
    scene.add_ground()
    for k in range(3):
        scene.add_body(ds.shapes.box(0.4), density=100.0, position=(0.6 * k, 0, 0.21))
    return ds.Simulator(scene, dt=0.01, num_threads=num_threads)


@pytest.fixture(autouse=True)
def _ctrl_c_interrupts() -> Iterator[None]:
    """Workers of pytest-xdist ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@contextmanager
def ctrl_c() -> Iterator[None]:
    timer = threading.Timer(DELAY, os.kill, (os.getpid(), signal.SIGINT))
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        timer.join()


def seconds(call: Callable[[], Any]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def seconds_until_interrupted(call: Callable[[], Any]) -> float:
    def interrupted() -> None:
        with ctrl_c(), pytest.raises(KeyboardInterrupt):
            call()

    return seconds(interrupted)


@pytest.mark.parametrize(
    ("num_threads", "batch", "options"),
    [
        (1, None, {}),
        (2, None, {}),
        (1, 2, {}),
        (2, 4, {}),
        (2, 3, {"checkpoint_every": 10_000}),
        (1, None, {"progress": True}),
        (2, 2, {"progress": True, "checkpoint_every": 10_000}),
    ],
)
def test_a_rollout_stops(num_threads: int, batch: int | None, options: dict[str, Any]) -> None:
    sim = resting_boxes(num_threads)
    state = sim.initial_state(batch)
    part, parts = 200, 1500
    before = sim.rollout(state, None, part)
    with torch.no_grad():
        whole = parts * seconds(lambda: sim.rollout(state, None, part))
        info = sim.info
        assert whole > 10 * DELAY
        assert seconds_until_interrupted(lambda: sim.rollout(state, None, parts * part, **options)) < 0.5 * whole
    assert sim.info is info
    again = sim.rollout(state, None, part)
    assert torch.equal(again.position, before.position)


def test_the_waiting_thread_sees_the_signal() -> None:
    """The calling thread is soon done with its own scene, in which nothing touches, and waits for the other."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.4), density=100.0, position=(0, 0, 0.21))
    sim = ds.Simulator(scene, dt=0.01, num_threads=2)
    position = sim.initial_state(2).position
    position[0, 0, 2] = 1e6  # a free fall
    state = sim.initial_state(2).replace(position=position)
    with torch.no_grad():
        whole = 1000 * seconds(lambda: sim.rollout(state, None, 300))
        assert whole > 10 * DELAY
        assert seconds_until_interrupted(lambda: sim.rollout(state, None, 300_000)) < 0.5 * whole


@pytest.mark.parametrize("num_threads", [1, 2])
@pytest.mark.parametrize("checkpoint_every", [None, 1000])
def test_a_backward_stops(num_threads: int, checkpoint_every: int | None) -> None:
    sim = resting_boxes(num_threads)
    start = sim.initial_state(2 * num_threads)
    velocity = start.velocity.requires_grad_()
    steps, whole = 16_000 // len(velocity), 0.0
    while whole <= 2 * DELAY:  # or there is nothing to interrupt
        loss = sim.rollout(start.replace(velocity=velocity), None, steps, checkpoint_every).position[-1].sum()
        begin = time.perf_counter()
        (expected,) = torch.autograd.grad(loss, velocity, retain_graph=True)
        whole = time.perf_counter() - begin
        steps *= 2
    info = sim.info
    taken = seconds_until_interrupted(lambda: torch.autograd.grad(loss, velocity, retain_graph=True))
    assert taken < DELAY + 0.8 * (whole - DELAY)
    assert sim.info is info
    (again,) = torch.autograd.grad(loss, velocity)
    assert torch.equal(again, expected)


def test_what_a_handler_raises_comes_through() -> None:
    class Stop(Exception):
        pass

    def stop(*args: Any) -> None:
        raise Stop

    sim = resting_boxes(1)
    before = signal.signal(signal.SIGALRM, stop)
    try:
        signal.setitimer(signal.ITIMER_REAL, DELAY)
        with torch.no_grad(), pytest.raises(Stop):
            sim.rollout(sim.initial_state(), None, 100_000)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def test_handlers_that_raise_nothing_run_while_it_goes_on() -> None:
    calls: list[float] = []
    sim = resting_boxes(1)
    before = signal.signal(signal.SIGALRM, lambda *args: calls.append(time.perf_counter()))
    try:
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        with torch.no_grad():
            sim.rollout(sim.initial_state(), None, 20_000)
        end = time.perf_counter()
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert len(calls) == 1
    assert calls[0] < end
    assert sim.info is not None
    assert sim.info.converged
