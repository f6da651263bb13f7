"""The gradient of one step against differences from either side, where a step may have a kink."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

import diffsim as ds

STEPS = (1e-6, 1e-7, 1e-8, 1e-9)  # contacts at rest are compressed by 1e-8 m and less
# Relative to the sum of what the entries contribute.
WRONG = 1e-4
KINK = 1e-2  # likewise: differences from both sides that are further apart
ROUNDING = 1e-12  # of the loss: of solutions good to 1e-14 m, in velocities


def wrong_derivatives(sim: ds.Simulator, state: ds.State, control: ds.Control, seed: int) -> tuple[int, list[str]]:
    """How many derivatives of one step could be held against differences, and those that are wrong.

    Each is along a random direction of one input, and is held against differences of several step sizes until it agrees
    with one from both sides. Where both sides never agree is a kink, often of several contacts at once, and what the
    derivative should be there is not known; it has to be finite. So is a place where contacts stick on one side
    and slip on the other.
    """
    rough = bool(sim.friction.any())
    generator = torch.Generator().manual_seed(seed)
    inputs = _inputs(sim, state, control)
    weights: dict[str, torch.Tensor] = {}

    def step(values: dict[str, torch.Tensor]) -> tuple[ds.State, ds.Control, dict[str, torch.Tensor]]:
        moved = state.replace(**{name: value for name, value in values.items() if hasattr(state, name)})
        parameters = {name: values[name] for name in ("friction",) if name in values}
        return moved, control.replace(force=values["force"]), parameters

    def statuses(values: dict[str, torch.Tensor]) -> list[Any]:
        if not rough:
            return []
        moved, force, parameters = step(values)
        contacts = sim.contacts(moved, force, parameters=parameters)
        return [contacts.objects.tolist(), contacts.sticking.tolist()]

    def loss(values: dict[str, torch.Tensor]) -> torch.Tensor:
        moved, force, parameters = step(values)
        end = sim(moved, force, parameters=parameters)
        total = torch.zeros((), dtype=torch.float64)
        for name in inputs:
            if hasattr(end, name):
                final = getattr(end, name)
                if name not in weights:
                    weights[name] = torch.randn(final.shape, generator=generator, dtype=torch.float64)
                total = total + (weights[name] * final).sum()
        return total

    leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    end = loss(leaves)
    if not sim.info.converged:
        return 0, []
    gradients = dict(zip(leaves, torch.autograd.grad(end, list(leaves.values()))))
    here, count, wrong = end.item(), 0, []
    with torch.no_grad():
        before = statuses(inputs)
    for name, value in inputs.items():
        direction = _direction(name, value, sim, generator)
        derivative = float((gradients[name] * direction).sum())
        scale = float((gradients[name] * direction).abs().sum())
        if not np.isfinite(derivative):
            wrong.append(f"derivative by {name} is not finite")
            continue
        found = ""
        for eps in STEPS:
            ends: list[float] = []
            for by in (-eps, eps):
                moved = value + by * direction
                if name == "orientation":
                    moved = moved / moved.norm(dim=-1, keepdim=True)
                try:
                    with torch.no_grad():
                        if statuses({**inputs, name: moved}) != before:
                            break
                        ends.append(loss({**inputs, name: moved}).item())
                except ValueError:  # a contact under load has less room than eps
                    break
                if not sim.info.converged:
                    break
            else:
                left, right = (here - ends[0]) / eps, (ends[1] - here) / eps
                size = max(scale, abs(left), abs(right))
                if abs(right - left) > KINK * size:
                    continue
                if abs(derivative - 0.5 * (left + right)) <= abs(right - left) + WRONG * size + ROUNDING / eps:
                    found = "right"
                    break
                found = f"derivative by {name} is {derivative:g}, differences say {left:g} and {right:g}"
        count += bool(found)
        if found not in ("", "right"):
            wrong.append(found)
    return count, wrong


def _inputs(sim: ds.Simulator, state: ds.State, control: ds.Control) -> dict[str, torch.Tensor]:
    names = ["position", "orientation", "velocity", "angular_velocity"]
    if state.node_position.numel():
        names += ["node_position", "node_velocity"]
    inputs = {name: getattr(state, name).detach() for name in names}
    inputs["force"] = torch.zeros_like(state.velocity) if control.force is None else control.force.detach()
    if bool(sim.friction.any()):
        inputs["friction"] = sim.friction.detach()
    return inputs


def _direction(name: str, value: torch.Tensor, sim: ds.Simulator, generator: torch.Generator) -> torch.Tensor:
    """A force as an acceleration, a quaternion's change as a turn."""
    direction = torch.randn(value.shape, generator=generator, dtype=torch.float64)
    if name == "friction":
        return value * direction  # what has none is not moved below zero
    if name == "force":
        return direction * sim.mass.detach()[:, None]
    if name == "orientation":
        return direction - value * (value * direction).sum(dim=-1, keepdim=True)
    if name.startswith("node"):
        return 0.1 * direction
    return direction
