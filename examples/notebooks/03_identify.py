# %% [markdown]
# # What is it made of? Identification with intervals
#
# From a noisy recording of a motion: the mass of a ball, how stiff the sheet is that it falls on, the moment of
# inertia of a box that is turned by a known torque, and the coefficient of friction between a sled and the table it
# slides to rest on; each with an interval that says how well the recording determines it. Gradients give the Jacobian
# of all that was recorded, Gauss-Newton the rest.

# %%
import matplotlib.pyplot as plt
import torch
from torch.func import functional_call

import diffsim as ds

QUICK = False
torch.set_default_dtype(torch.float64)

# %%
NODES, STEPS, EVERY = 7, (24 if QUICK else 45), 3  # every third step is recorded
vertices, faces = ds.shapes.sheet(1.0, NODES)
rim = abs(vertices[:, :2]).max(axis=1) > 0.49
rubber = ds.ClothMaterial.isotropic(young=1e6, thickness=1e-3, density=400.0, damping=0.02)

scene = ds.Scene()
sheet = scene.add_cloth((vertices, faces), rubber, pinned=rim, name="sheet")
ball = scene.add_sphere(0.1, mass=0.3, position=(0.0, 0.0, 0.2), name="ball")
box = scene.add_body(ds.shapes.box((0.2, 0.3, 0.1)), mass=1.0, position=(1.0, 0.0, 1.0), name="box")
table = scene.add_body(ds.shapes.box((1.6, 0.5, 0.1)), kind="static", position=(0.0, 1.0, -0.05), friction=0.3)
size = (0.2, 0.15, 0.1)
place, push = (-0.6, 1.0, 0.051), (1.5, 0.0, 0.0)
sled = scene.add_body(ds.shapes.box(size), density=500.0, position=place, velocity=push, friction=0.3, name="sled")
sim = ds.Simulator(scene, dt=0.02)
start = sim.initial_state()
torque = torch.zeros(len(sim.body_names), 3)
torque[box, 2] = 0.05  # [N·m], known

# %% [markdown]
# ## The model: from four unknowns to what was recorded
#
# Logarithms keep the unknowns positive, and make their errors relative ones. `functional_call` exchanges the
# simulator's parameters, by name, for tensors that gradients reach. Of friction only the coefficient of a pair shows,
# $\sqrt{\mu_1 \mu_2}$: sled and table get the same.

# %%
NAMES = ("mass of the ball [kg]", "stretch of the sheet [N/m]", "inertia of the box [kg·m²]", "friction")
NOISE = torch.tensor([2e-3, 1e-2, 5e-3])  # of heights [m], of the sine of half the angle, of the sled's place [m]


class Rollout(torch.nn.Module):
    def __init__(self, sim):
        super().__init__()
        self.sim = sim

    def forward(self, *arguments):
        return self.sim.rollout(*arguments)


def recorded(logs):
    mass, stretch, moment, coefficient = torch.exp(logs)
    masses, inertia, friction = sim.mass.clone(), sim.inertia.clone(), sim.friction.clone()
    masses[ball] = mass
    inertia[box, 2, 2] = moment
    friction[[table, sled]] = coefficient
    parameters = {
        "sim.mass": masses,
        "sim.inertia": inertia,
        "sim.friction": friction,
        "sim.cloth_stretch": stretch[None],
        "sim.cloth_shear": sim.cloth_shear / sim.cloth_stretch * stretch,  # it is one material
    }
    trajectory = functional_call(Rollout(sim), parameters, (start, ds.Control(torque=torque), STEPS))
    seen = trajectory[EVERY - 1 :: EVERY]
    channels = (seen.position[:, ball, 2], seen.orientation[:, box, 3], seen.position[:, sled, 0])
    return torch.cat([channel / noise for channel, noise in zip(channels, NOISE)])


# %% [markdown]
# The recording is made by the truth, with noise. Everything is in units of that noise.

# %%
true = (sim.mass[ball], sim.cloth_stretch[0], sim.inertia[box, 2, 2], sim.friction[sled])
truth = torch.log(torch.stack(true)).detach()
with torch.no_grad():
    clean = recorded(truth)
observed = clean + torch.randn(clean.shape, generator=torch.Generator().manual_seed(0))

# %% [markdown]
# ## Gauss-Newton
#
# The Jacobian row by row, a backward pass each: there are few observations, and fewer unknowns.


# %%
def jacobian(logs):
    logs = logs.clone().requires_grad_()
    values = recorded(logs)
    rows = [torch.autograd.grad(value, logs, retain_graph=True)[0] for value in values]
    return values.detach(), torch.stack(rows)


logs = truth + torch.tensor([0.5, -0.7, 0.6, 0.5])  # wrong by factors of about two
for iteration in range(8):
    values, J = jacobian(logs)
    step = torch.linalg.lstsq(J, observed - values).solution
    logs = logs + step.clamp(-0.5, 0.5)
    print(f"{iteration}: misfit {(observed - values).square().mean():.3g}, largest step {step.abs().max():.1e}")
    if step.abs().max() < 1e-6:
        break
assert step.abs().max() < 1e-3

# %% [markdown]
# ## Intervals
#
# With noise of variance one the estimate's covariance is $(J^T J)^{-1}$: twice the root of its diagonal is an interval
# that should hold the truth 19 times of 20. It is a statement about the noise; what the model leaves out is not in it.
# Of four such intervals at least one misses in one recording out of five: here, by a little, that of friction.

# %%
covariance = torch.linalg.inv(J.T @ J)
half = 1.96 * covariance.diagonal().sqrt()
for name, value, width, true in zip(NAMES, logs, half, truth):
    low, high = torch.exp(value - width), torch.exp(value + width)
    print(f"{name}: {value.exp():.4g}, 95 % from {low:.4g} to {high:.4g}; the truth is {true.exp():.4g}")
assert ((logs - truth).abs() < 2.0 * half).all()

# %% [markdown]
# Which unknowns does the recording tell apart? A heavier ball and a softer sheet look alike at the lowest point, less
# so in how long the rebound takes. Friction shows only while something slips: of a sled at rest only that it did stop.

# %%
deviation = covariance.diagonal().sqrt()
print("correlations:")
print((covariance / deviation[:, None] / deviation).round(decimals=2))

# %%
with torch.no_grad():
    fitted = recorded(logs)
count = len(clean) // 3
times = sim.dt * EVERY * torch.arange(1, count + 1)
figure, axes = plt.subplots(1, 3, figsize=(12, 3))
for k, label in enumerate(("height of the ball [m]", "sine of half the box's angle", "place of the sled [m]")):
    part = slice(k * count, (k + 1) * count)
    axes[k].plot(times, NOISE[k] * observed[part], ".", label="recorded")
    axes[k].plot(times, NOISE[k] * fitted[part], label="fitted")
    axes[k].set(xlabel="time [s]", ylabel=label)
axes[0].legend()
