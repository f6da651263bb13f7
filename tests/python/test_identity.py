"""Handles and parameters of one scene do not pass for those of another."""

import copy
import io
import pickle
from typing import Any

import pytest
import torch
from torch import nn
from torch.func import functional_call

import diffsim as ds


def make_sim(*names: str, dt: float = 0.01, cloths: tuple[str, ...] = ()) -> ds.Simulator:
    scene = ds.Scene()
    for k, name in enumerate(names):
        scene.add_sphere(0.1, mass=1.0 + k, position=(k, 0, 5), name=name)
    for k, name in enumerate(cloths):
        scene.add_cloth(ds.shapes.sheet(0.5, 3), position=(k, 0, 9), name=name)
    return ds.Simulator(scene, dt=dt)


@pytest.mark.parametrize("strict", [True, False])
@pytest.mark.parametrize(
    ("other", "problem"),
    [
        (lambda: make_sim("ball", "box"), "body 0 is 'box' there and 'ball' here"),
        (lambda: make_sim("box"), "there are 2 bodies there and 1 here"),
        (lambda: make_sim("box", "ball", "third"), "there are 2 bodies there and 3 here"),
        (lambda: make_sim("box", "ball", cloths=("flag",)), "there are 0 cloths there and 1 here"),
        (lambda: make_sim("box", "ball", dt=0.02), "dt is 0.01 s there and 0.02 s here"),
    ],
)
def test_parameters_of_another_scene_are_refused_untouched(other: Any, problem: str, strict: bool) -> None:
    sim, state_dict = other(), make_sim("box", "ball").state_dict()
    state_dict["gravity"] = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    before = {name: value.clone() for name, value in sim.named_parameters()}
    with pytest.raises(RuntimeError, match="Simulator: the state_dict is of another scene") as raised:
        sim.load_state_dict(state_dict, strict=strict)
    assert problem in str(raised.value)
    assert "strict=False" in str(raised.value)
    assert all(torch.equal(value, before[name]) for name, value in sim.named_parameters())


def test_parameters_of_cloths_in_another_order_are_refused() -> None:
    sim, other = make_sim(cloths=("flag", "sail")), make_sim(cloths=("sail", "flag"))
    with pytest.raises(RuntimeError, match="cloth 0 is 'flag' there and 'sail' here"):
        other.load_state_dict(sim.state_dict())


def test_parameters_alone_are_loaded_where_they_are_asked_for() -> None:
    sim, other = make_sim("box", "ball"), make_sim("ball", "box")
    state_dict = sim.state_dict()
    with pytest.raises(RuntimeError, match="Missing key"):
        other.load_state_dict({name: t for name, t in state_dict.items() if name != "_extra_state"})
    del state_dict["_extra_state"]
    state_dict["mass"] = torch.tensor([5.0, 6.0], dtype=torch.float64)
    other.load_state_dict(state_dict, strict=False)
    assert other.mass.tolist() == [5.0, 6.0]


def test_a_state_dict_survives_what_is_done_to_tensors_and_files() -> None:
    sim, other = make_sim("bäll", cloths=("flag",)), make_sim("bäll", cloths=("flag",))
    sim.mass.data.fill_(3.0)
    file = io.BytesIO()
    torch.save({name: t.clone() for name, t in sim.state_dict().items()}, file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert other.mass.item() == 3.0
    state = sim.initial_state()
    moved = functional_call(other, dict(sim.state_dict()), (state,))
    assert torch.equal(moved.node_position, sim(state).node_position)


def test_a_simulator_within_a_module_names_its_key() -> None:
    class Model(nn.Module):
        def __init__(self, sim: ds.Simulator) -> None:
            super().__init__()
            self.sim, self.layer = sim, nn.Linear(2, 2)

    model = Model(make_sim("box"))
    Model(make_sim("box")).load_state_dict(model.state_dict())
    with pytest.raises(RuntimeError, match=r'remove its key "sim\._extra_state"'):
        Model(make_sim("ball")).load_state_dict(model.state_dict())
    for copied in (copy.deepcopy(model), pickle.loads(pickle.dumps(model.sim))):
        getattr(copied, "sim", copied).load_state_dict(model.sim.state_dict())


def test_an_extra_state_of_something_else_is_refused() -> None:
    sim = make_sim("box")
    for extra in (torch.zeros(3, dtype=torch.uint8), {"dt": 0.01}, "box"):
        with pytest.raises(RuntimeError, match="'_extra_state' was not written by a"):
            sim.load_state_dict({**sim.state_dict(), "_extra_state": extra})


# ---- handles and states ----------------------------------------------------------------------------------------------


def test_handles_of_another_scene_are_refused() -> None:
    scene, other = ds.Scene(), ds.Scene()
    ball = scene.add_sphere(0.1, mass=1.0, name="ball")
    flag = scene.add_cloth(ds.shapes.sheet(0.5, 3), position=(0, 0, 9), name="flag")
    other.add_sphere(0.1, mass=1.0, name="other")
    stranger = other.add_sphere(0.1, mass=1.0, position=(0, 0, 1), name="ball")
    sail = other.add_cloth(ds.shapes.sheet(0.5, 4), position=(0, 0, 9), name="sail")
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    assert len(sim.mesh(state, flag).vertices) == 9
    assert sim.mesh(state, ball).is_watertight
    with pytest.raises(ValueError, match=r"mesh: BodyHandle\(1, 'ball'\) .* of another scene.* object 1 is 'flag'"):
        sim.mesh(state, stranger)
    with pytest.raises(ValueError, match=r"ClothHandle\(2, 'sail', nodes 0:16\) is of another scene"):
        sim.mesh(state, sail)


def test_handles_stay_what_they_are_when_the_scene_grows_after_the_simulator() -> None:
    scene = ds.Scene()
    flag = scene.add_cloth(ds.shapes.sheet(0.5, 3), name="flag")
    sim = ds.Simulator(scene, dt=0.01)
    late = scene.add_sphere(0.1, mass=1.0, position=(0, 0, 9))
    assert len(sim.mesh(sim.initial_state(), flag).vertices) == 9
    with pytest.raises(ValueError, match="or was added later"):
        sim.mesh(sim.initial_state(), late)


def test_states_of_another_scene_are_refused_with_what_this_one_has() -> None:
    state = make_sim("a", "b", "c", cloths=("flag",)).initial_state()
    for sim in (make_sim("box", "ball"), make_sim("a", "b", "c", cloths=("flag", "sail"))):
        for use in (sim, sim.kinetic_energy, lambda s, sim=sim: sim.rollout(s, None, 2)):
            with pytest.raises(ValueError, match=r"of another scene\? This one has") as raised:
                use(state)
            assert "2 bodies and no cloth" in str(raised.value) or "3 bodies and 18 cloth nodes" in str(raised.value)
