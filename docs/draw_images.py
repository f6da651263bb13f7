"""Draw pictures of these documents: `python docs/draw_images.py` writes the drawn ones of docs/images."""

from pathlib import Path

import matplotlib
import numpy as np
import torch

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.patches import Polygon

IMAGES = Path(__file__).parent / "images"
FIXED, FREE, EXACT, ROW, HIT = "#d5d5d5", "#9ec3e6", "#1f5f99", "#c8641e", "#c0392b"

# A box of this half width and half height stands over the edge of a fixed one, whose corner is the origin.
HALF = np.array([0.5, 0.28])
START = np.array([0.2, HALF[1] + 0.09])  # of its centre
MASS, INERTIA = 1.0, (HALF @ HALF) / 3.0
PUSH = np.array([-0.85, -0.03, -0.34])  # turn and shift that nothing stops
CLEARANCE = 0.008  # that CCD keeps
SHAPE = HALF * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])


def rotation(turn: float) -> np.ndarray:
    """Of this angle, counterclockwise."""
    return np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])


def corners(motion: np.ndarray) -> np.ndarray:
    """Of the box after a turn and a shift."""
    return SHAPE @ rotation(motion[0]).T + START + motion[1:]


def face_row(motion: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Signed distance of the fixed corner from the box's lower face after a motion, its derivative by the motion, and
    the normal into the box.
    """
    normal = rotation(motion[0]) @ np.array([0.0, 1.0])
    centre = START + motion[1:]
    distance = normal @ centre - HALF[1]
    turned = np.array([-normal[1], normal[0]])
    return float(distance), np.array([turned @ centre, *normal]), normal


def nearest(aim: np.ndarray, distance: float, row: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The motion nearest to the aim, weighed by mass and inertia, that the row made at a motion lets through."""
    missing = max(0.0, -(distance + row @ (aim - at)))
    inverse = np.array([1.0 / INERTIA, 1.0 / MASS, 1.0 / MASS])
    return aim + inverse * row * missing / (row @ (inverse * row))


def draw_box(axes: plt.Axes, points: np.ndarray, **style: object) -> None:
    """A box by its corners."""
    axes.add_patch(Polygon(points, **{"closed": True, "joinstyle": "round", **style}))


def draw_row(axes: plt.Axes, point: np.ndarray, normal: np.ndarray) -> None:
    """The line that a row keeps the box beyond, with its normal."""
    along = np.array([normal[1], -normal[0]])
    ends = np.array([point - 0.6 * along, point + 0.6 * along])
    axes.plot(*ends.T, color=ROW, lw=1.2, zorder=4)
    axes.annotate("", point + 0.3 * normal, point, arrowprops={"arrowstyle": "-|>", "color": ROW, "lw": 1.6}, zorder=6)


def face_crossings(points: np.ndarray) -> list[np.ndarray]:
    """Where the box's lower face crosses the two faces of the fixed corner."""
    a, b = points[0], points[1]
    return [a + (b - a) * a[1] / (a[1] - b[1]), a + (b - a) * a[0] / (a[0] - b[0])]


def draw_rows() -> None:
    """Rows are straight and bodies turn: rows at the start, where the way ends, rows again."""
    start = np.zeros(3)
    distance, row, normal = face_row(start)
    end = nearest(PUSH, distance, row, start)
    blocked = next(s for s in np.linspace(0.0, 1.0, 1001) if face_row(s * end)[0] < CLEARANCE)
    distance_end, row_end, normal_end = face_row(end)
    again = nearest(PUSH, distance_end, row_end, end)
    clear = face_row(again)[0]
    assert distance_end < -0.05 and abs(clear) < 0.005, (distance_end, clear)

    figure, panels = plt.subplots(1, 3, figsize=(9.6, 3.0))
    fixed = np.array([[-0.95, 0.0], [0.0, 0.0], [0.0, -0.6], [-0.95, -0.6]])
    titles = (
        "1. The row lets the face's nearest point\ngo straight (red) down to the line",
        f"2. The box turns: its end is inside (red),\nCCD stops the way at {blocked:.2f} (dotted)",
        "3. The row where the way ended, its\ndistance negative, leads to a clear end",
    )
    for axes, title in zip(panels, titles, strict=True):
        draw_box(axes, fixed, fc=FIXED, ec="#777777", lw=1.0)
        axes.set(xlim=(-0.95, 0.95), ylim=(-0.6, 0.9), aspect="equal")
        axes.set_title(title, fontsize=9)
        axes.axis("off")

    axes = panels[0]
    draw_box(axes, corners(start), fc=FREE, ec=EXACT, lw=1.4)
    draw_row(axes, np.zeros(2), normal)
    point = np.array([0.0, distance])
    arm = point - START
    straight = point + end[1:] + end[0] * np.array([-arm[1], arm[0]])
    axes.annotate("", straight, point, arrowprops={"arrowstyle": "-|>", "color": HIT, "lw": 1.6}, zorder=7)
    axes.plot(*point, "o", color=HIT, ms=4, zorder=8)

    axes = panels[1]
    draw_box(axes, corners(end), fc=FREE, ec=EXACT, lw=1.4)
    draw_box(axes, fixed, fc="none", ec="#777777", lw=1.0)
    draw_box(axes, corners(blocked * end), fc="none", ec="#555555", lw=1.2, ls=(0, (1.5, 1.5)))
    draw_box(axes, np.array([np.zeros(2), *face_crossings(corners(end))]), fc=HIT, ec=HIT, lw=0.8, zorder=5)

    axes = panels[2]
    draw_box(axes, corners(again), fc=FREE, ec=EXACT, lw=1.4)
    draw_box(axes, corners(end), fc="none", ec=EXACT, lw=1.0, ls=(0, (4, 2)))
    draw_row(axes, np.zeros(2), normal_end)

    figure.tight_layout(pad=0.4, w_pad=1.0)
    figure.savefig(IMAGES / "rows.png", dpi=100, bbox_inches="tight", pad_inches=0.05)
    plt.close(figure)


def draw_distance() -> None:
    """The contact's energy over the distance, from where it begins to where objects penetrate."""
    depth, pole = 1.0, 0.95
    compression = np.linspace(0.0, 0.949, 800)
    energy = 0.5 * compression**2 / (1.0 - compression / pole)
    figure, axes = plt.subplots(figsize=(7.2, 3.0))
    axes.plot(-compression, energy, color=EXACT, lw=1.8)
    axes.plot([0.0, 0.35], [0.0, 0.0], color=EXACT, lw=1.8)
    axes.plot(-compression, 0.5 * compression**2, color="#888888", lw=1.0, ls=(0, (4, 2)))
    for place, name, side, height in (
        (0.0, "rest\nδ", "left", 0),
        (-0.1, "landing\nδ − 0.1 D", "right", 0),
        (-0.9, "floor\nδ − 0.9 D", "left", 0),
        (-pole, "pole\nδ − 0.95 D", "center", 1),
        (-depth, "limit\nδ − D", "right", 0),
    ):
        top = 6.2 + 1.5 * height
        axes.plot([place, place], [0.0, top - 0.1], color=HIT if place <= -pole else "#999999", lw=0.9, clip_on=False)
        axes.text(place, top, name, ha=side, va="bottom", fontsize=8)
    axes.axvspan(-1.3, -depth, color=HIT, alpha=0.12, lw=0)
    axes.set(xlim=(-1.12, 0.35), ylim=(0.0, 6.0), yticks=[], xticks=[])
    axes.set_xlabel("distance d", fontsize=9)
    axes.set_ylabel("energy φ", fontsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    figure.tight_layout(pad=0.4)
    figure.savefig(IMAGES / "distance.png", dpi=110)
    plt.close(figure)


def draw_friction() -> None:
    """A box on the ground that is pulled harder, then less: what holds it, in the disc and over time, and its speed."""
    import diffsim as ds

    friction, steps, dt = 0.5, 240, 0.01
    scene = ds.Scene()
    scene.add_ground(friction=friction)
    scene.add_body(ds.shapes.box((0.4, 0.4, 0.1)), mass=1.0, position=(0.0, 0.0, 0.05), friction=friction)
    sim = ds.Simulator(scene, dt=dt)
    time = dt * np.arange(steps)
    pull = 1.5 * friction * 9.81 * np.interp(time, [0.0, 1.2, 2.4], [0.0, 1.0, 0.0])
    heading = np.interp(time, [0.0, 2.4], [0.0, 1.2])
    state, held, speed = sim.initial_state(), [], []
    for force, angle in zip(pull, heading):
        push = torch.tensor([[force * np.cos(angle), force * np.sin(angle), 0.0]], dtype=torch.float64)
        contacts = sim.contacts(state, ds.Control(force=push))
        held.append((contacts.friction.sum(0) / contacts.normal_force.sum(0).norm())[:2].tolist())
        state = contacts.end
        speed.append(float(state.velocity.norm()))
    share = -np.array(held) / friction
    figure, (disc, axes) = plt.subplots(1, 2, figsize=(7.2, 2.7), width_ratios=(1, 2))
    turn = np.linspace(0.0, 2.0 * np.pi, 200)
    disc.fill(np.cos(turn), np.sin(turn), color=FIXED, lw=0)
    disc.plot(*share.T, color=EXACT, lw=1.8)
    disc.set(xlim=(-0.25, 1.1), ylim=(-0.25, 1.1), xticks=[0, 1], yticks=[0, 1], aspect="equal")
    disc.set_xlabel("friction along x / μ normal force", fontsize=8)
    disc.set_ylabel("along y", fontsize=8)
    axes.plot(time, pull / (friction * 9.81), color="#888888", lw=1.0, ls=(0, (4, 2)), label="pull / μ m g")
    axes.plot(time, np.linalg.norm(share, axis=1), color=EXACT, lw=1.8, label="friction / μ normal force")
    axes.plot(time, speed, color=ROW, lw=1.4, label="speed [m/s]")
    axes.set_xlabel("time [s]", fontsize=8)
    axes.legend(fontsize=7, frameon=False)
    for panel in (disc, axes):
        panel.tick_params(labelsize=7)
        for side in ("top", "right"):
            panel.spines[side].set_visible(False)
    figure.tight_layout(pad=0.4)
    figure.savefig(IMAGES / "friction.png", dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    draw_rows()
    draw_distance()
    draw_friction()
