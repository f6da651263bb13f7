# %% [markdown]
# # An inverse problem
#
# A marble lies on a sheet of rubber that is stretched between four corners. Which horizontal force, free to change at
# each of 50 steps, takes it to a target within two seconds, and is the least that does? That is a hundred unknowns, and
# one gradient says what to do with all of them.
#
# `examples/marble_inverse.py` is the same problem for five targets, beside CMA-ES, which is still two to
# five times further from the solution after a hundred times as many simulations.

# %%
import math
import warnings

import matplotlib.pyplot as plt
import torch

import diffsim as ds

QUICK = False

# %%
warnings.simplefilter("ignore", ds.UnitsWarning)  # the marble is as light as a toy balloon, on purpose
NODES, STEPS = 9, 50
vertices, faces = ds.shapes.sheet(1.0, NODES)
corners = [0, NODES - 1, NODES * (NODES - 1), NODES * NODES - 1]
rubber = ds.ClothMaterial.isotropic(young=2e6, thickness=1e-3, density=374.0, damping=0.02)

scene = ds.Scene(gravity=(0.0, 0.0, -4.0))
scene.add_cloth((vertices, faces), rubber, pinned=corners, rest=vertices / 1.05, name="sheet")  # stretched by 5 %
marble = scene.add_sphere(0.08, mass=0.0042, position=(0.04, -0.01, 0.1), name="marble")
sim = ds.Simulator(scene, dt=0.04)
start = sim.initial_state()

# %% [markdown]
# The objective: squared distance from the target in the end, plus the squared force. Nothing pushes upwards.

# %%
target = torch.tensor([-0.18, 0.15], dtype=torch.float64)


def objective(force):
    push = torch.nn.functional.pad(force, (0, 1))[:, None]  # (steps, bodies, 3)
    trajectory = sim.rollout(start, ds.Control(force=push), STEPS)
    off = trajectory.position[-1, marble, :2] - target
    return off.square().sum() + 20.0 * force.square().sum(), trajectory


# %% [markdown]
# ## Gradient descent
#
# With a constant step. The marble answers to a force almost as a free particle would, whose response is linear: then
# the right step solves the problem at once, and the curves of the sheet take a few more.

# %%
force = torch.zeros(STEPS, 2, dtype=torch.float64, requires_grad=True)
values = []
for _ in range(5):
    value, trajectory = objective(force)
    (gradient,) = torch.autograd.grad(value, force)
    values.append(value.item())
    force = (force - 8e-5 * gradient).detach().requires_grad_()
print("objective:", [f"{v:.2e}" for v in values])
assert values[-1] < 0.01 * values[0]

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3))
left.semilogy(values, "o-")
left.set(xlabel="iteration", ylabel="objective [m²]")
right.plot(0.04 * torch.arange(STEPS), 1e3 * force.detach())
right.set(xlabel="time [s]", ylabel="force [mN]")
right.legend(["x", "y"])

# %% [markdown]
# Most of the push comes early, when it still has time to carry the marble, and none is left at the end.

# %%
ds.viewer.picture(sim, trajectory.detach(), times=[0.0, 0.8, 1.4, 1.96], camera=ds.viewer.Camera(-60, 38))

# %%
ds.viewer.show(sim, trajectory)

# %% [markdown]
# ## L-BFGS
#
# Where the step is not known, a quasi-Newton method with a line search finds it. Give it unknowns of order one: here
# forces in units of the square root of the step that descent took.

# %%
unknowns = torch.zeros(STEPS, 2, dtype=torch.float64, requires_grad=True)
optimizer = torch.optim.LBFGS([unknowns], max_iter=4 if QUICK else 12, line_search_fn="strong_wolfe")
evaluations = []


def closure():
    optimizer.zero_grad()
    value, _ = objective(math.sqrt(8e-5) * unknowns)
    value.backward()
    evaluations.append(value.item())
    return value


optimizer.step(closure)
print(f"{len(evaluations)} simulations: {min(evaluations):.3e}, descent: {values[-1]:.3e}")
