import copy
import dataclasses
import io
import pickle
from pathlib import Path

import pytest
import torch
import torch.utils._pytree as pytree

import diffsim as ds

STATE_FIELDS = ("position", "orientation", "velocity", "angular_velocity", "node_position", "node_velocity")
CONTROL_FIELDS = ("force", "torque", "node_force", "body_velocity", "body_angular_velocity", "node_velocity")


def random_state(*leading: int, bodies: int = 2) -> ds.State:
    def make(width: int) -> torch.Tensor:
        return torch.randn(*leading, bodies, width, dtype=torch.float64)

    return ds.State(make(3), make(4), make(3), make(3))


def assert_same(a: ds.State, b: ds.State) -> None:
    for name in STATE_FIELDS:
        assert torch.equal(getattr(a, name), getattr(b, name)), name


def test_fields_are_those_of_the_contract() -> None:
    assert tuple(field.name for field in dataclasses.fields(ds.State)) == STATE_FIELDS
    assert tuple(field.name for field in dataclasses.fields(ds.Control)) == CONTROL_FIELDS


def test_defaults_are_a_body_at_rest_without_cloth() -> None:
    state = ds.State(torch.zeros(5, 2, 3))
    assert torch.equal(state.orientation, torch.tensor([1.0, 0, 0, 0]).expand(5, 2, 4))
    assert not state.velocity.any()
    assert not state.angular_velocity.any()
    assert state.node_position.shape == state.node_velocity.shape == (5, 0, 3)
    assert state.dtype == torch.float32
    assert state.leading_shape == (5,)


def test_wrong_position_is_named() -> None:
    with pytest.raises(TypeError, match=r"State: position must be a torch.Tensor, got list"):
        ds.State([[0.0, 0.0, 0.0]])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"State: position must have shape \(..., n_bodies, 3\), got \(3,\)"):
        ds.State(torch.zeros(3))


def test_frozen() -> None:
    with pytest.raises(dataclasses.FrozenInstanceError):
        random_state().position = torch.zeros(2, 3)  # type: ignore[misc]


def test_pytree_round_trip_keeps_order_and_absent_fields() -> None:
    state = random_state()
    leaves, spec = pytree.tree_flatten(state)
    assert [id(leaf) for leaf in leaves] == [id(getattr(state, name)) for name in STATE_FIELDS]
    assert_same(pytree.tree_unflatten(leaves, spec), state)
    control = ds.Control(torque=torch.ones(2, 3))
    leaves, spec = pytree.tree_flatten(control)
    assert len(leaves) == 1
    doubled = pytree.tree_map(lambda t: 2 * t, control)
    assert doubled.force is None
    assert torch.equal(doubled.torque, torch.full((2, 3), 2.0))
    keys = [pytree.keystr(path) for path, _ in pytree.tree_flatten_with_path(state)[0]]
    assert keys == [f".{name}" for name in STATE_FIELDS]


def test_vmap_takes_states_and_controls() -> None:
    states, controls = random_state(4), ds.Control(force=torch.randn(4, 2, 3, dtype=torch.float64))

    def pushed(state: ds.State, control: ds.Control) -> ds.State:
        assert state.leading_shape == ()
        return state.replace(velocity=state.velocity + control.force)

    result = torch.func.vmap(pushed)(states, controls)
    assert torch.equal(result.velocity, states.velocity + controls.force)
    assert result.node_position.shape == (4, 0, 3)


def test_indexing_takes_leading_axes_only() -> None:
    trajectory = random_state(5, 4)
    assert_same(trajectory[2][1], trajectory[2, 1])
    assert torch.equal(trajectory[-1].velocity, trajectory.velocity[-1])
    assert trajectory[1:3].leading_shape == (2, 4)
    assert trajectory[:, 0].leading_shape == (5,)
    assert trajectory[:, 0].node_position.shape == (5, 0, 3)
    assert trajectory[torch.tensor([True, False, False, True, False])].leading_shape == (2, 4)
    assert random_state()[None].leading_shape == (1,)
    with pytest.raises(TypeError, match=r"3 leading axes .* are indexed"):
        trajectory[0, 0, 0]
    with pytest.raises(TypeError, match="1 leading axes"):
        random_state()[0]
    with pytest.raises(TypeError, match="leading axes"):
        trajectory[..., 0]
    with pytest.raises(IndexError):
        trajectory[5]


def test_iteration_over_time_or_batch() -> None:
    trajectory = random_state(3)
    states = list(trajectory)
    assert len(states) == 3
    for i, state in enumerate(states):
        assert_same(state, trajectory[i])
    with pytest.raises(TypeError, match="cannot be iterated"):
        list(random_state())


def test_replace_detach_clone_to() -> None:
    state = random_state()
    velocity = torch.ones(2, 3, dtype=torch.float64, requires_grad=True)
    moved = state.replace(velocity=velocity)
    assert moved.velocity is velocity
    assert moved.position is state.position
    assert not moved.detach().velocity.requires_grad
    copied = moved.clone()
    assert copied.velocity.grad_fn is not None
    assert copied.position.data_ptr() != state.position.data_ptr()
    assert moved.to(torch.float32).dtype == torch.float32
    assert ds.Control().to(torch.float32).force is None
    assert ds.Control(force=velocity).replace(force=None).force is None
    with pytest.raises(TypeError, match="no field 'speed'; the fields are position, orientation"):
        state.replace(speed=velocity)


def test_pickle_deepcopy_and_save_are_bitwise(tmp_path: Path) -> None:
    state = random_state(3)
    assert_same(pickle.loads(pickle.dumps(state)), state)
    assert_same(copy.deepcopy(state), state)
    torch.save({"state": state, "control": ds.Control(force=state.velocity)}, tmp_path / "state.pt")
    loaded = torch.load(tmp_path / "state.pt", weights_only=True)
    assert_same(loaded["state"], state)
    assert torch.equal(loaded["control"].force, state.velocity)
    assert loaded["control"].torque is None
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    assert_same(torch.load(buffer), state)


def test_repr_is_short() -> None:
    assert repr(random_state(7)) == (
        "State(position=(7, 2, 3), orientation=(7, 2, 4), velocity=(7, 2, 3), angular_velocity=(7, 2, 3),"
        " node_position=(7, 0, 3), node_velocity=(7, 0, 3), torch.float64)"
    )
    assert repr(ds.Control(force=torch.zeros(2, 3))) == "Control(force=(2, 3), torch.float32)"
