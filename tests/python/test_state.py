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


# ---- many as one -----------------------------------------------------------------------------------------------------


def test_stack_and_cat_join_along_leading_axes() -> None:
    a, b = random_state(4), random_state(4)
    batch = ds.State.stack([a, b])
    assert batch.leading_shape == (2, 4)
    assert_same(batch[1], b)
    assert_same(ds.State.stack([a, b], dim=1)[:, 0], a)
    longer = ds.State.cat([a, b[:2]])
    assert len(longer) == 6
    assert_same(longer[4:], b[:2])
    assert_same(ds.State.cat([batch, batch[:, :1]], dim=1)[:, 4], batch[:, 0])
    # A field that all scenes of a batch share gets its own copy of the axis first.
    shared = a.replace(velocity=a.velocity[0])
    assert ds.State.stack([shared, b]).velocity.shape == (2, 4, 2, 3)
    controls = ds.Control.stack([ds.Control(force=torch.ones(2, 3)), ds.Control(force=torch.zeros(2, 3))])
    assert controls.force.shape == (2, 2, 3)
    assert controls.torque is None
    a.velocity.requires_grad_()
    ds.State.cat([a, b]).velocity[:4].sum().backward()
    assert torch.equal(a.velocity.grad, torch.ones(4, 2, 3).double())


def test_where_takes_scenes_of_either_and_gradients_go_there() -> None:
    start, state = random_state(), random_state(3)
    start.position.requires_grad_()
    state.position.requires_grad_()
    mask = torch.tensor([True, False, True])
    mixed = ds.State.where(mask, start, state)
    assert_same(mixed[0], start)
    assert_same(mixed[1], state[1])
    assert mixed.node_position.shape == (3, 0, 3)
    mixed.position.sum().backward()
    assert torch.equal(start.position.grad, torch.full((2, 3), 2.0).double())
    assert torch.equal(state.position.grad[:, 0, 0], torch.tensor([0.0, 1.0, 0.0]).double())
    mapped = torch.func.vmap(ds.State.where, in_dims=(0, None, 0))(mask, start, state)
    assert_same(mapped, mixed)


def test_length_is_that_of_the_first_axis_and_truth_does_not_ask_for_it() -> None:
    assert len(random_state(5, 4)) == 5
    assert bool(random_state())
    assert (ds.Control() or None) is not None
    with pytest.raises(TypeError, match="State without a time or batch axis has no length"):
        len(random_state())


def test_what_does_not_fit_together_is_named() -> None:
    a, b = random_state(4), random_state(3)
    mask = torch.tensor([True] * 4)
    force = ds.Control(force=torch.ones(2, 3))
    cases = [
        (lambda: ds.State.stack([]), ValueError, "State.stack: there must be at least one entry"),
        (lambda: ds.State.stack([a, 1]), TypeError, "entries[1] must be a diffsim.State, got int"),
        (lambda: ds.State.stack([a, b]), ValueError, "entries[1].position has shape (3, 2, 3), which does not fit (4,"),
        (lambda: ds.State.stack([a, a], dim=2), IndexError, "of which there are 2, got 2"),
        (lambda: ds.State.cat([a[0], b[0]]), IndexError, "State.cat: dim must be that of a leading axis"),
        (lambda: ds.State.cat([a, a.to(torch.float32)]), TypeError, "entries[1].position has dtype torch.float32"),
        (lambda: ds.State.cat([a, random_state(4, bodies=3)]), ValueError, "are they of different scenes?"),
        (lambda: ds.Control.stack([force, ds.Control()]), ValueError, "entries[0] has force, entries[1] has None"),
        (lambda: ds.State.where(mask.double(), a, a), TypeError, "mask must be a tensor of torch.bool, got torch.fl"),
        (
            lambda: ds.State.where(mask, a, b),
            ValueError,
            "mask, a.position and b.position are (4,), (4,), (3,)",
        ),
        (lambda: ds.State.where(mask, a, None), TypeError, "State.where: b must be a diffsim.State, got NoneType"),
    ]
    for call, error, text in cases:
        with pytest.raises(error) as caught:
            call()
        assert text in str(caught.value)


class Pushes(torch.utils.data.Dataset):  # at the top of the module, so that workers can be given it
    def __init__(self, states: ds.State) -> None:
        self.states = states

    def __len__(self) -> int:
        return len(self.states)

    def __getitem__(self, i: int) -> dict[str, object]:
        return {"start": self.states[i], "control": ds.Control(force=torch.full((2, 3), float(i))), "label": i}


@pytest.mark.parametrize("workers", [0, 1])
def test_torch_collates_states_and_dicts_that_hold_them(workers: int) -> None:
    states = random_state(5)
    first = next(iter(torch.utils.data.DataLoader(list(states), batch_size=3)))
    assert_same(first, states[:3])
    loaded = list(torch.utils.data.DataLoader(Pushes(states), batch_size=2, num_workers=workers))
    assert len(loaded) == 3
    assert_same(loaded[1]["start"], states[2:4])
    assert torch.equal(loaded[1]["control"].force[:, 0, 0], torch.tensor([2.0, 3.0]))
    assert loaded[1]["control"].torque is None
    assert torch.equal(loaded[2]["label"], torch.tensor([4]))
