"""zones="global": one zone of everything gives what the zones of what touches give, and is really one."""

from __future__ import annotations

import copy

import pytest
import torch

import diffsim as ds
from diffsim import scenes

DT, STEPS = 0.01, 40
# Both minimise the same energies to rounding, by other iterations: contact, stiff as it is, multiplies what that
# leaves, step after step.
SAME_STATE = 1e-9  # [m], [m/s], [1]
SAME_GRADIENT = 1e-7  # relative to the largest entry of all


def cubes_and_a_stack() -> ds.Scene:
    """Cubes that land one after the other, two of them on each other, one that stays in the air, and a fixed ledge."""
    scene = scenes.row_of_cubes(6, height=0.05)
    cube = ds.shapes.box(0.1)
    scene.add_body(cube, density=1000.0, position=(0.35, 0.02, 0.35), name="upper")
    scene.add_body(cube, density=1000.0, position=(0.0, 0.5, 3.0), velocity=(0.1, 0.0, 0.0), name="high")
    scene.add_body(ds.shapes.box((0.4, 0.4, 0.1)), kind="static", position=(2.0, 0.0, 0.2), name="ledge")
    scene.add_sphere(0.05, density=500.0, position=(2.03, 0.01, 0.32), velocity=(0.3, 0.0, 0.0), name="ball")
    return scene


def with_cloth() -> ds.Scene:
    scene = scenes.row_of_cubes(2, height=0.05)
    x, y = torch.meshgrid(torch.arange(4.0), torch.arange(4.0), indexing="ij")
    vertices = torch.stack([0.05 * x, 0.05 * y, 0.001 * x * y], dim=-1).reshape(-1, 3).double().numpy()
    corners = [(4 * i + j, 4 * i + j + 1, 4 * i + j + 4, 4 * i + j + 5) for i in range(3) for j in range(3)]
    faces = [face for a, b, c, d in corners for face in ((a, c, b), (b, c, d))]
    scene.add_cloth((vertices, faces), position=(1.0, 0.0, 0.03), name="sheet")
    return scene


def run(sim: ds.Simulator) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """The end of a rollout, and the gradient of a loss on it with respect to the start and the masses."""
    start = sim.initial_state()
    fields = [name for name in ds.State.__dataclass_fields__ if getattr(start, name).numel()]
    inputs = {name: getattr(start, name).requires_grad_() for name in fields}
    inputs["mass"] = sim.mass.requires_grad_()
    end = sim.rollout(start, None, STEPS)[-1]
    generator = torch.Generator().manual_seed(0)
    loss = torch.zeros((), dtype=torch.float64)
    for name in fields:
        value = getattr(end, name)
        loss = loss + (value * torch.randn(value.shape, generator=generator, dtype=torch.float64)).sum()
    gradients = torch.autograd.grad(loss, list(inputs.values()))
    return {name: getattr(end, name).detach() for name in fields}, dict(zip(inputs, gradients))


@pytest.mark.parametrize("make", [cubes_and_a_stack, with_cloth])
@pytest.mark.parametrize("adjoint", ["exact", "qr", "dense"])
def test_states_and_gradients_are_the_same(make: object, adjoint: str) -> None:
    assert callable(make)
    sims = {
        zones: ds.Simulator(make(), dt=DT, adjoint=adjoint, zones=zones, on_failure="raise")
        for zones in ("local", "global")
    }
    ends, gradients = zip(*(run(sim) for sim in sims.values()))
    for name in ends[0]:
        torch.testing.assert_close(ends[1][name], ends[0][name], rtol=0.0, atol=SAME_STATE)
    size = max(float(gradient.abs().max()) for gradient in gradients[0].values())
    assert size > 0.1
    for name in gradients[0]:
        torch.testing.assert_close(gradients[1][name], gradients[0][name], rtol=0.0, atol=SAME_GRADIENT * size)


def test_a_global_zone_holds_everything_that_yields() -> None:
    found = {}
    for zones in ("local", "global"):
        sim = ds.Simulator(cubes_and_a_stack(), dt=DT, zones=zones)
        sim.rollout(sim.initial_state(), None, STEPS)
        assert sim.info is not None
        found[zones] = sim.info.zones, sim.info.largest_zone, sim.info.contacts
    dynamic = 6 + 3
    assert found["local"][0] > 3 and found["local"][1] < 4
    assert found["global"] == (1, dynamic, found["local"][2])


def test_zones_without_movers_or_contact() -> None:
    empty = ds.Simulator(ds.Scene(), dt=DT, zones="global")
    empty(empty.initial_state())
    flying = {}
    for zones in ("local", "global"):
        scene = ds.Scene()
        for x in (0.0, 3.0):
            scene.add_sphere(0.5, density=1.0, position=(x, 0.0, 0.0), velocity=(0.0, 1.0, 0.0))
        sim = ds.Simulator(scene, dt=DT, zones=zones)
        flying[zones] = sim(sim.initial_state())
        assert sim.info is not None and sim.info.zones == 0
    torch.testing.assert_close(flying["global"].position, flying["local"].position, rtol=0.0, atol=1e-15)


def test_zones_reach_the_core_copies_and_repr() -> None:
    sim = ds.Simulator(scenes.resting_box(), dt=DT, zones="global")
    assert sim._options.zones == copy.deepcopy(sim)._options.zones == "global"
    assert "zones='global'" in repr(sim)
    assert "zones='local'" in repr(ds.Simulator(scenes.resting_box(), dt=DT))
