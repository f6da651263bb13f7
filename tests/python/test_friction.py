"""Coulomb friction against closed forms: what sticks stays, what slides and rolls does so at the right rate."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from energy_rises import rises_of_energy
from small_scenes import assert_same
from torch import Tensor

import diffsim as ds
from diffsim import scenes

G = 9.8  # [m/s²]
DT = 0.01
RADIUS = 0.5


def tilted(degrees: float | Tensor) -> Tensor:
    """Gravity in the axes of a slope that falls along x."""
    angle = torch.deg2rad(torch.as_tensor(degrees, dtype=torch.float64))
    return G * torch.stack([angle.sin(), torch.zeros_like(angle), -angle.cos()])


def on_ground(mu: float, *, degrees: float = 0.0, ground: float | None = None, **motion: Any) -> ds.Simulator:
    """A flat box at rest on a slope, unless it moves."""
    scene = ds.Scene(gravity=tilted(degrees).tolist())
    scene.add_ground(friction=mu if ground is None else ground)
    scene.add_body(
        ds.shapes.box((1.0, 1.0, 0.4)), density=1000.0, position=(0.0, 0.0, 0.2004), friction=mu, name="box", **motion
    )
    return ds.Simulator(scene, DT, on_failure="raise")


def ball(mu: float, *, degrees: float = 0.0, gravity: bool = True, height: float = 0.0, **motion: Any) -> ds.Simulator:
    scene = ds.Scene(gravity=tilted(degrees).tolist() if gravity else (0.0, 0.0, 0.0))
    scene.add_ground(friction=mu)
    scene.add_sphere(RADIUS, density=1000.0, position=(0.0, 0.0, RADIUS + height), friction=mu, **motion)
    return ds.Simulator(scene, DT, on_failure="raise")


def end_of(sim: ds.Simulator, steps: int, **options: Any) -> ds.State:
    return sim.rollout(sim.initial_state(), steps=steps, **options)[-1]


def acceleration(sim: ds.Simulator, **parameters: Tensor) -> Tensor:
    """Along the slope, once the contacts have settled."""
    speed = sim.rollout(sim.initial_state(), steps=60, parameters=parameters).velocity[:, 0, 0]
    return (speed[-1] - speed[20]) / (DT * 39)


# ---- slopes ----------------------------------------------------------------------------------------------------------


def test_a_box_on_a_slope_does_not_creep() -> None:
    path = (sim := on_ground(0.5, degrees=26.0)).rollout(sim.initial_state(), steps=1000)
    assert (path.position[5:] - path.position[5]).abs().max() < 1e-9
    assert path.velocity[-1].abs().max() < 1e-12


def test_friction_decides_at_its_angle() -> None:
    degrees = 26.565  # arctan 0.5, less 4e-5 of a degree
    assert end_of(on_ground(0.5, degrees=degrees), 100).velocity.abs().max() < 1e-9
    slope = math.radians(degrees)
    slides = G * (math.sin(slope) - 0.49 * math.cos(slope))
    assert end_of(on_ground(0.49, degrees=degrees), 100).velocity[0, 0].item() == pytest.approx(slides, rel=1e-3)


@pytest.mark.parametrize(
    ("degrees", "mu", "within"),
    [(15.0, 0.1, 1e-6), (20.0, 0.1, 1e-6), (25.0, 0.4, 1e-6), (30.0, 0.05, 1e-6), (45.0, 0.5, 1e-6), (85.0, 1.0, 1e-3)],
)
def test_a_sliding_box_has_its_acceleration_and_derivatives(degrees: float, mu: float, within: float) -> None:
    slope = torch.tensor(math.radians(degrees), dtype=torch.float64, requires_grad=True)
    friction = torch.tensor(mu, dtype=torch.float64, requires_grad=True)
    found = acceleration(on_ground(mu, degrees=degrees), gravity=tilted(slope.rad2deg()), friction=friction.expand(2))
    expected = G * (slope.sin() - friction * slope.cos())
    assert found.item() == pytest.approx(expected.item(), abs=within)
    derivatives = torch.autograd.grad(found, (slope, friction))
    wanted = torch.autograd.grad(expected, (slope, friction))
    for derivative, want in zip(derivatives, wanted):
        assert derivative.item() == pytest.approx(want.item(), rel=1e-5 if degrees < 80.0 else within)


def test_coefficients_of_a_pair_are_averaged_geometrically() -> None:
    found = acceleration(on_ground(0.1, ground=0.4, degrees=30.0))
    slope = math.radians(30.0)
    assert found.item() == pytest.approx(G * (math.sin(slope) - 0.2 * math.cos(slope)), abs=1e-6)


def test_a_pair_without_friction_on_one_side_is_frictionless() -> None:
    motion: dict[str, Any] = {"velocity": (0.3, 0.2, -1.0), "angular_velocity": (1.0, 2.0, 3.0)}
    without, on_rough, rough = (
        end_of(on_ground(mu, ground=ground, degrees=10.0, **motion), 30)
        for mu, ground in ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0))
    )
    assert_same(without, on_rough)
    assert_same(without, rough)


def test_contacts_tell_what_holds_a_box() -> None:
    sim = on_ground(0.5, degrees=20.0)
    contacts = sim.contacts(end_of(sim, 10))
    weight = sim.mass.item() * G
    slope = math.radians(20.0)
    assert contacts.sticking.all() and sim.info.sticking == len(contacts) and sim.info.slipping == 0
    # Contacts know their compression of 1e-7 m, and so their forces, up to the rounding of where the box is.
    assert contacts.friction[:, 0].sum().item() == pytest.approx(-weight * math.sin(slope), rel=5e-9)
    assert contacts.normal_force[:, 2].sum().item() == pytest.approx(weight * math.cos(slope), rel=5e-9)
    torch.testing.assert_close(contacts.force, contacts.normal_force + contacts.friction)
    sliding = on_ground(0.2, degrees=20.0)
    contacts = sliding.contacts(end_of(sliding, 10))
    assert not contacts.sticking.any() and sliding.info.slipping == len(contacts)
    share = contacts.friction.norm(dim=-1) / contacts.normal_force.norm(dim=-1)
    torch.testing.assert_close(share, torch.full_like(share, 0.2))
    start = sliding.initial_state()
    start.velocity.requires_grad_()
    with pytest.raises(NotImplementedError, match="friction have no gradient"):
        sliding.contacts(start).force.sum().backward()


def test_a_sphere_rolls() -> None:
    sim = ball(0.5, degrees=20.0)
    path = sim.rollout(sim.initial_state(), steps=60)
    speed, turn = path.velocity[:, 0, 0], path.angular_velocity[:, 0, 1]
    rolls = 5.0 / 7.0 * G * math.sin(math.radians(20.0))
    assert ((speed[-1] - speed[20]) / (DT * 39)).item() == pytest.approx(rolls, rel=1e-6)
    torch.testing.assert_close(RADIUS * turn, speed, rtol=1e-6, atol=1e-9)


def test_a_loose_wedge_carries_a_box_on_its_slope() -> None:
    slope = math.radians(20.0)
    scene = ds.Scene()
    scene.add_ground(friction=0.5)
    wedge = ds.shapes.prism([(0.0, 0.0), (2.0, 0.0), (0.0, 2.0 * math.tan(slope))], 1.0)
    lying = ds.rotation.from_rpy(torch.tensor([math.pi / 2, 0.0, 0.0], dtype=torch.float64)).tolist()
    scene.add_body(wedge, density=1000.0, orientation=lying, position=(0.0, 0.0, 0.001), friction=0.5)
    height = 0.15 + 0.002  # of the box's centre above the slope
    place = (
        0.8 + height * math.sin(slope),
        0.0,
        0.001 + (2.0 - 0.8) * math.tan(slope) + height * math.cos(slope),
    )
    turned = ds.rotation.from_rpy(torch.tensor([0.0, slope, 0.0], dtype=torch.float64)).tolist()
    scene.add_body(ds.shapes.box((0.4, 0.4, 0.3)), density=2000.0, position=place, orientation=turned, friction=0.5)
    sim = ds.Simulator(scene, DT, on_failure="raise")
    path = sim.rollout(sim.initial_state(), steps=100)
    assert path.velocity[-1].abs().max() < 1e-9
    assert (path.position[-1] - path.position[20]).abs().max() < 1e-7
    loose = end_of(sim, 60, parameters={"friction": torch.zeros(3, dtype=torch.float64)})
    assert loose.velocity[0, 0].abs() > 0.1  # without friction it is squeezed out


# ---- slowing down ----------------------------------------------------------------------------------------------------


def test_a_box_slides_on_as_friction_lets_it() -> None:
    sim = on_ground(0.05, velocity=(10.0, 0.0, 0.0))
    end = end_of(sim, 250)
    assert end.velocity[0, 0].item() == pytest.approx(8.775, abs=1e-6)
    # The step is of first order: velocities are those of the steps' ends.
    assert end.position[0, 0].item() == pytest.approx(25.0 - 0.5 * 0.49 * 2.5 * (2.5 + DT), abs=1e-5)
    assert end.position[0, 0].item() == pytest.approx(23.469, abs=0.5 * 0.49 * 2.5 * DT + 1e-3)


def test_it_stops_where_it_should_and_stays() -> None:
    sim = on_ground(0.5)
    speed = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    mu = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    start = sim.initial_state()
    velocity = torch.stack([speed, torch.zeros_like(speed), torch.zeros_like(speed)])[None]
    path = sim.rollout(start.replace(velocity=velocity), steps=80, parameters={"friction": mu.expand(2)})
    way = path.position[-1, 0, 0] - start.position[0, 0]
    steps = int(2.0 / (0.5 * G * DT))  # that end in motion
    expected = DT * (steps * speed - mu * G * DT * steps * (steps + 1) / 2)
    assert way.item() == pytest.approx(expected.item(), rel=1e-5)
    found, wanted = (torch.autograd.grad(value, (speed, mu)) for value in (way, expected))
    for derivative, want in zip(found, wanted):
        assert derivative.item() == pytest.approx(want.item(), rel=1e-4)
    assert path.velocity[-1].abs().max() < 1e-12
    assert (path.position[-1] - path.position[-30]).abs().max() < 1e-9


def test_a_spinning_plate_stops() -> None:
    sim = on_ground(0.3, angular_velocity=(0.0, 0.0, 3.0))
    path = sim.rollout(sim.initial_state(), steps=100)
    spin = path.angular_velocity[:, 0, 2]
    # All weight is on the corners, which slide at right angles to their arms.
    slows = 0.3 * G * sim.mass[0] * math.sqrt(0.5) / sim.inertia[0, 2, 2]
    assert ((spin[5] - spin[20]) / (15 * DT)).item() == pytest.approx(slows.item(), rel=1e-6)
    assert spin[-1].abs() < 1e-12
    assert path.velocity[-1].abs().max() < 1e-12
    assert path.position[-1, 0, :2].abs().max() < 1e-9


@pytest.mark.parametrize(("share", "slips"), [(0.95, False), (1.05, True)])
def test_a_box_on_a_turntable_slips_where_it_should(share: float, slips: bool) -> None:
    radius, mu = 1.5, 0.5
    spin = share * math.sqrt(mu * G / radius)
    scene = ds.Scene(gravity=(0.0, 0.0, -G))
    scene.add_body(
        ds.shapes.box((4.0, 4.0, 0.5)), kind="kinematic", angular_velocity=(0.0, 0.0, spin), friction=mu, name="table"
    )
    motion = {"velocity": (0.0, spin * radius, 0.0), "angular_velocity": (0.0, 0.0, spin)}
    box = scene.add_body(
        ds.shapes.box((0.3, 0.3, 0.1)), density=1000.0, position=(radius, 0.0, 0.3003), friction=mu, **motion
    )
    sim = ds.Simulator(scene, DT, thickness=3e-4, on_failure="raise")
    path = sim.rollout(sim.initial_state(), steps=100)
    away = path.position[:, box, :2].norm(dim=-1)
    if slips:
        assert away[-1] > radius + 0.05
    else:
        # It goes along with where the step ends, so that like all of implicit Euler's circles this one shrinks.
        shrinks = 1.0 / math.sqrt(1.0 + (spin * DT) ** 2)
        torch.testing.assert_close(away[-1] / away[5], torch.tensor(shrinks**94).double(), rtol=1e-6, atol=0.0)
        assert path.angular_velocity[-1, box, 2].item() == pytest.approx(spin, rel=1e-6)


# ---- first touches ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("mu", "sideways"), [(0.1, 2.0 - 0.1 * 3.0), (0.9, 5.0 / 7.0 * 2.0)], ids=["slides", "sticks"])
def test_a_ball_that_lands_aslant_gets_the_impulse_of_the_cone(mu: float, sideways: float) -> None:
    end = end_of(ball(mu, gravity=False, height=0.1, velocity=(2.0, 0.0, -3.0)), 30)
    assert end.velocity[0].tolist() == pytest.approx([sideways, 0.0, 0.0], abs=1e-3)
    # What friction takes from the motion it gives to the spin: I ω = m r Δv.
    spin = (2.0 - end.velocity[0, 0].item()) / (0.4 * RADIUS)
    assert end.angular_velocity[0].tolist() == pytest.approx([0.0, spin, 0.0], abs=1e-3)


def test_a_spinning_ball_that_lands_rolls_off_sideways() -> None:
    end = end_of(ball(1.0, gravity=False, height=0.1, velocity=(0.0, 0.0, -2.0), angular_velocity=(0.0, 4.0, 0.0)), 30)
    assert end.velocity[0].tolist() == pytest.approx([2.0 / 7.0 * 4.0 * RADIUS, 0.0, 0.0], abs=1e-3)
    assert end.angular_velocity[0, 1].item() == pytest.approx(end.velocity[0, 0].item() / RADIUS, rel=1e-6)


# ---- cloth -----------------------------------------------------------------------------------------------------------


def sheet_on_slope(mu: float, degrees: float) -> ds.Simulator:
    scene = ds.Scene(gravity=tilted(degrees).tolist())
    scene.add_ground(friction=mu)
    scene.add_cloth(ds.shapes.sheet(0.5, 5), position=(0.0, 0.0, 0.002), friction=mu)
    return ds.Simulator(scene, DT, on_failure="raise")


def test_a_sheet_lies_on_a_slope() -> None:
    path = (sim := sheet_on_slope(0.5, 20.0)).rollout(sim.initial_state(), steps=150)
    assert path.node_velocity[-1].abs().max() < 1e-9
    assert (path.node_position[-1] - path.node_position[20]).abs().max() < 1e-6


def test_a_sheet_slides_down_a_slope_like_a_box() -> None:
    path = (sim := sheet_on_slope(0.2, 30.0)).rollout(sim.initial_state(), steps=60)
    speed = path.node_velocity[..., 0].mean(dim=1)
    slope = math.radians(30.0)
    found = (speed[-1] - speed[20]).item() / (DT * 39)
    assert found == pytest.approx(G * (math.sin(slope) - 0.2 * math.cos(slope)), rel=1e-4)


def test_a_body_is_carried_by_a_cloth_that_is_lifted_and_moved() -> None:
    scene = ds.Scene()
    x = torch.arange(25).reshape(5, 5)
    rim = [*x[0].tolist(), *x[-1].tolist(), *x[1:-1, 0].tolist(), *x[1:-1, -1].tolist()]
    scene.add_cloth(ds.shapes.sheet(0.4, 5), pinned=rim, friction=0.6)
    scene.add_body(ds.shapes.box((0.16, 0.16, 0.05)), density=200.0, position=(0.0, 0.0, 0.028), friction=0.6)
    sim = ds.Simulator(scene, DT, on_failure="raise")
    start = sim.rollout(sim.initial_state(), steps=20)[-1]
    steps = 60
    speed = torch.linspace(0.0, 0.6, steps, dtype=torch.float64)[:, None] * torch.tensor([1.0, 0.0, 0.5]).double()
    drive = torch.zeros(steps, 25, 3, dtype=torch.float64)
    drive[:, rim] = speed[:, None]
    end = sim.rollout(start, ds.Control(node_velocity=drive), steps)[-1]
    moved = DT * speed.sum(dim=0)
    way = end.position[0] - start.position[0]
    assert way.tolist() == pytest.approx(moved.tolist(), abs=0.01)


# ---- stacks ----------------------------------------------------------------------------------------------------------


def stack(count: int, offset: float, top: float = 1.0) -> ds.Simulator:
    scene = ds.Scene()
    scene.add_ground(friction=0.5)
    for k in range(count):
        density = 1000.0 * (top if k == count - 1 else 1.0)
        place = (offset * (-1) ** k, 0.0, (k + 0.5) * 1.001 + 0.0005)
        scene.add_body(ds.shapes.box(1.0), density=density, position=place, friction=0.5)
    return ds.Simulator(scene, DT, on_failure="raise")


@pytest.mark.parametrize(("count", "offset", "top"), [(5, 0.05, 1.0), (3, 0.0, 1000.0)], ids=["aslant", "heavy top"])
def test_a_stack_stands(count: int, offset: float, top: float) -> None:
    path = (sim := stack(count, offset, top)).rollout(sim.initial_state(), steps=200)
    assert path.velocity[-1].abs().max() < 1e-9
    assert (path.position[-1] - path.position[50])[:, :2].abs().max() < 1e-6


GAP = 1e-4  # of stones, and what they keep apart


def arch(stones: int, **shape: Any) -> ds.Simulator:
    return ds.Simulator(scenes.arch(stones, friction=0.7, gap=GAP, **shape), DT, thickness=GAP, on_failure="raise")


@pytest.mark.parametrize("stones", [10, 25])
def test_an_arch_stands_and_falls_with_less_friction(stones: int) -> None:
    sim = arch(stones)
    start = sim.initial_state()
    path = sim.rollout(start, steps=100)
    assert sim.info.sticking == sim.info.contacts and sim.info.zones == 1
    assert (path.position - start.position).abs().max() < 1e-5  # a hundred-thousandth of its radius: it settles
    assert (path.position[5:] - path.position[5]).abs().max() < 1e-9
    assert path.velocity[-1].abs().max() < 1e-12
    slippery = torch.full_like(sim.friction, 0.1)
    loose = sim.rollout(start, steps=20, parameters={"friction": slippery})
    assert (loose.position[-1] - start.position).abs().max() > 0.01


@pytest.mark.parametrize(("share", "stands"), [(1.01, True), (0.98, False)])
def test_an_arch_falls_where_the_line_of_thrust_leaves_it(share: float, stands: bool) -> None:
    """A semicircular one does where it is thinner than 0.1075 of its mean radius, as Milankovitch found."""
    thinnest = 0.1075 / (1.0 - 0.5 * 0.1075)  # of an inner radius of 1
    sim = arch(10, radius=1.0, ring=share * thinnest)
    start = sim.initial_state()
    moved = (end_of(sim, 40).position - start.position).abs().max()
    assert moved < 1e-5 if stands else moved > 5e-3


def thrown(mu: float, **options: Any) -> ds.Simulator:
    scene = ds.Scene()
    scene.add_ground(friction=mu)
    for k in range(3):
        scene.add_body(
            ds.shapes.box((0.5, 0.4, 0.3)),
            density=1000.0,
            position=(0.1 * k, 0.05 * k, 0.4 + 0.65 * k),
            velocity=(1.5, -0.5 * k, -1.0),
            angular_velocity=(1.0, 2.0, 3.0 - k),
            friction=mu,
            name=f"box {k}",
        )
    return ds.Simulator(scene, DT, **options)


@pytest.mark.parametrize("mu", [0.3, 0.8])
def test_energy_does_not_rise_but_by_the_error_of_a_turn(mu: float) -> None:
    sim = thrown(mu, on_failure="raise")
    path = sim.rollout(start := sim.initial_state(), steps=100)
    path = ds.State.cat([start[None], path])
    assert rises_of_energy(sim, list(path)) == []
    energy = sim.kinetic_energy(path) + sim.potential_energy(path)
    assert energy[0] - energy[-1] > 0.1 * energy[0]
    assert energy.diff().max() < 1e-4 * energy[0]


# ---- as PyTorch has it -----------------------------------------------------------------------------------------------


def test_a_batch_is_its_single_runs_to_the_bit() -> None:
    sim = thrown(0.5)
    start = sim.initial_state()
    friction = torch.tensor([0.0, 0.4, 0.9], dtype=torch.float64)[:, None].expand(3, 4)
    values = friction.clone().requires_grad_()
    together = sim.rollout(start, steps=40, parameters={"friction": values})[-1]
    (gradients,) = torch.autograd.grad(together.position[1:].sum(), values)
    assert gradients[1:].all()
    assert not gradients[0].any()
    for k in (0, 1, 2):
        one = friction[k].clone().requires_grad_()
        alone = sim.rollout(start, steps=40, parameters={"friction": one})[-1]
        assert_same(together[k], alone)
        if k:
            (gradient,) = torch.autograd.grad(alone.position.sum(), one)
            assert torch.equal(gradients[k], gradient)


def test_float32_in_is_float32_out() -> None:
    sim = on_ground(0.3, velocity=(1.0, 0.0, 0.0))
    friction = torch.full((2,), 0.3, requires_grad=True)  # float32
    end = sim.rollout(sim.initial_state().to(torch.float32), steps=20, parameters={"friction": friction})[-1]
    assert end.position.dtype == torch.float32
    (gradient,) = torch.autograd.grad(end.velocity[0, 0], friction)
    assert gradient.dtype == torch.float32
    torch.testing.assert_close(gradient.sum().item(), -20 * DT * G, rtol=1e-4, atol=0.0)


def test_transforms_and_compile_see_friction() -> None:
    sim = on_ground(0.3, velocity=(1.0, 0.0, 0.0))
    start = sim.initial_state()

    def way(friction: Tensor) -> Tensor:
        return sim.rollout(start, steps=10, parameters={"friction": friction}).position[-1, 0, 0]

    values = torch.tensor([[0.3, 0.3], [0.1, 0.4]], dtype=torch.float64)
    mapped = torch.func.vmap(torch.func.grad(way))(values)
    assert mapped.all()
    for value, gradient in zip(values, mapped):
        assert torch.equal(gradient, torch.func.grad(way)(value))
    value = values[0].clone().requires_grad_()
    found = torch.compile(way, fullgraph=True, backend="aot_eager", dynamic=False)(value)
    assert torch.equal(found, way(value))
    assert torch.equal(torch.autograd.grad(found, value)[0], mapped[0])
    torch._dynamo.reset()


# ---- what is refused, and what is said -------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [-0.1, math.nan, math.inf])
@pytest.mark.parametrize("check", [True, False])
def test_wrong_friction_names_its_object(value: float, check: bool) -> None:
    sim = thrown(0.3, check=check)
    start = sim.initial_state()
    for index, name in ((1, "box 1"), (3, "ground")):
        friction = torch.full((4,), 0.3, dtype=torch.float64)
        friction[index] = value
        text = rf"friction of '{name}' \(index {index}\) must be zero or positive and finite"
        with pytest.raises(ValueError, match=text):
            sim(start, parameters={"friction": friction})


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"adjoint": "qr"}, "adjoint='qr' and 'dense' linearise contact without friction"),
        ({"adjoint": "dense"}, "adjoint='qr' and 'dense' linearise contact without friction"),
        ({"compliance": 0.0}, r"no gradients of friction on hard contacts \(compliance=0\)"),
    ],
)
def test_gradients_there_are_none_of_are_refused_by_name(options: dict[str, Any], text: str) -> None:
    sim = thrown(0.3, **options)
    start = sim.initial_state()
    moving = start.replace(velocity=start.velocity.clone().requires_grad_())
    with pytest.raises(ValueError, match=text):
        sim(moving)
    without = sim(moving, parameters={"friction": torch.zeros(4, dtype=torch.float64)})
    assert torch.autograd.grad(without.position.sum(), moving.velocity)[0].any()


def test_a_simulator_says_whether_there_is_friction() -> None:
    runs, left_out = repr(on_ground(0.3)).splitlines()[1:]
    assert "friction" in runs
    assert "friction" not in left_out
    runs, left_out = repr(on_ground(0.3, ground=0.0)).splitlines()[1:]
    assert "friction" not in runs
    assert "friction (no two objects with friction)" in left_out
    scene = ds.Scene()
    scene.add_cloth(ds.shapes.sheet(1.0, 3), friction=0.3)  # folds onto itself
    assert "friction" in repr(ds.Simulator(scene, DT)).splitlines()[1]
