"""A simulator of a scene with cloth: its parameters, states and inputs, and how it refuses them."""

import copy
from typing import Any

import pytest
import torch

import diffsim as ds

CLOTH_PARAMETERS = ("density", "stretch", "shear", "bend", "damping")


def make_scene() -> ds.Scene:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_cloth(ds.shapes.sheet(1.0, 4), ds.ClothMaterial.denim(), pinned=[0, 3], position=(0, 0, 3), name="flag")
    scene.add_body(ds.shapes.box(0.5), density=10.0, position=(0, 0, 5))
    scene.add_cloth(ds.shapes.sheet(0.5, 3), position=(0, 4, 1), velocity=(0, 0, 1), name="towel")
    return scene


@pytest.fixture
def sim() -> ds.Simulator:
    return ds.Simulator(make_scene(), dt=0.01)


def test_parameters_are_those_of_the_materials(sim: ds.Simulator) -> None:
    denim, cotton = ds.ClothMaterial.denim(), ds.ClothMaterial()
    for name in CLOTH_PARAMETERS:
        parameter = getattr(sim, f"cloth_{name}")
        assert not parameter.requires_grad
        assert parameter.tolist() == [getattr(denim, name), getattr(cotton, name)]
        assert f"cloth_{name}" in sim.state_dict()
    assert sim.friction.shape == sim.restitution.shape == (4,)  # body, cloths, ground
    assert sim.body_names == ("body_0",)
    assert sim.cloth_names == ("flag", "towel")
    assert (sim._model.cloth_count, sim._model.node_count) == (2, 25)


def test_initial_state_has_the_nodes_of_all_cloths(sim: ds.Simulator, state: ds.State) -> None:
    assert state.node_position.shape == state.node_velocity.shape == (25, 3)
    assert torch.equal(state.node_position[:16, 2], torch.full((16,), 3.0).double())
    assert torch.equal(state.node_velocity[16:], torch.tensor([0.0, 0.0, 1.0]).double().expand(9, 3))
    batch = sim.initial_state(batch=3)
    assert batch.node_position.shape == (3, 25, 3)
    assert torch.equal(batch.node_position[2], state.node_position)
    assert sim.float().initial_state().node_position.dtype is torch.float32


def test_repr_names_the_stages_of_cloth(sim: ds.Simulator) -> None:
    text = repr(sim)
    assert "Simulator(1 body, 2 cloths of 25 nodes, thickness=" in text
    assert "coupling='monolithic'" in text
    runs, left_out = text.splitlines()[1:]
    assert runs.endswith("cloth, cloth contact")
    assert "cloth" not in left_out
    alone = ds.Scene()
    alone.add_cloth(ds.shapes.sheet(1.0, 3), position=(0, 0, 1))
    alone.add_ground()
    text = repr(ds.Simulator(alone, dt=0.01))
    assert "1 cloth of 9 nodes" in text
    assert "runs: ground contact, cloth, cloth contact" in text
    assert "cloth (no cloth), cloth contact (no cloth)" in repr(ds.Simulator(ds.Scene(), dt=0.01))


def test_coupling_reaches_the_core(sim: ds.Simulator) -> None:
    assert sim._options.coupling == "monolithic"
    split = ds.Simulator(make_scene(), dt=0.01, coupling="split")
    assert split._options.coupling == copy.deepcopy(split)._options.coupling == "split"
    with pytest.raises(ValueError, match="coupling must be one of 'monolithic', 'split', got 'weak'"):
        ds.Simulator(make_scene(), dt=0.01, coupling="weak")


def test_crossing_cloth_is_refused_unless_unchecked() -> None:
    scene = ds.Scene()
    scene.add_cloth(ds.shapes.sheet(1.0, 4), name="flat")
    scene.add_cloth(ds.shapes.sheet(1.0, 4), orientation=(1, 0.5, 0.1, 0), name="steep")
    with pytest.raises(ValueError, match="cloth 'flat' and cloth 'steep' interpenetrate at the start"):
        ds.Simulator(scene, dt=0.01)
    ds.Simulator(scene, dt=0.01, check=False)


def test_states_whose_cloth_crosses_are_refused_by_name(sim: ds.Simulator, state: ds.State) -> None:
    def moved(nodes: slice, shift: tuple[float, float, float], turn: bool = False) -> ds.State:
        position = state.node_position.clone()
        position[nodes] = position[nodes][:, [2, 0, 1] if turn else [0, 1, 2]]
        position[nodes] += torch.tensor(shift, dtype=torch.float64) - position[nodes].mean(0)
        return state.replace(node_position=position)

    sim(moved(slice(16, 25), (0, 0.1, 4.0)))
    with pytest.raises(ValueError, match="the meshes of 'flag' and 'towel' cross; start from"):
        sim(moved(slice(16, 25), (0.1, 0.07, 3.03), turn=True))
    with pytest.raises(ValueError, match="the meshes of 'body_0' and 'towel' cross"):
        sim(moved(slice(16, 25), (0.3, 0.05, 5.02)))
    position = state.node_position.clone()
    position[0] += torch.tensor([1.0, 0.9, 0.3])  # a corner above the far end ...
    position[1] += torch.tensor([0.3, 0.7, -0.3])  # ... its neighbour below: their edge goes through the sheet
    with pytest.raises(ValueError, match="the mesh of 'flag' crosses itself; start from"):
        sim(state.replace(node_position=position))


def test_min_distance_sees_cloth() -> None:
    scene = ds.Scene()
    scene.add_ground(margin=0.01)
    scene.add_cloth(ds.shapes.sheet(0.5, 3), position=(0, 0, 0.1), margin=0.01)
    scene.add_cloth(ds.shapes.sheet(0.5, 3), position=(0, 0, 5), margin=0.01)
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    assert sim.min_distance(state) == pytest.approx(0.08, abs=1e-12)
    # High above the ground: one sheet with itself, a node and the diagonal next to it.
    lifted = state.replace(node_position=state.node_position + torch.tensor([0.0, 0.0, 1.0]))
    assert sim.min_distance(lifted) == pytest.approx(0.25 / 2**0.5 - 0.02, abs=1e-12)
    nodes = state.node_position.clone()
    nodes[9:, 2] = nodes[0, 2] + 0.05
    assert sim.min_distance(state.replace(node_position=nodes)) == pytest.approx(0.03, abs=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda x: x[:-1], r"state.node_position must have shape \(25, 3\) or \(B, 25, 3\), got \(24, 3\)"),
        (lambda x: x.float(), r"state.node_position must have the dtype of the state, torch.float64"),
        (lambda x: x[:, :2], r"state.node_position must have shape \(25, 3\)"),
        (
            lambda x: x.index_fill(0, torch.tensor([20]), float("nan")),
            r"state.node_position of node 4 of cloth 'towel' \(index 20\) must be finite, got \(nan nan nan\)",
        ),
    ],
)
def test_wrong_nodes_are_refused_by_name(sim: ds.Simulator, state: ds.State, change: Any, message: str) -> None:
    with pytest.raises((TypeError, ValueError), match=message):
        sim(state.replace(node_position=change(state.node_position)))


def test_wrong_node_velocity_and_controls_are_refused_by_name(sim: ds.Simulator, state: ds.State) -> None:
    wrong = torch.zeros(25, 3, dtype=torch.float64)
    wrong[3, 1] = float("inf")
    with pytest.raises(ValueError, match=r"state.node_velocity of node 3 of cloth 'flag' \(index 3\) must be finite"):
        sim(state.replace(node_velocity=wrong))
    with pytest.raises(ValueError, match=r"control.node_force of node 3 of cloth 'flag' \(index 3\) must be finite"):
        sim(state, ds.Control(node_force=wrong))
    with pytest.raises(ValueError, match=r"control.node_velocity of node 3 of cloth 'flag' .* must be finite"):
        sim.rollout(state, ds.Control(node_velocity=wrong), 2)
    with pytest.raises(ValueError, match=r"control.node_force must have shape \(25, 3\) or \(B, 25, 3\), got \(9, 3\)"):
        sim(state, ds.Control(node_force=wrong[:9]))
    with pytest.raises(ValueError, match=r"controls.node_velocity must have shape \(25, 3\), \(4, 25, 3\)"):
        sim.rollout(state, ds.Control(node_velocity=wrong[:9]), 4)
    with pytest.raises(TypeError, match=r"control.node_force must have dtype torch.float32 or torch.float64"):
        sim(state, ds.Control(node_force=wrong.half()))


@pytest.mark.parametrize("name", CLOTH_PARAMETERS)
def test_wrong_parameters_are_refused_by_name(name: str, sim: ds.Simulator, state: ds.State) -> None:
    parameter = getattr(sim, f"cloth_{name}")
    for value in (-2e-9, float("nan")):
        with torch.no_grad():
            parameter[1] = value
        with pytest.raises(ValueError, match=rf"cloth_{name} of cloth 'towel' \(index 1\) must be .*, got {value:g} "):
            sim(state)
    with torch.no_grad():
        parameter[1] = 0.0
    if name != "damping":
        with pytest.raises(ValueError, match="must be positive and finite, got 0"):
            sim(state)
    wrong = torch.ones(3, dtype=torch.float64)
    with pytest.raises(ValueError, match=rf"cloth_{name} must have shape \(2,\) or \(B, 2\), got \(3,\)"):
        torch.func.functional_call(sim, {f"cloth_{name}": wrong}, (state,))


def test_a_scene_without_cloth_hands_the_core_none(monkeypatch: pytest.MonkeyPatch) -> None:
    from diffsim import _core

    scene = ds.Scene()
    scene.add_sphere(0.1, mass=1.0)
    sim = ds.Simulator(scene, dt=0.01)
    given: list[Any] = []
    forward = _core.rollout

    def spied(model: Any, options: Any, inputs: list[Any], **settings: Any) -> Any:
        given.append(inputs)
        result = forward(model, options, inputs, **settings)
        given.append(result.trajectory)
        return result

    monkeypatch.setattr(_core, "rollout", spied)
    start = sim.initial_state()
    empty = torch.zeros(0, 3, dtype=torch.float64)
    for end in (
        sim(start),
        sim.rollout(start, ds.Control(node_force=empty), 1),
        sim.rollout(start, [ds.Control(node_velocity=empty)], 1),
        sim(start.to(torch.float32)),
    ):
        assert end.node_position.shape[-2:] == (0, 3)
    for inputs, outputs in zip(given[::2], given[1::2], strict=True):
        assert [k for k in (4, 5, 8, 11, 16, 17, 18, 19, 20) if inputs[k] is not None] == []
        assert outputs[4] is outputs[5] is None
