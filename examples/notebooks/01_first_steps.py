# %% [markdown]
# # First steps
#
# A scene, its motion, the gradient of something that happens in it, and what to do with that gradient.
#
# Bodies are triangle meshes, or exact spheres and capsules; all units are SI, and z points up.

# %%
import matplotlib.pyplot as plt
import torch

import diffsim as ds

QUICK = False

# %%
scene = ds.Scene()
scene.add_ground()
ball = scene.add_sphere(radius=0.1, density=1000.0, position=(0.0, 0.0, 0.3), velocity=(2.0, 0.0, 0.0), name="ball")
crate = scene.add_body(ds.shapes.box(0.4), density=100.0, position=(1.25, 0.0, 0.21), name="crate")

sim = ds.Simulator(scene, dt=0.01)
sim

# %% [markdown]
# A `State` holds tensors: positions of the centres of mass, orientations, velocities. `sim(state)` takes one step,
# `sim.rollout` many: what it returns has a leading axis for time. What `add_sphere` returned is an index.

# %%
start = sim.initial_state()
trajectory = sim.rollout(start, None, steps=150)
print(trajectory)
print("the crate ends at", trajectory.position[-1, crate])

# %%
ds.viewer.picture(sim, trajectory, count=5, camera=ds.viewer.Camera(-70, 12))

# %% [markdown]
# `ds.viewer.show` plays the same in the notebook, to be turned around; `ds.viewer.record(sim, trajectory, "a.html")`
# writes it into a page that needs nothing but a browser.

# %%
ds.viewer.show(sim, trajectory)

# %% [markdown]
# ## How did the last step go?
#
# `sim.info` knows: whether every step converged, how many contacts there were, where the time went.

# %%
info = sim.info
print("converged:", info.converged, "- failed steps:", info.failed_steps)
print("contacts in the last step:", info.contacts, "- in groups of bodies:", info.zones)
print("milliseconds of the rollout:", info.milliseconds["total"])

# %% [markdown]
# ## A gradient
#
# How far the crate is pushed depends on how fast the ball is. Every step is differentiable, so PyTorch finds the
# derivative as it does for any network. `ds.diagnostics.gradcheck` holds it against central differences.

# %%
state = sim.initial_state()
state.velocity.requires_grad_()
end = sim.rollout(state, None, steps=150)[-1]
end.position[crate, 0].backward()
print("d(crate's place)/d(ball's velocity) =", state.velocity.grad[ball])

# %%
ds.diagnostics.gradcheck(sim, start, steps=20 if QUICK else 100)

# %% [markdown]
# ## An optimisation
#
# Which velocity brings the crate to x = 3 m? Newton's method for one unknown: divide what is missing by the
# derivative.

# %%
speed = torch.tensor(2.0, dtype=torch.float64)
history = []
for _ in range(6):
    speed.requires_grad_()
    velocity = start.velocity.clone()
    velocity[ball, 0] = speed
    place = sim.rollout(start.replace(velocity=velocity), None, steps=150).position[-1, crate, 0]
    (slope,) = torch.autograd.grad(place, speed)
    history.append((speed.item(), place.item()))
    speed = (speed + (3.0 - place) / slope).detach()

figure, axes = plt.subplots(figsize=(5, 3))
axes.plot([place for _, place in history], "o-")
axes.axhline(3.0, color="0.7")
axes.set(xlabel="iteration", ylabel="the crate's place [m]")
print(*(f"speed {v:.4f} m/s: place {x:.4f} m" for v, x in history), sep="\n")
assert abs(history[-1][1] - 3.0) < 0.02
