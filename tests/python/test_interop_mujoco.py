"""Scenes from MuJoCo's models and states from and to its data."""

from __future__ import annotations

import sys
import warnings
from typing import Any

import numpy as np
import pytest
import torch

import diffsim as ds

mujoco = pytest.importorskip("mujoco", reason='pip install "mesh-diffsim[mujoco]"')

SCENE = """<mujoco><compiler angle="radian"/><option gravity="0 0 -3"/><worldbody>
<geom name="low" type="plane" size="0 0 1" pos="0 0 -9"/><geom name="high" type="plane" size="1 1 1" pos="0 0 -8"/>
<geom name="ramp" type="plane" size="1 2 1" pos="9 0 0" euler="0 0.5 0"/>
<body name="post" pos="1 0 0"><geom type="sphere" size=".1"/>
  <body name="arm" pos="0 0 1" euler="0 0.7 0"><geom name="bar" type="capsule" size=".1 .2"/></body></body>
<body name="hand" mocap="true" pos="2 0 1" euler="0.1 0.2 0.3"><geom type="box" size=".1 .1 .1" pos="0 0 .2"/>
  <body pos="0 0 .5"><geom type="sphere" size=".05"/></body></body>
<body name="welded" pos="0 0 1" euler="0.1 0.2 0.3"><freejoint/>
  <geom type="capsule" fromto="0 0 0 .1 .2 .3" size=".03"/>
  <body pos="0 .5 0" euler="0.5 0.4 0.3"><geom type="ellipsoid" size=".1 .2 .3" mass="3"/></body></body>
<body name="pin" pos="-1 0 1" euler="0.3 0.2 0.1"><freejoint/><geom type="capsule" fromto="0 0 0 .1 .2 .3" size=".03"/>
  <inertial mass="2" pos=".1 0 0" diaginertia=".02 .02 .03"/></body>
<body name="ball" pos="-2 0 1" euler="0.3 0.2 0.1"><freejoint/><geom type="sphere" size=".3" pos=".1 0 0"/>
  <geom contype="0" conaffinity="0" type="box" size=".1 .1 .1"/></body>
</worldbody></mujoco>"""
FREE = ("welded", "pin", "ball")


def one(body: str, options: str = "") -> str:
    return f'<mujoco><option gravity="0 0 0"/>{options}<worldbody>{body}</worldbody></mujoco>'


def free(geom: str, extra: str = "") -> str:
    return f'<body name="b" pos="0 0 1"><freejoint name="j"/>{geom}{extra}</body>'


BOX = '<geom name="g" type="box" size=".1 .2 .3" condim="1"/>'


def loaded(xml: str, dt: float = 0.01) -> tuple[Any, Any, ds.Simulator]:
    model = mujoco.MjModel.from_xml_string(xml)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scene = ds.interop.mujoco.load(model)
    return model, mujoco.MjData(model), ds.Simulator(scene, dt=dt)


def set_at_random(model: Any, data: Any) -> None:
    rng = np.random.default_rng(3)
    for joint in range(model.njnt):
        at = model.jnt_qposadr[joint]
        data.qpos[at : at + 3] = rng.normal(size=3)
        turn = rng.normal(size=4)
        data.qpos[at + 3 : at + 7] = turn / np.linalg.norm(turn)
    data.qvel[:] = rng.normal(size=model.nv)
    data.mocap_pos[:] = rng.normal(size=data.mocap_pos.shape)
    mujoco.mj_forward(model, data)


def test_bodies_are_where_mujoco_has_them() -> None:
    model, data, sim = loaded(SCENE)
    assert sim.body_names == ("world/ramp", "post/geom_3", "arm/bar", "hand", *FREE)
    assert (sim._packed.ground_height, sim.gravity.tolist()) == (-8.0, [0.0, 0.0, -3.0])
    torch.testing.assert_close(ds.interop.mujoco.from_mjdata(sim, model, data).position, sim.initial_state().position)
    set_at_random(model, data)
    matrices = sim.mesh_transform(ds.interop.mujoco.from_mjdata(sim, model, data)).numpy()
    for name in ("hand", *FREE):
        body = sim.body_names.index(name)
        np.testing.assert_allclose(matrices[body, :3, 3], data.body(name).xpos, atol=1e-14)
        np.testing.assert_allclose(matrices[body, :3, :3].ravel(), data.body(name).xmat, atol=1e-14)


def test_mass_energy_and_momentum_are_mujocos() -> None:
    model, data, sim = loaded(SCENE)
    set_at_random(model, data)
    state = ds.interop.mujoco.from_mjdata(sim, model, data)
    mujoco.mj_energyVel(model, data)
    assert sim.kinetic_energy(state).item() == pytest.approx(data.energy[1], rel=1e-13)
    mujoco.mj_subtreeVel(model, data)
    for name in FREE:
        index, body = sim.body_names.index(name), model.body(name)
        assert sim.mass[index].item() == pytest.approx(body.subtreemass[0], rel=1e-14)
        np.testing.assert_allclose(state.position[index], data.body(name).subtree_com, atol=1e-14)
        np.testing.assert_allclose(state.velocity[index], data.body(name).subtree_linvel, atol=1e-14)
        inertia, turn = sim.inertia[index], ds.rotation.to_matrix(state.orientation[index])
        spin = turn @ inertia @ turn.T @ state.angular_velocity[index]
        np.testing.assert_allclose(spin.detach(), data.body(name).subtree_angmom, atol=1e-13)


def test_states_go_there_and_back_without_a_change() -> None:
    model, data, sim = loaded(SCENE)
    set_at_random(model, data)
    state = ds.interop.mujoco.from_mjdata(sim, model, data)
    copy = mujoco.MjData(model)
    ds.interop.mujoco.to_mjdata(sim, state, model, copy)
    for name in ("qpos", "qvel", "mocap_pos", "mocap_quat"):
        assert getattr(data, name).any()
        np.testing.assert_allclose(getattr(copy, name), getattr(data, name), rtol=0.0, atol=2e-15)
    again = ds.interop.mujoco.from_mjdata(sim, model, copy)
    for name, value in state.__dict__.items():
        torch.testing.assert_close(getattr(again, name), value, rtol=0.0, atol=2e-15)


def test_free_flight_is_mujocos_to_the_first_order() -> None:
    xml = one(free('<geom type="box" size=".1 .2 .3" pos=".2 0 .1"/><geom type="box" size=".1 .1 .1" pos="0 .3 0"/>'))
    model = mujoco.MjModel.from_xml_string(xml.replace('gravity="0 0 0"', 'timestep="0.001" integrator="RK4"'))
    start = np.array([0.5, -0.3, 4.0, 1.0, 2.0, -0.5])
    data = mujoco.MjData(model)
    data.qvel[:] = start
    for _ in range(500):
        mujoco.mj_step(model, data)
    errors = []
    for steps in (100, 200, 400):
        _, begin, sim = loaded(xml.replace('gravity="0 0 0"', ""), dt=0.5 / steps)
        begin.qvel[:] = start
        state = sim.rollout(ds.interop.mujoco.from_mjdata(sim, model, begin), None, steps)[-1]
        end = mujoco.MjData(model)
        ds.interop.mujoco.to_mjdata(sim, state, model, end)
        errors.append([np.abs(end.qpos - data.qpos).max(), np.abs(end.qvel - data.qvel).max()])
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 2.0, atol=0.1)
    assert np.max(errors[-1]) < 0.01


def test_flight_without_spin_is_mujocos_euler_step_by_step() -> None:
    xml = f'<mujoco><option timestep="0.01"/><worldbody>{free(BOX)}</worldbody></mujoco>'
    model, data, sim = loaded(xml)
    data.qvel[:3] = 1.0, 2.0, 3.0
    trajectory = sim.rollout(ds.interop.mujoco.from_mjdata(sim, model, data), None, 20)
    for state in trajectory:
        mujoco.mj_step(model, data)
        np.testing.assert_allclose(state.position[0], data.qpos[:3], atol=1e-14)


def test_a_stack_at_rest_in_mujoco_is_taken_apart_before_a_step() -> None:
    boxes = "".join(
        f'<body pos="0 0 {0.1 + 0.2 * i}"><freejoint/><geom type="box" size=".1 .1 .1" mass="{mass}"/></body>'
        for i, mass in enumerate((1, 5, 2, 20))
    )
    model, data, sim = loaded(f'<mujoco><worldbody><geom type="plane" size="0 0 1"/>{boxes}</worldbody></mujoco>')
    mujoco.mj_step(model, data, 500)
    deep = min(contact.dist for contact in data.contact)
    assert deep < -1e-4
    with pytest.raises(ValueError, match=r"cross|in the ground"):
        sim(ds.interop.mujoco.from_mjdata(sim, model, data))
    before = data.qpos.copy()
    state = ds.interop.mujoco.from_mjdata(sim, model, data, separate=True)
    assert (data.qpos == before).all()
    raised = state.position[:, 2] - ds.interop.mujoco.from_mjdata(sim, model, data).position[:, 2]
    assert (raised > 0.0).all()
    assert raised.max() < 10.0 * (sim.thickness - deep)
    assert sim.rollout(state, None, 20)[-1].velocity.abs().max() < 0.02
    assert sim.info is not None
    assert sim.info.converged


@pytest.mark.parametrize(
    ("geom", "vertices"),
    [
        ('type="box" size=".1 .2 .3"', 8),
        ('type="sphere" size=".1"', 1),
        ('type="capsule" size=".1 .2"', 2),
        ('type="cylinder" size=".1 .2"', 64),
        ('type="ellipsoid" size=".1 .2 .3"', 642),
    ],
)
def test_geoms_have_their_shape(geom: str, vertices: int) -> None:
    model, _, sim = loaded(one(free(f'<geom {geom} pos=".1 .2 .3" euler="10 20 30"/>')))
    assert sim._packed.vertex_count.tolist() == [vertices]
    corners = sim.mesh(sim.initial_state(), 0).vertices - [0.0, 0.0, 1.0]
    inside = (corners - model.geom_pos[0]) @ ds.rotation.to_matrix(model.geom_quat[0])  # geom axes
    half = model.geom_aabb[0, 3:]
    np.testing.assert_allclose(np.abs(inside).max(axis=0), half, rtol=0.01)
    assert (np.abs(inside) <= half * (1.0 + 1e-6)).all()


def test_a_mesh_is_what_it_is_and_not_its_hull() -> None:
    vertices, faces = ds.shapes.u_channel()
    text = " ".join(map(str, vertices.ravel())), " ".join(map(str, faces.ravel()))
    asset = f'<asset><mesh name="u" vertex="{text[0]}" face="{text[1]}"/></asset>'
    xml = one('<geom type="mesh" mesh="u"/><body pos="0 0 .5"><freejoint/><geom size=".1"/></body>', asset)
    _, _, sim = loaded(xml.replace('gravity="0 0 0"', ""))
    end = sim.rollout(sim.initial_state(), None, 100)[-1]
    assert end.position[1, 2].item() == pytest.approx(0.3, abs=1e-3)  # on the floor of the channel, 0.2 m thick


def test_a_body_whose_centre_of_mass_is_not_its_meshes_has_right_gradients() -> None:
    xml = one(
        '<geom type="plane" size="0 0 1"/>' + free(BOX, '<inertial mass="2" pos=".12 0 0" diaginertia=".1 .1 .1"/>')
    )
    model, data, sim = loaded(xml.replace('gravity="0 0 0"', ""))
    data.qpos[2] = 0.31
    state = ds.interop.mujoco.from_mjdata(sim, model, data)
    report = ds.diagnostics.gradcheck(sim, state, steps=30, directions=4, median_tolerance=1e-5, max_tolerance=1e-2)
    end = sim.rollout(state, None, 30)[-1]
    assert end.orientation[0, 0] < 1.0 - 1e-6  # pushed up beside its centre of mass, it tips
    assert report.median_error <= 1e-5


REFUSED = [
    (f'<body name="b"><joint name="knee"/>{BOX}</body>', "", "joint 'knee' of body 'b', a hinge joint,"),
    (f'<body name="b"><joint name="rail" type="slide"/>{BOX}</body>', "", "'rail' of body 'b', a slide joint,"),
    (free(BOX, '<body><joint name="s" type="ball"/><geom size=".1"/></body>'), "", "a ball joint"),
    (f'<body><joint name="j" type="free" damping="1"/>{BOX}</body>', "", "the damping of joint 'j'"),
    (free(BOX), '<actuator><motor name="m" joint="j"/></actuator>', "actuator 'm'"),
    (free(BOX), '<equality><weld name="w" body1="b"/></equality>', "equality 'w'"),
    (
        free(BOX, '<site name="s"/><site name="t"/>'),
        '<tendon><spatial name="rope"><site site="s"/><site site="t"/></spatial></tendon>',
        "tendon 'rope'",
    ),
    (
        '<geom name="hill" type="hfield" hfield="h"/>',
        '<asset><hfield name="h" nrow="3" ncol="3" size="1 1 1 1"/></asset>',
        "geom 'world/hill', a height field,",
    ),
    (free(BOX).replace('name="b"', 'name="b" gravcomp="1"'), "", "gravcomp of body 'b'"),
    (free(BOX), '<option density="1.2"/>', "the medium"),
    (free(BOX) + '<geom name="w" size=".1" contype="2" conaffinity="2"/>', "", "geoms 'world/w' and 'b/g'"),
]


@pytest.mark.parametrize(("body", "options", "name"), REFUSED, ids=[name for _, _, name in REFUSED])
def test_what_a_scene_cannot_be_is_refused_by_name(body: str, options: str, name: str) -> None:
    with pytest.raises(NotImplementedError, match="cannot be taken") as error:
        ds.interop.mujoco.load(one(body, options))
    assert name in str(error.value)


def test_bodies_without_a_surface_and_planes_without_end_are_refused() -> None:
    with pytest.raises(ValueError, match="body 'b' has no geom that collides"):
        ds.interop.mujoco.load(one(free('<geom size=".1" contype="0" conaffinity="0"/>')))
    with pytest.raises(ValueError, match="plane 'world/ramp' is not horizontal and has no end"):
        ds.interop.mujoco.load(one('<geom name="ramp" type="plane" size="0 0 1" euler="0 30 0"/>'))


SLOPE = """<mujoco><option timestep="0.01" gravity="3.0 0 -9.0" cone="elliptic" impratio="100"/><worldbody>
<geom type="plane" size="0 0 1" friction="0.2"/>
<body name="b" pos="0 0 0.101"><freejoint/><geom type="box" size=".2 .2 .1" friction="0.2"/></body>
</worldbody></mujoco>"""


def test_friction_is_mujocos_between_equal_coefficients() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sim = ds.Simulator(ds.interop.mujoco.load(SLOPE), dt=0.01)
    model = mujoco.MjModel.from_xml_string(SLOPE)
    data = mujoco.MjData(model)
    state = sim.rollout(sim.initial_state(), steps=50)[-1]
    mujoco.mj_step(model, data, 50)
    assert sim.friction.tolist() == pytest.approx([0.2, 0.2])
    assert state.velocity[0, 0].item() == pytest.approx(0.5 * (3.0 - 0.2 * 9.0), abs=0.01)
    assert data.qvel[0] == pytest.approx(state.velocity[0, 0].item(), rel=0.05)  # it has a contact's softness to go


def test_friction_that_differs_from_mujocos_is_warned_of_once() -> None:
    both = one(free('<geom type="box" size=".1 .2 .3" friction="0.5"/><geom type="sphere" size=".1" friction="0.7"/>'))
    with pytest.warns(UserWarning, match="takes the larger, here their geometric mean acts") as caught:
        scene = ds.interop.mujoco.load(both)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    np.testing.assert_array_equal(scene.pack().friction, [0.7])
    with pytest.warns(UserWarning, match=r"torsional and rolling friction \(condim 4 and 6\) are left out"):
        ds.interop.mujoco.load(one(free(BOX.replace('condim="1"', 'condim="4"'))))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_array_equal(ds.interop.mujoco.load(SCENE).pack().friction, 1.0)  # MuJoCo's default
        np.testing.assert_array_equal(ds.interop.mujoco.load(one(free(BOX))).pack().friction, 0.0)


def test_files_are_read(tmp_path: Any) -> None:
    path = tmp_path / "scene.xml"
    path.write_text(one(free(BOX)))
    for source in (path, str(path)):
        assert "1 dynamic" in repr(ds.interop.mujoco.load(source))


def test_data_of_another_model_is_refused() -> None:
    model, data, sim = loaded(one(free(BOX)))
    other = mujoco.MjModel.from_xml_string(one(free(BOX.replace('condim="1"', 'pos=".1 0 0"'))))
    with pytest.raises(ValueError, match="body 'b' of the simulator is not the one of this model"):
        ds.interop.mujoco.from_mjdata(sim, other, mujoco.MjData(other))
    renamed = mujoco.MjModel.from_xml_string(one(free(BOX)).replace('name="b"', 'name="c"'))
    with pytest.raises(ValueError, match="the simulator has no body 'c'"):
        ds.interop.mujoco.to_mjdata(sim, sim.initial_state(), renamed, mujoco.MjData(renamed))
    with pytest.raises(ValueError, match="to_mjdata: state must be one state"):
        ds.interop.mujoco.to_mjdata(sim, sim.initial_state(batch=2), model, data)


def test_what_a_user_adds_to_the_scene_stays_as_it_is() -> None:
    model = mujoco.MjModel.from_xml_string(one(free(BOX)))
    scene = ds.interop.mujoco.load(model)
    extra = scene.add_sphere(0.1, mass=1.0, position=(5.0, 0.0, 0.0), velocity=(1.0, 0.0, 0.0))
    sim = ds.Simulator(scene, dt=0.01)
    data = mujoco.MjData(model)
    data.qpos[0] = 3.0
    state = ds.interop.mujoco.from_mjdata(sim, model, data)
    assert state.position[:, 0].tolist() == [3.0, 5.0]
    assert state.velocity[extra].tolist() == [1.0, 0.0, 0.0]


def test_a_missing_mujoco_is_named_with_what_mends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "diffsim.interop.mujoco", raising=False)
    monkeypatch.delattr(ds.interop, "mujoco", raising=False)
    with pytest.raises(ImportError) as error:
        ds.interop.mujoco  # noqa: B018
    assert str(error.value) == 'diffsim.interop.mujoco needs mujoco: pip install "mesh-diffsim[mujoco]"'
