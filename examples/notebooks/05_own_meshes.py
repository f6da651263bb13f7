# %% [markdown]
# # Meshes of your own
#
# Load, look, repair, scale: from a scan to a body. The scan is the Stanford bunny that comes with `pymeshfix`.

# %%
import importlib.util
import warnings
from pathlib import Path

import pymeshfix
import trimesh

import diffsim as ds

QUICK = False
path = Path(importlib.util.find_spec("pymeshfix").origin).parent / "examples" / "StanfordBunny.ply"
scan = trimesh.load(path, force="mesh")
print(f"{len(scan.faces)} faces, closed: {scan.is_watertight}, size {scan.extents.round(3)}")

# %% [markdown]
# ## What a body needs
#
# A dynamic body's mass is spread over its volume, so its mesh must be closed. The error says what is wrong and what
# mends it. (With `mass=` and `inertia=` an open mesh will do; static bodies, a terrain say, may always be open.)

# %%
try:
    ds.Scene().add_body(scan, density=500.0, name="bunny")
except ValueError as error:
    print(error)
else:
    raise AssertionError("the scan is closed")

# %% [markdown]
# ## Repair
#
# Contact costs by the triangle, and fine ones buy little: a few hundred are plenty for a body. `pymeshfix` closes what
# is left; decimation may open a mesh that was closed, so repair comes after it.


# %%
def repaired(mesh):
    fixed = pymeshfix.MeshFix(mesh.vertices, mesh.faces)
    fixed.repair()
    return trimesh.Trimesh(fixed.points, fixed.faces)


bunny = repaired(scan.simplify_quadric_decimation(face_count=300 if QUICK else 800))
print(f"{len(bunny.faces)} faces, closed: {bunny.is_watertight}, volume {bunny.volume:.3g}")
assert bunny.is_watertight

# %% [markdown]
# ## Scale
#
# Everything is in metres, and a mesh does not say what it was drawn in. Objects too large or too small to be meant draw
# a warning; `scale=` takes the metres in one unit of the mesh, before anything is made of it.

# %%
size = 0.15  # the bunny's longest side [m]
in_millimetres = bunny.copy()
in_millimetres.apply_scale(1000.0 * size / bunny.extents.max())
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    ds.Scene().add_body(in_millimetres, density=500.0, name="bunny")
print(*(w.message for w in caught), sep="\n")

# %% [markdown]
# ## Look
#
# Margins and thickness are not drawn: what keeps two bodies apart is their mesh, and a thousandth of their size.

# %%
scene = ds.Scene()
scene.add_ground()
for k in range(2):
    scene.add_body(
        in_millimetres,
        scale=0.001,
        density=500.0,
        position=(0.03 * k, 0.0, 0.1 + 0.22 * k),
        orientation=(1.0, 1.0 - k, 0.0, 0.5 * k),
        name=f"bunny {k}",
    )
sim = ds.Simulator(scene, dt=0.01)
start = sim.initial_state()
print("mass [kg]:", sim.mass.tolist())
print("inertia [kg·m²]:", sim.inertia[0].diagonal().tolist())
ds.viewer.picture(sim, start, camera=ds.viewer.Camera(-60, 10))

# %%
trajectory = sim.rollout(start, None, steps=20 if QUICK else 80)
assert sim.info.converged
ds.viewer.picture(sim, trajectory, count=3, camera=ds.viewer.Camera(-60, 10))

# %%
ds.viewer.show(sim, trajectory)
