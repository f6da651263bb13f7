"""The same square sheet in diffsim, in MuJoCo as a flex, and in Newton's VBD: one mesh, one material, equal masses."""

from __future__ import annotations

import contextlib
import importlib.util
import io
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray

import diffsim as ds

SIDE, THICK = 1.0, 1.0e-3  # of the sheet [m]
YOUNG, DENSITY, POISSON = 5.0e6, 374.0, 0.3  # rubber-like [Pa], [kg/m³]
DAMPING = 5.0e-4  # [s]
GRAVITY = (0.0, 0.0, -9.81)
RADIUS = 0.25  # of the sphere, whose centre is the origin [m]


@dataclass(frozen=True)
class Sheet:
    """A level sheet at rest, with or without a fixed sphere below it."""

    nodes: int  # along a side
    position: tuple[float, float, float]  # of its middle [m]
    pinned: tuple[int, ...] = ()
    sphere: bool = True
    self_contact: bool = True  # in MuJoCo; diffsim has it always, and VBD never (see cloth.py)

    @property
    def mesh(self) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
        return ds.shapes.sheet(SIDE, self.nodes)

    @property
    def points(self) -> NDArray[np.float64]:
        return self.mesh[0] + self.position

    @property
    def masses(self) -> NDArray[np.float64]:
        """Of the nodes: a third of the triangles around [kg]."""
        vertices, faces = self.mesh
        a, b, c = (vertices[faces[:, corner]] for corner in range(3))
        areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        return DENSITY * THICK / 3.0 * np.bincount(faces.ravel(), np.repeat(areas, 3))

    def gap(self, positions: NDArray[Any]) -> float:
        """From the sphere to the middle surface of the sheet, negative within [m]."""
        faces = self.mesh[1]
        nearest = trimesh.triangles.closest_point(positions[faces], np.zeros((len(faces), 3)))
        return float(np.linalg.norm(nearest, axis=1).min() - RADIUS)


def make_simulator(sheet: Sheet, dt: float, **options: Any) -> ds.Simulator:
    scene = ds.Scene(gravity=GRAVITY)
    if sheet.sphere:
        scene.add_sphere(RADIUS, density=1000.0, kind="static")
    material = ds.ClothMaterial.isotropic(YOUNG, THICK, DENSITY, POISSON, DAMPING)
    scene.add_cloth(sheet.mesh, material, pinned=list(sheet.pinned), position=sheet.position, margin=0.5 * THICK)
    return ds.Simulator(scene, dt=dt, num_threads=1, **options)


def make_flex(sheet: Sheet, dt: float, ipc: bool = False) -> Any:
    """A MuJoCo model, with the fastest options found that solve the step: CG to 1e-4.

    Its integrator "discrete" takes the stiffness of flexes into the step implicitly, linearised. By default steps in
    contact take 1.4 (21 x 21 nodes) to 16 times (101 x 101) as long, and 100 iterations are not enough for the largest.

    `ipc`: its contacts that keep surfaces apart, instead of its soft ones.
    """
    points, faces = sheet.points, sheet.mesh[1]
    pins = f'<pin id="{" ".join(map(str, sheet.pinned))}"/>' if sheet.pinned else ""
    sphere = f'<geom type="sphere" size="{RADIUS}" condim="1"/>' if sheet.sphere else ""
    self_contact = "auto" if sheet.self_contact else "none"
    elasticity = f'young="{YOUNG}" poisson="{POISSON}" thickness="{THICK}" elastic2d="both" damping="{DAMPING}"'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><size memory="2G"/><option timestep="{dt}" gravity="0 0 {GRAVITY[2]}"'
        ' integrator="discrete" solver="CG" tolerance="1e-4" iterations="500">'
        f'<flag ipc="{"enable" if ipc else "disable"}"/></option><worldbody>{sphere}'
        f'<flexcomp name="sheet" type="direct" dim="2" radius="{0.5 * THICK}" mass="{sheet.masses.sum()}"'
        f' point="{" ".join(map(repr, points.ravel().tolist()))}" element="{" ".join(map(str, faces.ravel()))}">'
        f'<elasticity {elasticity}/><contact selfcollide="{self_contact}" condim="1"/>{pins}'
        "</flexcomp></worldbody></mujoco>"
    )
    for node, mass in enumerate(sheet.masses):  # MuJoCo gives all the same
        if node not in sheet.pinned:
            model.body_mass[model.flex_vertbodyid[node]] = mass
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def raise_if_unstable(data: Any) -> None:
    if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:  # MuJoCo starts again from the beginning there
        raise RuntimeError("MuJoCo became unstable")


class VbdSheet:
    """The sheet in Newton's VBD solver, its step captured as a graph. Single precision."""

    def __init__(self, sheet: Sheet, dt: float, iterations: int = 10) -> None:
        import newton
        import warp

        self.warp = warp
        self.dt = dt
        vertices, faces = sheet.mesh
        lame, shear = YOUNG * THICK * POISSON / (1.0 - POISSON**2), YOUNG * THICK / (2.0 * (1.0 + POISSON))
        bend = YOUNG * THICK**3 / (12.0 * (1.0 - POISSON**2))
        builder = newton.ModelBuilder(gravity=GRAVITY)
        builder.add_cloth_mesh(
            pos=warp.vec3(*sheet.position),
            rot=warp.quat_identity(),
            scale=1.0,
            vel=warp.vec3(0.0, 0.0, 0.0),
            vertices=[warp.vec3(*vertex) for vertex in vertices.tolist()],
            indices=faces.ravel().tolist(),
            density=DENSITY * THICK,
            tri_ke=shear,
            tri_ka=lame,
            tri_kd=0.5 * DAMPING * shear,  # it acts on the rate of FᵀF, twice that of Green's strain
            edge_ke=1.2 * bend * (sheet.nodes - 1) / SIDE,  # 0.8 to 2.4 of the plate's, by direction: docs/cloth.md
            edge_kd=0.0,
            particle_radius=0.5 * THICK,
        )
        for node in sheet.pinned:
            builder.particle_mass[node] = 0.0
        if sheet.sphere:
            builder.add_shape_sphere(-1, radius=RADIUS)
        builder.color(include_bending=True)
        self.model = builder.finalize()
        self.model.soft_contact_ke, self.model.soft_contact_kd, self.model.soft_contact_mu = 1.0e4, 1.0e-4, 0.0
        self.solver = newton.solvers.SolverVBD(self.model, iterations=iterations)
        self.pipeline = (
            newton.CollisionPipeline(self.model, enable_rigid_soft_full_surface_contact=True) if sheet.sphere else None
        )
        self.contacts = self.pipeline.contacts() if self.pipeline else None
        self.start, self.state, self.next = self.model.state(), self.model.state(), self.model.state()
        self.control = self.model.control()
        self._launch()  # compiles its kernels
        with warp.ScopedCapture() as capture:
            self._launch()
        self.graph = capture.graph
        self.reset()

    def _launch(self) -> None:
        self.state.clear_forces()
        if self.pipeline:
            self.pipeline.collide(self.state, self.contacts)
        self.solver.step(self.state, self.next, self.control, self.contacts, self.dt)
        self.state.assign(self.next)

    def reset(self) -> None:
        self.state.assign(self.start)

    def step(self) -> None:
        self.warp.capture_launch(self.graph)

    @property
    def positions(self) -> NDArray[Any]:
        return self.state.particle_q.numpy()


def why_no_newton() -> str | None:
    """None if Newton runs here."""
    if importlib.util.find_spec("newton") is None:
        return "newton is not installed (pip install newton)"
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            import warp

            warp.config.quiet = True
            warp.init()
            warp.set_device("cpu")
            VbdSheet(Sheet(3, (0.0, 0.0, 2.0 * RADIUS)), 0.01)
    except Exception as error:  # whatever keeps it from running must not keep us from it
        return f"newton does not run here: {type(error).__name__}: {error}"
    return None
