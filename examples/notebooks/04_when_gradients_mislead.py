# %% [markdown]
# # When gradients mislead
#
# The gradients here are those of the steps that were run, to rounding. Exact is not the same as useful. Four ways in
# which an exact gradient tells little about where to go, and what helps: an earlier loss, several starts, friction that
# grows, and sampling beside gradients.

# %%
import matplotlib.pyplot as plt
import torch

import diffsim as ds

QUICK = False
torch.set_default_dtype(torch.float64)
COUNT = 101 if QUICK else 401


def ends(sim, body, starts, steps):
    """Where a body ends along x, for many places to start from, as one batch; and the derivative."""
    state = sim.initial_state(batch=len(starts))
    starts = starts.clone().requires_grad_()
    position = state.position.clone()
    position[:, body, 0] = starts
    trajectory = sim.rollout(state.replace(position=position), None, steps)
    x = trajectory.position[-1, :, body, 0]
    (slope,) = torch.autograd.grad(x.sum(), starts)
    return x.detach(), slope, trajectory.detach()


# %% [markdown]
# ## Chaos
#
# A ball falls through pegs. Every peg it meets spreads neighbouring ways further apart, so that after a few of them the
# derivative is large, changes its sign from one start to the next, and is the slope of a curve nobody would descend.

# %%
scene = ds.Scene()
for row in range(7):
    for column in range(-4, 5):
        place = (0.2 * column + 0.1 * (row % 2), 0.0, -0.18 * row)
        scene.add_sphere(0.03, kind="static", position=place)
ball = scene.add_sphere(0.04, mass=0.1, position=(0.013, 0.0, 0.2), name="ball")
pegs = ds.Simulator(scene, dt=0.005)

starts = torch.linspace(-0.05, 0.05, COUNT)
figure, axes = plt.subplots(1, 2, figsize=(10, 3))
sizes = []
for steps, color in ((40, "C0"), (90, "C1"), (150, "C3")):
    x, slope, trajectory = ends(pegs, ball, starts, steps)
    axes[0].plot(starts, x, ".", ms=2, color=color, label=f"after {steps} steps")
    axes[1].semilogy(starts, slope.abs() + 1e-12, ".", ms=2, color=color)
    sizes.append(slope.abs().median().item())
axes[0].set(xlabel="start [m]", ylabel="end [m]")
axes[0].legend()
axes[1].set(xlabel="start [m]", ylabel="|derivative|", ylim=(1e-4, None))
print("median size of the derivative:", [f"{size:.2g}" for size in sizes])

# %%
camera = ds.viewer.Camera(-90, 0)
ds.viewer.picture(pegs, trajectory[:, COUNT // 3], count=14, camera=camera, colors={ball: (0.9, 0.4, 0.2)})

# %% [markdown]
# What helps: a loss that looks earlier. Before the first pegs have been met the same question has a smooth answer, and
# a target for the way, not only for its end, keeps the gradient in the part of the motion that can be steered.

# %% [markdown]
# ## Dead contact
#
# A ball that misses the crate does not push it: the derivative of the crate's place is exactly zero, and no step of any
# optimiser leaves that plateau.

# %%
scene = ds.Scene()
scene.add_ground()
crate = scene.add_body(ds.shapes.box(0.3), density=100.0, position=(0.0, 0.6, 0.16), name="crate")
ball = scene.add_sphere(0.1, density=1000.0, position=(0.0, 0.0, 0.11), velocity=(0.0, 2.0, 0.0), name="ball")
sim = ds.Simulator(scene, dt=0.01)

starts = torch.linspace(-0.5, 0.5, COUNT)
state = sim.initial_state(batch=COUNT)
position = state.position.clone()
position[:, ball, 0] = starts
position.requires_grad_()
trajectory = sim.rollout(state.replace(position=position), None, 60)
pushed = trajectory.position[-1, :, crate, 1]
(gradient,) = torch.autograd.grad(pushed.sum(), position, retain_graph=True)
slope = gradient[:, ball, 0]
dead = slope == 0.0
print(f"{int(dead.sum())} of {COUNT} starts have no gradient at all")
assert 0 < dead.sum() < COUNT

figure, axes = plt.subplots(figsize=(5, 3))
axes.plot(starts, pushed.detach(), color="0.7")
axes.plot(starts[dead], pushed.detach()[dead], ".", ms=3, label="derivative zero")
axes.plot(starts[~dead], pushed.detach()[~dead], ".", ms=3, label="derivative not zero")
axes.set(xlabel="where the ball starts [m]", ylabel="where the crate ends [m]")
axes.legend()

# %% [markdown]
# What helps: several starts, in one batch, of which those that touch go on; or a term that pulls where nothing touches
# yet, such as the distance between ball and crate at their nearest.

# %%
nearest = (trajectory.position[:, :, ball] - trajectory.position[:, :, crate]).norm(dim=-1).amin(dim=0)
(pull,) = torch.autograd.grad(nearest.sum(), position)
toward = -pull[:, ball, 0] * starts  # negative: descending it leads to the crate
print(f"with that term {int((pull[dead, ball, 0] == 0.0).sum())} starts have no gradient")
assert (toward[dead & (starts.abs() > 0.2)] < 0.0).all()

# %% [markdown]
# ## Stiction
#
# A crate with friction, pushed for 0.3 s and then left alone. It sticks until the push is more than friction can hold,
# μ m g, and until then where it ends does not depend on the push at all: the derivative is zero to rounding, as it
# should be, and says nothing of how much is missing.

# %%
scene = ds.Scene()
scene.add_ground(friction=0.5)
crate = scene.add_body(ds.shapes.box(0.3), density=100.0, position=(0.0, 0.0, 0.1502), friction=0.5, name="crate")
sim = ds.Simulator(scene, dt=0.02)
bound = 0.5 * sim.mass[crate].item() * 9.81  # [N]
STEPS, PUSHED = 45, 15


def slide(pushes, friction=1.0):
    """Where the crate ends along x [m], for a batch of pushes [N], with a part of its friction."""
    force = torch.zeros(STEPS, len(pushes), 1, 3)
    force[:PUSHED, :, crate, 0] = pushes
    parameters = {"friction": friction * sim.friction.detach()}
    state = sim.initial_state(batch=len(pushes))
    return sim.rollout(state, ds.Control(force=force), STEPS, parameters=parameters).position[-1, :, crate, 0]


pushes = torch.linspace(0.0, 2.5 * bound, COUNT // 2).requires_grad_()
figure, axes = plt.subplots(figsize=(5, 3))
for part in (1.0, 0.5, 0.25):
    x = slide(pushes, part)
    (slope,) = torch.autograd.grad(x.sum(), pushes)
    axes.plot(pushes.detach() / bound, x.detach(), label=f"{part:g} of its friction")
    stuck = (slope.abs() < 1e-12).double().mean().item()
    print(f"{part:g} of its friction: no gradient at {100 * stuck:.0f} % of the pushes")
    assert 0.0 < stuck < 0.5
axes.set(xlabel="push, in units of μ m g", ylabel="where the crate ends [m]", ylim=(None, 2.0))
axes.legend()

# %% [markdown]
# What helps: several starts, as above. Or friction that grows: with little of it the crate moves and there is a slope
# to follow, and from one coefficient to the next the last push is nearly right. Here: the push that takes the crate to
# 0.5 m, from one that does not move it, by Newton steps on the one equation there is.

# %%
target = 0.5
push = torch.tensor([0.5 * bound])
for part in (0.2, 0.4, 0.6, 0.8, 1.0, 1.0, 1.0):
    x = slide(push.requires_grad_(), part)
    (slope,) = torch.autograd.grad(x.sum(), push)
    print(f"{part:g} of its friction: {push.item():.2f} N takes it to {x.item():.3f} m, slope {slope.item():.3f} m/N")
    push = (push - (x - target) / slope).detach()
reached = slide(push).item()
print(f"{push.item():.2f} N takes it to {reached:.4f} m")
assert abs(reached - target) < 1e-3

# %% [markdown]
# A third way is to say what is missing: what holds a crate that sticks has no gradient, but what it could be held with
# has. `sim.contacts(state, control).normal_force` times μ, less the push, is a term that pulls until the crate moves.

# %% [markdown]
# ## Discontinuities
#
# A crate dropped on its edge onto the edge of a ridge slides off to the left or to the right. Where it ends jumps at
# the ridge; on both sides the derivative is exact, and says nothing of the jump. (A ball's way would be steep there,
# and not jump: what it touches turns the way it is pushed little by little.)

# %%
scene = ds.Scene()
scene.add_ground()
ridge = ds.shapes.prism([(-0.3, 0.0), (0.3, 0.0), (0.0, 0.3)], 0.4)
scene.add_body(ridge, kind="static", position=(0.0, 0.0, 0.002), orientation=(1.0, 1.0, 0.0, 0.0), name="ridge")
crate = scene.add_body(
    ds.shapes.box(0.12), density=200.0, position=(0.0, 0.0, 0.45), orientation=(1.0, 0.0, 0.41421, 0.0), name="crate"
)
sim = ds.Simulator(scene, dt=0.01)
starts = torch.linspace(-0.1, 0.1, COUNT)
x, slope, trajectory = ends(sim, crate, starts, 50)

figure, axes = plt.subplots(figsize=(5, 3))
axes.plot(starts, x, ".", ms=2)
axes.set(xlabel="start [m]", ylabel="end [m]")
print("derivatives are at most", slope.abs().max().item())

# %% [markdown]
# What helps: sampling. Let the start be uncertain by σ: the mean end is then smooth in the mean start, and its slope
# counts the jump. Averaging derivatives does not find that slope, however many are averaged, since none of them sees
# the jump; weighing the ends by how the samples were drawn does (the score function), at the price of noise.

# %%
sigma, samples = 0.02, 200 if QUICK else 2000
noise = sigma * torch.randn(samples, generator=torch.Generator().manual_seed(0))
x, slope, _ = ends(sim, crate, noise, 50)
by_derivatives = slope.mean()
by_sampling = (x * noise).mean() / sigma**2
print(f"slope of the mean end at the ridge: mean of derivatives {by_derivatives:.1f}, score function {by_sampling:.1f}")
assert by_sampling > 2.0 * by_derivatives
