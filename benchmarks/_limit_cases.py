"""The cases of `limits.py`. One entry of a family is one case; what is expected of it is written down beside it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from _limit_friction import ball_on_a_slope, box_between_walls, box_on_a_slope, card_house, heap, rod_on_its_tip

import diffsim as ds
from diffsim import scenes

# Reasons for which a case may be red today.
IMPACTS = "no impact stage: a step that is long for a fast or squeezed body has too much to solve"
TURNS = (
    "no impact stage: a body that turns by a radian in a step is hit where the step ends, along a chord of its arc,"
    " which may give it the energy that docs/friction.md bounds; in steps of a tenth of a radian it gives none"
)
THIN = "thin cards slide on their edges: normals turn by much over a slip"
HORIZON = 0.5  # of most cases [s]


@dataclass(frozen=True)
class Case:
    """What is built and run, and what is expected: of every case finite numbers, no penetration, finite gradients."""

    family: str
    value: str
    build: Callable[[], ds.Scene]
    expect: str  # in words
    dt: float = 0.01
    steps: int = 50
    energy: float = 0.01  # made by contact at most, as a part of what is lost
    gradient: float = 1e-4  # median relative error of the directional derivatives at most
    still: float | None = None  # nothing may move further than this [m]
    stop: float | None = None  # no body that yields may get beyond this x [m]
    options: dict[str, Any] = field(default_factory=dict)  # of the simulator
    refusal: str = ""  # of the documented error that is right here, a part of its text
    reason: str = ""  # what is missing, where the case is known to fail
    quick: bool = False


_CONVERGES = "every step converges"
_SPEAKS = "converges, or says which step did not; never penetrates"
_STANDS = "every step converges, and it stands"
_ARCH_GAP = 1e-4  # between stones, and their thickness [m]


def _decades(first: int, last: int, step: int = 1) -> list[float]:
    return [10.0**k for k in range(first, last + 1, step)]


# ---- masses, stiffness, compliance, dt -------------------------------------------------------------------------------


def _heavy_on_light(ratio: float, friction: float = 0.0) -> ds.Scene:
    scene = ds.Scene()
    scene.add_ground(friction=friction)
    for k, mass in enumerate((1.0, ratio)):
        turned = (math.cos(0.1 * k), 0.0, 0.0, math.sin(0.1 * k))
        position = (0.02 * k, 0.0, 0.11 + 0.22 * k)
        scene.add_body(ds.shapes.box(0.2), mass=mass, position=position, orientation=turned, friction=friction)
    return scene


def _ball_on_cloth(stiffness: float) -> ds.Scene:
    scene = ds.Scene()
    material = ds.ClothMaterial(density=0.3, stretch=stiffness, shear=0.3 * stiffness, bend=1e-6 * stiffness)
    scene.add_cloth(ds.shapes.sheet(1.0, 8), material, pinned=[0, 7, 56, 63], margin=1e-3)
    scene.add_sphere(0.1, mass=0.1, position=(0.03, 0.02, 0.15))
    return scene


def _tilted_on_box() -> ds.Scene:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box((0.4, 0.4, 0.2)), density=500.0, position=(0.0, 0.0, 0.101))
    turned = ds.rotation.from_rpy(np.array([0.3, 0.2, 0.1]))
    scene.add_body(ds.shapes.box(0.2), density=500.0, position=(0.03, 0.02, 0.45), orientation=turned)
    return scene


# ---- sizes, speeds ---------------------------------------------------------------------------------------------------


def _scaled(size: float) -> ds.Scene:
    """Two boxes fall `size` / 4 far; gravity as large as keeps the time of the fall."""
    scene = ds.Scene(gravity=(0.0, 0.0, -9.81 * size))
    scene.add_ground()
    scene.add_body(ds.shapes.box(size), density=500.0, position=(0.0, 0.0, 0.75 * size))
    turned = ds.rotation.from_rpy(np.array([0.3, 0.2, 0.1]))
    position = (0.1 * size, 0.05 * size, 2.3 * size)
    scene.add_body(ds.shapes.box(size), density=500.0, position=position, orientation=turned)
    return scene


def _all_sizes() -> ds.Scene:
    scene = ds.Scene()
    scene.add_ground()
    x = 0.0
    for size in _decades(-4, 3):
        x += 1.2 * size
        scene.add_body(ds.shapes.box(size), density=500.0, position=(x, 0.0, 0.5 * size + 1e-3 * size))
        x += 1.2 * size
    return scene


def _fast(speed: float) -> ds.Scene:
    """At a wall 1 m away, and past it if it could."""
    scene = ds.Scene(gravity=(0.0, 0.0, 0.0))
    scene.add_body(ds.shapes.box((0.1, 40.0, 40.0)), kind="static", position=(1.3, 0.0, 0.0))
    turned = ds.rotation.from_rpy(np.array([0.3, 0.2, 0.1]))
    scene.add_body(ds.shapes.box(0.2), density=500.0, orientation=turned, velocity=(speed, 1e-4 * speed, 0.0))
    return scene


def _spinning(rate: float) -> ds.Scene:
    scene = ds.Scene()
    scene.add_ground()
    spin = (0.3 * rate, rate, 0.1 * rate)
    scene.add_body(ds.shapes.box((0.3, 0.2, 0.1)), density=500.0, position=(0.0, 0.0, 0.4), angular_velocity=spin)
    return scene


# ---- geometry --------------------------------------------------------------------------------------------------------


def _needles(thin: float) -> ds.Scene:
    """A box whose top is a fan around a point `thin` off its edge: triangles that thin."""
    outline = [[-0.1, -0.1], [0.0, -0.1 + thin], [0.1, -0.1], [0.1, 0.1], [-0.1, 0.1]]
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.prism(outline, 0.2), density=500.0, position=(0.0, 0.0, 0.15))
    return scene


def _repeated_triangles() -> ds.Scene:
    vertices, faces = ds.shapes.box(0.2)
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body((vertices, np.concatenate([faces, faces])), density=500.0, position=(0.0, 0.0, 0.15))
    return scene


def _gap(gap: float) -> ds.Scene:
    """Two boxes with coplanar faces and parallel edges, `gap` [m] apart and as far above the ground."""
    scene = ds.Scene()
    scene.add_ground()
    for k in range(2):
        scene.add_body(ds.shapes.box(0.2), density=500.0, position=(0.0, 0.0, 0.1 + gap + k * (0.2 + gap)))
    return scene


_HALF = math.sqrt(0.5)
_EDGE_UP = (math.cos(math.pi / 8), math.sin(math.pi / 8), 0.0, 0.0)
_EDGE_ACROSS = (math.cos(math.pi / 8), 0.0, math.sin(math.pi / 8), 0.0)
_CORNER_UP = tuple(ds.rotation.from_rpy(np.array([math.pi / 4, math.atan(_HALF), 0.0])).tolist())


def _on(lower: Sequence[float], upper: Sequence[float], height: float, kind: str = "static") -> ds.Scene:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box(0.2), density=500.0, orientation=lower, kind=kind)
    scene.add_body(ds.shapes.box(0.2), density=500.0, orientation=upper, position=(0.0, 0.0, height))
    return scene


def _wedge_in_crack(friction: float = 0.0) -> ds.Scene:
    scene = ds.Scene()
    for sign in (-1.0, 1.0):
        turned = (math.cos(0.1 * sign), 0.0, math.sin(0.1 * sign), 0.0)
        side = ds.shapes.box((0.2, 0.6, 0.6))
        scene.add_body(side, kind="static", position=(0.2 * sign, 0.0, 0.0), orientation=turned, friction=friction)
    wedge = ds.shapes.prism([[-0.15, 0.25], [0.0, -0.25], [0.15, 0.25]], 0.3)
    upright = (_HALF, _HALF, 0.0, 0.0)
    scene.add_body(wedge, density=500.0, position=(0.001, 0.0, 0.6), orientation=upright, friction=friction)
    return scene


def _spike_in_slot() -> ds.Scene:
    scene = ds.Scene()
    scene.add_body(ds.shapes.u_channel(0.3, 0.3, 0.4, 0.1), kind="static")
    spike = ds.shapes.prism([[-0.04, 0.2], [0.0, -0.2], [0.04, 0.2]], 0.1)
    scene.add_body(spike, density=500.0, position=(0.005, 0.0, 0.35), orientation=(_HALF, _HALF, 0.0, 0.0))
    return scene


def _squeezed(speed: float) -> ds.Scene:
    """A press comes down on a box, further than there is room."""
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(0.2), density=500.0, position=(0.0, 0.0, 0.101))
    scene.add_body(ds.shapes.box((1.0, 1.0, 0.1)), kind="kinematic", position=(0.0, 0.0, 0.3), velocity=(0, 0, -speed))
    return scene


def _compacted(speed: float) -> ds.Scene:
    """Boxes fall into a bin, and a press comes down on them, further than there is room."""
    scene = scenes.boxes_in_bin(8, side=2)
    plate = ds.shapes.box((0.53, 0.53, 0.05))
    scene.add_body(plate, kind="kinematic", position=(0.0, 0.0, 0.8), velocity=(0.0, 0.0, -speed))
    return scene


def _turned(axis: Sequence[float], degrees: float) -> ds.Scene:
    """A box turned by a right or a straight angle falls onto another."""
    half = math.radians(0.5 * degrees)
    orientation = (math.cos(half), *(math.sin(half) * np.array(axis) / np.linalg.norm(axis)))
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box((0.4, 0.4, 0.2)), density=500.0, position=(0.0, 0.0, 0.101))
    scene.add_body(ds.shapes.box((0.3, 0.2, 0.1)), density=500.0, position=(0.0, 0.0, 0.45), orientation=orientation)
    return scene


def _far(distance: float) -> ds.Scene:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box((2.0, 2.0, 0.2)), kind="static", position=(distance, 0.7 * distance, -0.1))
    turned = ds.rotation.from_rpy(np.array([0.3, 0.2, 0.1]))
    position = (distance, 0.7 * distance, 0.3)
    scene.add_body(ds.shapes.box(0.2), density=500.0, position=position, orientation=turned)
    return scene


def _bowl() -> ds.Scene:
    """A ball rolls in a bowl of some 1e5 triangles."""
    n = 224
    at = np.linspace(-1.0, 1.0, n)
    x, y = np.meshgrid(at, at, indexing="ij")
    vertices = np.stack([x, y, 0.5 * (x**2 + y**2)], axis=-1).reshape(-1, 3)
    _, faces = ds.shapes.sheet(2.0, n)
    scene = ds.Scene()
    scene.add_body((vertices, faces), kind="static")
    scene.add_sphere(0.1, density=500.0, position=(0.4, 0.1, 0.3))
    return scene


def _chain(links: int) -> ds.Scene:
    """Interlocked tori hang from the first, which is fixed."""
    scene = ds.Scene()
    mesh = ds.shapes.torus(0.1, 0.02, 12, 6)
    for k in range(links):
        turned = (_HALF, _HALF, 0.0, 0.0) if k % 2 else (0.5, 0.5, 0.5, 0.5)
        scene.add_body(
            mesh, density=1000.0, position=(0.0, 0.0, -0.15 * k), orientation=turned, kind="dynamic" if k else "static"
        )
    return scene


# ---- the table -------------------------------------------------------------------------------------------------------


def _cases() -> list[Case]:
    result = [
        Case("mass ratio (heavy on light)", f"{m:g}", lambda m=m: _heavy_on_light(m), _CONVERGES, quick=m == 1e6)
        for m in _decades(0, 9)
    ]
    result += [
        Case("cloth stiffness [N/m]", f"{k:g}", lambda k=k: _ball_on_cloth(k), _CONVERGES, steps=30, energy=0.05)
        for k in _decades(0, 9)
    ]
    result += [
        Case("compliance", f"{c:g}", _tilted_on_box, _CONVERGES, options={"compliance": c}, quick=c == 0.0)
        for c in (0.0, *_decades(-8, -1))
    ]
    result += [
        Case(
            "dt [s]",
            f"{dt:g}",
            _tilted_on_box,
            _CONVERGES if dt < 0.1 else _SPEAKS,
            dt=dt,
            steps=int(min(60, max(5, HORIZON / dt))),
        )
        for dt in _decades(-6, 0)
    ]
    result += [Case("size [m]", f"{s:g}", lambda s=s: _scaled(s), _CONVERGES, quick=s == 1e-6) for s in _decades(-6, 5)]
    result.append(Case("size [m]", "1e-4 to 1e3 in one", _all_sizes, _CONVERGES))
    result += [
        Case(
            "speed at a wall [m/s]",
            f"{v:g}",
            lambda v=v: _fast(v),
            _SPEAKS,
            steps=20,
            stop=1.25,
            reason=IMPACTS,
            quick=v == 1e3,
        )
        for v in _decades(1, 5)
    ]
    result += [
        Case("spin [rad/s]", f"{w:g}", lambda w=w: _spinning(w), _SPEAKS, reason=TURNS if w > 10 else "")
        for w in _decades(0, 4)
    ]
    result.append(
        Case("spin [rad/s]", "100 (dt 0.001)", lambda: _spinning(100.0), _CONVERGES, dt=0.001, steps=500, energy=1e-9)
    )
    result += [
        Case("needle triangles: height [m]", f"{t:g}", lambda t=t: _needles(t), _CONVERGES) for t in _decades(-9, -3, 2)
    ]
    result.append(
        Case(
            "triangles twice",
            "all",
            _repeated_triangles,
            "refused by name: they would count twice",
            refusal="count twice",
        )
    )
    result += [
        Case("coplanar faces: gap [m]", f"{g:g}", lambda g=g: _gap(g), "comes to rest where it stands", still=1e-3)
        for g in (0.0, 1e-12, 1e-8, 1e-6, 1e-4)
    ]
    meetings = {
        "edge on parallel edge": lambda: _on(_EDGE_UP, _EDGE_UP, 0.3),
        "edge on crossing edge": lambda: _on(_EDGE_UP, _EDGE_ACROSS, 0.3),
        "corner on corner": lambda: _on(_CORNER_UP, _CORNER_UP, 0.36),
        "corner on face": lambda: _on((1.0, 0.0, 0.0, 0.0), _CORNER_UP, 0.3),
        "spike in slot": _spike_in_slot,
        "wedge in crack": _wedge_in_crack,
    }
    result += [
        Case("meeting", name, build, _CONVERGES, quick="corner on c" in name) for name, build in meetings.items()
    ]
    result += [
        Case("squeeze by a press [m/s]", f"{v:g}", lambda v=v: _squeezed(v), _SPEAKS, steps=25, reason=IMPACTS)
        for v in (0.1, 1.0, 10.0)
    ]
    result.append(Case("compactor on a pile [m/s]", "1", lambda: _compacted(1.0), _SPEAKS, steps=60, reason=IMPACTS))
    result += [
        Case(
            "turned about an axis",
            f"{angle}° about {' '.join(map(str, axis))}",
            lambda a=axis, d=angle: _turned(a, d),
            _CONVERGES,
        )
        for angle in (90, 180)
        for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 1, 0), (1, 1, 1))
    ]
    result.append(
        Case("rest", "1e5 steps", lambda: _gap(1e-6), "does not creep", steps=100_000, still=1e-5, gradient=1e-3)
    )
    result += [
        Case("distance from the origin [m]", f"{d:g}", lambda d=d: _far(d), _CONVERGES if d < 1e7 else _SPEAKS)
        for d in (0.0, *_decades(3, 8, 1))
    ]
    result.append(Case("many triangles", "bowl of 1e5", _bowl, _CONVERGES))
    chains = {"5 links": 5, "30 links": 30, "100 m": 667}
    result += [Case("chain of tori", name, lambda n=n: _chain(n), _CONVERGES, steps=10) for name, n in chains.items()]
    return result + _friction_cases()


def _friction_cases() -> list[Case]:
    coefficients = (0.0, 1e-6, 0.1, 1.0, 10.0)
    shapes = {"box on a slope": box_on_a_slope, "ball on a slope": ball_on_a_slope, "heap": heap}
    result = [
        Case(
            "friction",
            f"{mu:g}: {name}",
            lambda b=build, mu=mu: b(mu),
            _SPEAKS if name == "heap" else _CONVERGES,
            steps=100 if name == "heap" else 50,
        )
        for name, build in shapes.items()
        for mu in coefficients
    ]
    result += [
        Case(
            "mass ratio with friction 0.5",
            f"{m:g}",
            lambda m=m: _heavy_on_light(m, 0.5),
            _CONVERGES if m <= 100 else _SPEAKS,
        )
        for m in _decades(0, 6)
    ]
    result += [
        Case(
            "card house",
            f"{levels} high (friction 0.5)",
            lambda n=levels: card_house(n, 0.5),
            _STANDS,
            still=1e-4,
        )
        for levels in (1, 2, 3)
    ]
    result.append(
        Case("card house", "1 high (friction 0.1)", lambda: card_house(1, 0.1), "slides apart; " + _SPEAKS, reason=THIN)
    )
    result += [
        Case(
            "arch (friction 0.7)",
            f"{stones} stones {'between abutments' if abutments else 'on the ground'}",
            lambda n=stones, a=abutments: scenes.arch(n, friction=0.7, gap=_ARCH_GAP, abutments=a),
            _STANDS,
            steps=300,
            still=1e-4,
            options={"thickness": _ARCH_GAP},
        )
        for stones in (10, 25)
        for abutments in (False, True)
    ]
    result += [
        Case(
            "jam",
            "box between walls (friction 1.5)",
            lambda: box_between_walls(1.5),
            _STANDS,
            still=1e-4,
            energy=1.0,  # the wall does work
        ),
        Case("jam", "wedge in crack (friction 1.5)", lambda: _wedge_in_crack(1.5), _SPEAKS, quick=True),
    ]
    result += [
        Case("jam", f"rod on its tip at {v:g} m/s (friction {mu:g})", lambda v=v, mu=mu: rod_on_its_tip(mu, v), _SPEAKS)
        for mu in (1.5, 10.0)
        for v in (-1.0, 1.0)
    ]
    return result


CASES = tuple(_cases())
