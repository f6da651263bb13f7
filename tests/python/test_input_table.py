"""The table of the operator's inputs: what is true of every line, so that a new one needs no test of its own here."""

import re
import typing

import pytest
import torch

import diffsim as ds
from diffsim import _input_table
from diffsim._input_table import BASE_NDIM, INPUTS, MODULE_PARAMETERS, PARAMETERS

LINES = {i.name: i for i in INPUTS if i.kind == "parameter"}
NAN = float("nan")


def make_sim() -> ds.Simulator:
    scene = ds.Scene()
    scene.add_ground(friction=0.5)
    scene.add_body(
        ds.shapes.box((1.0, 0.7, 0.4)), density=2.0, position=(0, 0, 0.2004), velocity=(1, 0, 0), friction=0.4
    )
    scene.add_body(ds.shapes.box(1.0), kind="static", position=(9, 0, 5), name="wall")
    scene.add_cloth(ds.shapes.sheet(1.0, 4), pinned=[0, 3], position=(0, 5, 5), velocity=(0, 0, -1), name="flag")
    return ds.Simulator(scene, dt=0.01)


def test_state_and_control_are_those_of_the_public_classes() -> None:
    assert tuple(ds.State.__dataclass_fields__) == _input_table.STATE_FIELDS
    assert tuple(ds.Control.__dataclass_fields__) == _input_table.CONTROL_FIELDS


def test_parameters_are_those_of_the_module_declared_and_told_of() -> None:
    sim = make_sim()
    assert tuple(name for name, _ in sim.named_parameters()) == MODULE_PARAMETERS
    declared = typing.get_type_hints(ds.Simulator)
    for name in MODULE_PARAMETERS:
        assert declared[name] is torch.nn.Parameter, name
        assert f"`{name}`" in (ds.Simulator.__doc__ or ""), name


def test_shapes_are_those_of_the_table() -> None:
    sim = make_sim()
    counts = {"": (), "bodies": (2,), "objects": (4,), "cloths": (1,)}
    for name, line in LINES.items():
        assert getattr(sim, name).shape == (*counts[line.axis], *line.row_shape), name
    inputs = sim._checked_inputs("test", sim.initial_state(), None, None).inputs
    assert [t.ndim for t in inputs if t is not None] == [n for n, t in zip(BASE_NDIM, inputs) if t is not None]


@pytest.mark.parametrize("name", PARAMETERS)
def test_values_that_are_not_allowed_are_refused_by_name_value_and_unit(name: str) -> None:
    sim, line = make_sim(), LINES[name]
    state, good = sim.initial_state(), getattr(sim, name).detach()
    must = {"any": "finite", "positive": "positive", "not_negative": "zero or positive"}[line.allowed]
    owner = {"": "", "bodies": r" of body 'body_0' \(index 0\)", "cloths": r" of cloth 'flag' \(index 0\)"}
    owner["objects"] = r" of 'body_0' \(index 0\)"
    wrong = [NAN, float("inf")] + {"any": [], "positive": [0.0, -1.0], "not_negative": [-1.0]}[line.allowed]
    for value in wrong:
        text = rf"^{name}{owner[line.axis]} must be {must}.*, got \(?{value:g}.*{re.escape(line.unit)}$"
        for use in (sim, lambda *a, **k: sim.rollout(*a, steps=2, **k)):
            with pytest.raises(ValueError, match=text):
                use(state, parameters={name: torch.full_like(good, value)})


@pytest.mark.parametrize("name", PARAMETERS)
def test_every_parameter_has_a_gradient_in_a_batch_of_its_own(name: str) -> None:
    sim = make_sim()
    state = sim.initial_state()
    factor = torch.tensor([1.0, 1.1], dtype=torch.float64)
    values = factor.reshape(2, *(1,) * getattr(sim, name).ndim) * getattr(sim, name).detach()

    def loss(parameters: torch.Tensor) -> torch.Tensor:
        end = sim.rollout(state, steps=3, parameters={name: parameters})[-1]
        tensors = (end.position, end.orientation, end.velocity, end.node_position, end.node_velocity)
        random = torch.Generator().manual_seed(3)
        weights = [torch.randn(t.shape[-2:], generator=random, dtype=torch.float64) for t in tensors]
        return torch.stack([(t * w).sum((-1, -2)) for t, w in zip(tensors, weights)]).sum(0)

    leaf = values.clone().requires_grad_()
    (batched,) = torch.autograd.grad(loss(leaf).sum(), leaf)
    for scene in range(2):
        single = values[scene].clone().requires_grad_()
        (alone,) = torch.autograd.grad(loss(single), single)
        assert alone.any(), name
        assert torch.equal(batched[scene], alone)
