"""Steps in which energy rises by more than the scheme's own error can make it.

A step ends where forces at its end act on motions over it, which turns curve. With F a contact's normal force, θ what
its objects turn in the step, r the arms from their centres and s how far they slip past each other, that gives at most

    F (½ |θ_a|² r_a + ½ |θ_b|² r_b + |s| (|θ_a| + |θ_b|))

to the order of the square of the step, and of the next order as much more as |θ_a| + |θ_b| is of 1. Friction itself
gives nothing, since |λ| s is what it takes. Besides, contacts give back what the last step has compressed them by,
F² dt² compliance / (2 reduced mass).
"""

from __future__ import annotations

import torch
from torch import Tensor

import diffsim as ds

ROUNDING = 1e-9  # of the energy there is


def rises_of_energy(sim: ds.Simulator, frames: list[ds.State], control: ds.Control | None = None) -> list[str]:
    """Of bodies under a constant control, none of them driven, from state to state. Empty if there is none."""
    assert not bool((sim._packed.kind == 2).any()) and not frames[0].node_position.numel()
    path = ds.State.stack([frame.detach() for frame in frames])
    energy = sim.kinetic_energy(path) + sim.potential_energy(path)
    rise = energy.diff()
    if control is not None and control.force is not None:
        rise = rise - (control.force.detach() * path.position.diff(dim=0)).sum(dim=(1, 2))
    # Of height no more counts than what is fallen.
    rounding = ROUNDING * (energy - energy.min() + sim.kinetic_energy(path).max())[1:]
    found = []
    for k in (rise > rounding).nonzero().flatten().tolist():
        with torch.no_grad():
            room = rounding[k] + by_curved_motion(sim, sim.contacts(frames[k].detach(), control))
            if k > 0:
                room = room + in_contacts(sim, sim.contacts(frames[k - 1].detach(), control))
        if rise[k] > room:
            kinetic = sim.kinetic_energy(path[k])
            text = f"energy rose by {rise[k]:.2g} J in step {k + 1}, may by {room:.2g} J, was {kinetic:.2g} J of motion"
            found.append(text)
    return found


def by_curved_motion(sim: ds.Simulator, contacts: ds.Contacts) -> Tensor:
    """The bound above, of a step's contacts [J]."""
    shift, turn, arms = [], [], []
    end = contacts.end
    for objects in contacts.objects.T:
        moves = (objects < len(end.position))[:, None]  # the ground does not
        body = objects.clamp(max=len(end.position) - 1)
        arm = torch.where(moves, contacts.position - end.position[body], 0.0)
        angle = torch.where(moves, sim.dt * end.angular_velocity[body], 0.0)
        shift.append(torch.where(moves, sim.dt * end.velocity[body], 0.0) + torch.linalg.cross(angle, arm))
        turn.append(angle.norm(dim=-1))
        arms.append(arm.norm(dim=-1) + 0.5 * contacts.distance * moves[:, 0])  # to the surfaces
    apart = shift[0] - shift[1]
    slip = (apart - (apart * contacts.normal).sum(dim=-1, keepdim=True) * contacts.normal).norm(dim=-1)
    curved = sum(0.5 * angle.square() * arm for angle, arm in zip(turn, arms)) + slip * (turn[0] + turn[1])
    return (contacts.normal_force.norm(dim=-1) * curved * (1.0 + turn[0] + turn[1])).sum()


def in_contacts(sim: ds.Simulator, contacts: ds.Contacts) -> Tensor:
    """What is stored in them [J]."""
    inverse = torch.where(sim.mass > 0.0, 1.0 / sim.mass, 0.0)
    inverse = torch.cat([inverse, torch.zeros(1, dtype=torch.float64)])
    both = inverse[contacts.objects.clamp(max=len(sim.mass))].sum(dim=-1)
    compliance = float(sim._settings["compliance"])
    return (0.5 * contacts.normal_force.square().sum(dim=-1) * both).sum() * compliance * sim.dt**2
