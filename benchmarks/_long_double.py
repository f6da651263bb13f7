"""What rounding leaves of a step's gradient: the linear system of its contacts, solved in long double."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

import diffsim as ds
from diffsim.diagnostics import ContactSystem

LongArray = NDArray[np.longdouble]

#: Where long double is no more than double (Windows, Apple's processors) there is nothing to measure by.
AVAILABLE = bool(np.finfo(np.longdouble).eps < 1e-3 * np.finfo(np.float64).eps)
_ENOUGH = 1e-17  # a correction of this relative size no longer shows in double
_MOST_STEPS = 20


def solve(system: ContactSystem, v: NDArray[np.float64]) -> tuple[LongArray, LongArray]:
    """The solution z, and Jᵀ λ, of [A Jᵀ; J -1/K] [z; λ] = [v; 0] (Eq. 9 of Qiao et al., ICML 2020).

    A solution in double, of (A + Jᵀ K J) z = v, is refined: the residuals of both rows are taken in long double,
    corrections are solved for in double, until they no longer show. What is left is the rounding of long double, about
    2,000 times smaller than that of double, for the price of some products instead of a factorization.
    """
    A, J = (np.asarray(matrix, dtype=np.longdouble) for matrix in (system.inertia, system.jacobian))
    K = np.asarray(system.stiffness, dtype=np.longdouble)
    inverse = np.linalg.inv(system.inertia + system.jacobian.T @ (system.stiffness[:, None] * system.jacobian))
    z, pulled, multipliers = np.zeros_like(A[0]), np.zeros_like(A[0]), np.zeros_like(K)
    for _ in range(_MOST_STEPS):
        of_motion, of_contacts = v - A @ z - pulled, multipliers / K - J @ z
        step = np.asarray(inverse @ (of_motion + J.T @ (K * of_contacts)).astype(np.float64), dtype=np.longdouble)
        more = K * (J @ step - of_contacts)
        z += step
        multipliers += more
        pulled = J.T @ multipliers
        if _small(step, z) and _small(J.T @ more, pulled):
            return z, pulled
    raise ArithmeticError("the refinement does not converge: the system is too badly conditioned")


def _small(change: LongArray, value: LongArray) -> bool:
    return bool(np.linalg.norm(change) <= _ENOUGH * np.linalg.norm(value))


def rounding(sim: ds.Simulator, state: ds.State, seed: int = 0) -> float | None:
    """How far gradients of one step by ``adjoint="dense"`` or ``"qr"`` are from those in long double.

    With a loss that has random weights on the bodies' velocities at the end of the step, d(loss)/d(velocity) is dt m z,
    d(loss)/d(position) is -Jᵀ λ, both for the shift: the larger of their relative errors, over the bodies that touch
    something. None where long double is no longer than double.
    """
    if not AVAILABLE:
        return None
    weights = np.random.default_rng(seed).standard_normal((len(sim.body_names), 6))
    touching, by_velocity, by_position = [], [], []
    for system in ds.diagnostics.contact_systems(sim, state):
        z, pulled = solve(system, weights[system.bodies].ravel() / sim.dt)
        shift = (np.arange(len(z)) % 6) >= 3
        touching.append(system.bodies)
        by_velocity.append(np.longdouble(sim.dt) * system.inertia.diagonal()[shift] * z[shift])
        by_position.append(-pulled[shift])

    inputs = [t.clone().requires_grad_() for t in (state.velocity, state.position)]
    end = sim(state.replace(velocity=inputs[0], position=inputs[1]))
    upstream = [torch.from_numpy(np.ascontiguousarray(w)) for w in (weights[:, :3], weights[:, 3:])]
    gradients = torch.autograd.grad([end.angular_velocity, end.velocity], inputs, upstream)
    errors = []
    for gradient, parts in zip(gradients, (by_velocity, by_position)):
        reference = np.concatenate(parts)
        error = gradient.numpy()[np.concatenate(touching)].ravel() - reference
        errors.append(np.linalg.norm(error) / np.linalg.norm(reference))
    return float(max(errors))
