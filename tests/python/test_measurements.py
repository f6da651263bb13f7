from typing import Any

import numpy as np
import pytest
import torch
from small_scenes import ROUNDING, assert_same, make_scene
from torch import Tensor

import diffsim as ds

# ---- measurements ----------------------------------------------------------------------------------------------------


def inertia_world(sim: ds.Simulator, state: ds.State, body: int) -> np.ndarray[Any, Any]:
    R = ds.rotation.to_matrix(state.orientation[body]).numpy()
    product: np.ndarray[Any, Any] = R @ sim.inertia[body].numpy() @ R.T
    return product


def test_energies_and_momenta_are_their_formulas(sim: ds.Simulator, state: ds.State) -> None:
    kinetic, potential, momentum, angular = 0.0, 0.0, np.zeros(3), np.zeros(3)
    for body in range(2):
        m, x, v, w = (t[body].numpy() for t in (sim.mass, state.position, state.velocity, state.angular_velocity))
        spin = inertia_world(sim, state, body) @ w
        kinetic += 0.5 * m * v @ v + 0.5 * w @ spin
        potential -= m * sim.gravity.numpy() @ x
        momentum += m * v
        angular += np.cross(x, m * v) + spin
    batch = sim.initial_state(batch=2)
    for function, expected in (
        (sim.kinetic_energy, kinetic),
        (sim.potential_energy, potential),
        (sim.momentum, momentum),
        (sim.angular_momentum, angular),
    ):
        value = function(state)
        assert value.shape == np.shape(expected)
        np.testing.assert_allclose(value.numpy(), expected, rtol=1e-13)
        np.testing.assert_array_equal(function(batch)[1].numpy(), value.numpy())
        assert function(state.to(torch.float32)).dtype == torch.float32


def test_energies_are_differentiable(sim: ds.Simulator, state: ds.State) -> None:
    velocity = state.velocity.clone().requires_grad_()
    sim.mass.requires_grad_()
    (by_velocity, by_mass) = torch.autograd.grad(
        sim.kinetic_energy(state.replace(velocity=velocity)), (velocity, sim.mass)
    )
    assert torch.allclose(by_velocity, sim.mass.detach()[:, None] * state.velocity)
    assert torch.allclose(by_mass, 0.5 * state.velocity.square().sum(-1))


def test_static_and_kinematic_bodies_do_not_count() -> None:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box(1.0), kind="static", position=(0, 0, 5))
    scene.add_body(ds.shapes.box(1.0), kind="kinematic", position=(3, 0, 5), velocity=(1, 0, 0))
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    assert state.velocity.any()
    assert sim.kinetic_energy(state) == sim.potential_energy(state) == 0.0
    assert not sim.momentum(state).any()


def test_momentum_in_free_flight(sim: ds.Simulator, state: ds.State) -> None:
    with torch.no_grad():
        sim.gravity.zero_()
    trajectory = sim.rollout(state, None, 50)
    momentum = sim.momentum(trajectory)
    assert momentum.shape == (50, 3)
    assert torch.allclose(momentum, sim.momentum(state).expand(50, 3), rtol=ROUNDING, atol=ROUNDING)


def offset_tetrahedron() -> tuple[ds.Simulator, np.ndarray[Any, Any]]:
    vertices, faces = ds.shapes.tetrahedron(1.0)
    vertices = np.asarray(vertices) + np.array([3.0, 0.0, 0.0])
    scene = ds.Scene()
    scene.add_body((vertices, faces), density=1.0, position=(0, 2, 5), orientation=(0.8, 0, 0.6, 0))
    scene.add_sphere(0.5, density=1.0, position=(0, -5, 5))
    scene.add_capsule(0.25, 1.0, density=1.0, position=(0, -9, 5), orientation=(0.8, 0, 0.6, 0))
    return ds.Simulator(scene, dt=0.01), vertices


def test_mesh_transform_places_the_mesh_as_it_was_given() -> None:
    sim, vertices = offset_tetrahedron()
    state = sim.initial_state()
    transform = sim.mesh_transform(state)
    assert transform.shape == (3, 4, 4)
    R = ds.rotation.to_matrix(np.array([0.8, 0, 0.6, 0]))
    np.testing.assert_allclose(transform[0, :3, :3].numpy(), R, atol=1e-15)
    np.testing.assert_allclose(transform[0, :3, 3].numpy(), [0, 2, 5], atol=1e-14)
    np.testing.assert_array_equal(transform[:, 3].numpy(), np.tile([0, 0, 0, 1], (3, 1)))
    world = sim.vertices(state)
    assert world.shape == (4 + 1 + 2, 3)
    np.testing.assert_allclose(world[:4].numpy(), vertices @ R.T + [0, 2, 5], atol=1e-14)
    np.testing.assert_allclose(world[4].numpy(), [0, -5, 5], atol=1e-15)
    trajectory = sim.rollout(sim.initial_state(batch=2), None, 3)
    assert sim.vertices(trajectory).shape == (3, 2, 7, 3)
    assert sim.mesh_transform(trajectory).shape == (3, 2, 3, 4, 4)
    assert torch.equal(sim.vertices(trajectory)[2, 1], sim.vertices(trajectory[2, 1]))


def test_place_is_the_inverse_of_mesh_transform() -> None:
    sim, _ = offset_tetrahedron()
    state = sim.initial_state()
    q = torch.tensor([0.3, -0.5, 0.1, 0.7], dtype=torch.float64)
    moved = sim.place(state, 0, position=(1.0, 2.0, 3.0), orientation=q)
    frame = sim.mesh_transform(moved)
    torch.testing.assert_close(frame[0, :3, 3], torch.tensor([1.0, 2.0, 3.0]).double(), rtol=0, atol=1e-14)
    torch.testing.assert_close(frame[0, :3, :3], ds.rotation.to_matrix(q), rtol=0, atol=1e-15)
    assert torch.equal(moved.position[1:], state.position[1:])
    assert torch.equal(moved.velocity, state.velocity)
    # Each alone leaves the other as it is: the mesh turns about its own origin.
    turned, shifted = sim.place(state, 0, orientation=q), sim.place(state, 0, position=(1.0, 2.0, 3.0))
    torch.testing.assert_close(sim.mesh_transform(turned)[0, :3, 3], torch.tensor([0.0, 2.0, 5.0]).double())
    assert torch.equal(shifted.orientation, state.orientation)
    # As a scene has it that was made so, in float32, with one place per scene and one in time.
    positions = torch.randn(6, 3)
    placed = sim.place(state.to(torch.float32), 0, position=positions)
    assert placed.dtype == torch.float32
    assert placed.leading_shape == placed.node_velocity.shape[:-2] == (6,)
    torch.testing.assert_close(sim.mesh_transform(placed)[:, 0, :3, 3], positions)
    trajectory = sim.rollout(sim.initial_state(batch=2), steps=3)
    assert sim.place(trajectory, 0, position=torch.randn(3, 1, 3)).leading_shape == (3, 2)
    mapped = torch.func.vmap(lambda p: sim.place(state, 0, position=p))(positions.double())
    assert torch.equal(mapped.position, sim.place(state, 0, position=positions.double()).position)


def test_place_is_differentiable() -> None:
    sim, _ = offset_tetrahedron()
    state = sim.initial_state()
    p, q = torch.randn(2, 3, dtype=torch.float64), torch.randn(2, 4, dtype=torch.float64)
    before = state.orientation.clone()

    def places(p: Tensor, q: Tensor, before: Tensor) -> tuple[Tensor, ...]:
        start = state.replace(orientation=before)
        both, turned = sim.place(start, 0, position=p, orientation=q), sim.place(start, 0, orientation=q)
        return both.position, both.orientation, turned.position, sim.place(start, 0, position=p).position

    assert torch.func.jacrev(lambda q: places(p, q, before)[0])(q).any()
    assert torch.autograd.gradcheck(places, [t.requires_grad_() for t in (p, q, before)])


def test_wrong_places_are_named() -> None:
    scene = ds.Scene()
    ball = scene.add_sphere(0.1, density=1.0, name="ball")
    sheet = scene.add_cloth(ds.shapes.sheet((1.0, 1.0), (2, 2)), position=(0, 0, 5), name="sheet")
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state(batch=2)
    cases: list[tuple[Any, dict[str, Any], type[Exception], str]] = [
        (sheet, {}, ValueError, "place: handle must be of a body, got ClothHandle(1, 'sheet'"),
        (5, {}, IndexError, ""),
        (ball, {"position": (0, 0)}, ValueError, "place: position must have shape (..., 3), got (2,)"),
        (ball, {"position": "up"}, TypeError, "place: position must be a torch.Tensor or 3 numbers, got 'up'"),
        (ball, {"position": torch.zeros(3, 3).double()}, ValueError, "place: leading axes must broadcast with"),
        (
            ball,
            {"orientation": (0, 0, 0, 0)},
            ValueError,
            "place: orientation must be quaternions w, x, y, z other than",
        ),
    ]
    for handle, options, error, text in cases:
        with pytest.raises(error) as caught:
            sim.place(state, handle, **options)
        assert text in str(caught.value)


def test_vertices_are_differentiable() -> None:
    sim, _ = offset_tetrahedron()
    state = sim.initial_state()

    def world(position: Tensor, orientation: Tensor) -> Tensor:
        return sim.vertices(state.replace(position=position, orientation=orientation))

    inputs = (state.position.requires_grad_(), state.orientation.requires_grad_())
    assert torch.autograd.gradcheck(world, inputs)


def test_mesh_is_the_surface_in_the_world() -> None:
    sim, _ = offset_tetrahedron()
    state = sim.initial_state()
    body = sim.mesh(state, 0)
    np.testing.assert_allclose(body.vertices, sim.vertices(state)[:4].numpy(), atol=1e-14)
    assert body.is_watertight
    sphere = sim.mesh(state, 1)
    np.testing.assert_allclose(np.linalg.norm(sphere.vertices - [0, -5, 5], axis=1), 0.5, rtol=1e-6)
    capsule = sim.mesh(state, -1)
    ends = sim.vertices(state)[5:].numpy()
    axis = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    along = np.clip((capsule.vertices - ends[0]) @ axis, 0.0, 1.0)
    np.testing.assert_allclose(
        np.linalg.norm(capsule.vertices - ends[0] - along[:, None] * axis, axis=1), 0.25, rtol=1e-6
    )
    with pytest.raises(ValueError, match="mesh: state must be one state"):
        sim.mesh(sim.initial_state(batch=2), 0)
    with pytest.raises(IndexError):
        sim.mesh(state, 3)


def test_min_distance_above_the_ground_and_in_contact() -> None:
    scene = ds.Scene()
    scene.add_ground(margin=0.01)
    scene.add_sphere(0.5, density=1.0, position=(0, 0, 2))
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    distance = sim.min_distance(state)
    assert isinstance(distance, float)
    assert distance == pytest.approx(1.49, abs=1e-12)
    lifted = state.replace(
        position=state.position + torch.arange(3.0).double()[:, None, None] * torch.eye(3).double()[2]
    )
    distances = sim.min_distance(lifted)
    assert isinstance(distances, Tensor)
    np.testing.assert_allclose(distances.numpy(), [1.49, 2.49, 3.49], atol=1e-12)


def test_nothing_can_meet() -> None:
    scene = ds.Scene()
    scene.add_sphere(0.5, density=1.0)
    sim = ds.Simulator(scene, dt=0.01)
    assert sim.min_distance(sim.initial_state()) == float("inf")


def test_separate_moves_touching_bodies_apart_in_contact() -> None:
    scene = ds.Scene()
    scene.add_ground(margin=1e-3)
    ball = scene.add_sphere(0.5, density=1.0, position=(0, 0, 0.501), name="ball")
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    shift = state.position[ball, 2] - 0.501
    assert 0.0 <= shift <= sim.thickness
    low = state.position - torch.tensor([0.0, 0.0, 1e-4]).double()
    low.requires_grad_()
    apart = sim.separate(state.replace(position=low.expand(2, 1, 3)))
    assert apart.leading_shape == (2,)
    assert bool((apart.position[..., 2] > low[..., 2]).all())
    (gradient,) = torch.autograd.grad(apart.position.sum(), low)
    assert torch.equal(gradient, torch.full_like(low, 2.0))
    assert_same(sim.separate(apart), apart)
    sim.rollout(apart, None, 3)


def test_measurements_name_wrong_states(sim: ds.Simulator) -> None:
    wrong = ds.State(torch.zeros(3, 3))
    for name in ("kinetic_energy", "potential_energy", "momentum", "angular_momentum", "min_distance", "vertices"):
        with pytest.raises(ValueError, match=rf"{name}: state.position must have shape \(2, 3\)"):
            getattr(sim, name)(wrong)


# ---- what has no answer ----------------------------------------------------------------------------------------------


def fitting(**options: Any) -> tuple[ds.Scene, dict[str, Any]]:
    """A cube of 1 m exactly between two fixed ones."""
    scene = ds.Scene()
    for x in (-1.0, 1.0):
        scene.add_body(ds.shapes.box(1.0), kind="static", position=(x, 0.0, 0.0), name=f"wall at {x:g}")
    scene.add_body(ds.shapes.box(1.0), density=1.0, name="fit")
    return scene, {"dt": 0.01, **options}


def test_where_there_is_no_room_for_the_thickness_everything_says_so() -> None:
    no_room = r"no room.*'fit' and 'wall at -?1'.* 0 m apart.* need 0\.001 m.*lack 0\.001 m.*smaller thickness"
    scene, options = fitting()
    with pytest.raises(ValueError, match=no_room):
        ds.Simulator(scene, **options)
    sim = ds.Simulator(scene, **options, check=False)
    with pytest.raises(ValueError, match=no_room):
        sim.initial_state()
    position = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0], [0, 0, 0]], dtype=torch.float64)
    with pytest.raises(ValueError, match=no_room):
        sim.separate(ds.State(position))
    with pytest.raises(ValueError, match=r"are 0 m apart, where at rest they keep 0\.001 m"):
        sim(ds.State(position))


@pytest.mark.parametrize("count", [2, 4])
@pytest.mark.parametrize("gap", [0.0, 1e-3, 1.5e-3])
def test_what_is_lifted_off_the_ground_lifts_what_lies_on_it(count: int, gap: float) -> None:
    """Boxes whose gaps are the thickness, or a little more, are far enough apart until the lowest has moved."""
    scene = ds.Scene()
    scene.add_ground()
    for k in range(count):
        scene.add_body(ds.shapes.box(1.0), density=1e3, position=(-0.25 * k, 0.0, 0.5 + (1.0 + gap) * k))
    sim = ds.Simulator(scene, dt=0.01, thickness=1e-3)
    start = sim.initial_state()
    assert sim.min_distance(start) == pytest.approx(0.0, abs=1e-5)
    lifts = start.position[:, 2] - torch.tensor([0.5 + (1.0 + gap) * k for k in range(count)]).double()
    assert bool((lifts >= 0.0).all())
    assert lifts.max() < 1.1e-3 * count


def test_a_little_room_is_enough() -> None:
    scene = ds.Scene()
    for x in (-1.001, 1.001):
        scene.add_body(ds.shapes.box(1.0), kind="static", position=(x, 0.0, 0.0))
    scene.add_body(ds.shapes.box(1.0), density=1.0, position=(0.0009, 0.0, 0.0))
    sim = ds.Simulator(scene, dt=0.01, thickness=1e-3)
    assert sim.min_distance(sim.initial_state()) == pytest.approx(0.0, abs=1e-5)
    sim(sim.initial_state())


def test_meshes_that_cross_are_not_separated_silently() -> None:
    scene = ds.Scene()
    scene.add_body(ds.shapes.box(2.0), density=1.0, name="large", position=(5, 0, 0))
    scene.add_body(ds.shapes.box(0.5), density=1.0, name="small")
    sim = ds.Simulator(scene, dt=0.01)
    state = sim.initial_state()
    state.position[0] = torch.tensor([1.1, 0.0, 0.0])
    with pytest.raises(ValueError, match=r"'large' and 'small'.*meshes cross"):
        sim.separate(state)


def test_no_bodies_and_no_scenes_are_measured() -> None:
    scene = ds.Scene()
    scene.add_ground()
    empty = ds.Simulator(scene, dt=0.01)
    assert empty.min_distance(empty.initial_state()) == float("inf")
    assert empty.min_distance(empty.initial_state(batch=3)).tolist() == [float("inf")] * 3  # type: ignore[union-attr]
    assert empty.separate(empty.initial_state(batch=3)).position.shape == (3, 0, 3)
    sim = ds.Simulator(make_scene(), dt=0.01)
    none = sim.initial_state(batch=1)[:0]
    assert none.position.shape == (0, 2, 3)
    assert sim.min_distance(none).shape == (0,)  # type: ignore[union-attr]
    assert sim.separate(none).position.shape == (0, 2, 3)


def test_bodies_that_never_collide_have_no_distance() -> None:
    scene = ds.Scene()
    scene.add_ground()
    scene.add_body(ds.shapes.box(1.0), kind="static")
    for x in (0.3, 0.4):
        scene.add_body(ds.shapes.box(1.0), kind="kinematic", position=(x, 0.0, 0.3))
    sim = ds.Simulator(scene, dt=0.01)
    assert sim.min_distance(sim.initial_state()) == float("inf")


@pytest.mark.parametrize("name", ["min_distance", "separate"])
def test_transforms_are_refused_with_a_message(sim: ds.Simulator, name: str) -> None:
    with pytest.raises(NotImplementedError, match=rf"{name}: cannot run inside a transform of torch\.func"):
        torch.func.vmap(getattr(sim, name))(sim.initial_state(batch=2))
