"""Where the tool is and how motors move it, against the arm's kinematics and the simulator itself."""

import math

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from nht.recipes.live.basis import present_basis
from nht.recipes.live.mirror import Mirror, root_that_goes_about
from nht.recipes.live.opening import open_session
from nht.recipes.live.shapes import G, capsule, shape_of_geom
from nht.recipes.live.tool import Tool, angle_to_jacobian, rises
from nht.recipes.maps.kinds import arm_of
from steered import config, moves


@pytest.fixture
def opened():
    found = open_session(config("seed=1"))
    yield found
    found.session.close()


def test_the_tool_is_where_the_task_says(opened):
    session, mirror, tool = opened
    moves(session, [0.5, 0.5, 0.2, 0, 0, 0.1], 10)
    mirror.look()
    assert np.allclose(tool.position, session.observed["tool_position"][0], atol=1e-6)


def test_on_the_way_of_a_step_the_pose_is_between_its_ends(opened):
    session, mirror, _ = opened
    ends = [np.array(mirror.data.qpos)]
    moves(session, [0.5, 0.5, 0.2, 0, 0, 0.1], 1)
    for part in (0.0, 0.25, 1.0):
        mirror.look(part)
        ends.append(np.array(mirror.data.qpos))
    start, first, quarter, last = ends
    assert np.allclose(first, start)
    assert np.allclose(last, session.observed["joint_angle"][0], atol=1e-6)
    assert np.allclose(quarter, start + 0.25 * (last - start))
    session.next_goal()
    mirror.jump()
    mirror.look(0.0)
    assert np.allclose(mirror.data.qpos, session.observed["joint_angle"][0], atol=1e-6)


def test_its_jacobian_is_that_of_the_arm(opened):
    session, mirror, tool = opened
    moves(session, [0.5, 0.5, 0.2, 0, 0, 0.1], 10)
    mirror.look()
    expected = arm_of("wam_wipe").jacobian(session.observed["joint_angle"].double())[0]
    assert np.allclose(tool.motion(7), expected, atol=1e-6)


def test_an_arrow_says_where_the_tool_goes(opened):
    session, mirror, tool = opened
    basis = present_basis(session, tool)
    for axis in range(session.interface.action_dim):
        session.reset()
        mirror.look()
        before = tool.position
        moves(session, (0.2 * torch.eye(6)[axis]).tolist(), 1)
        mirror.look()
        moved = (tool.position - before) / (0.2 * session.task.time_per_step)
        assert np.allclose(moved, basis.motion[:3, axis], atol=5e-3)


def test_controls_accelerate_the_tool_of_a_robot_with_dynamics():
    session, mirror, tool = open_session(config("env=half_cheetah", "seed=1"))
    assert tool.moves_by == "acceleration"
    mirror.look()
    found = tool.motion(6)
    model, jacobian = mirror.model, tool.jacobian()
    velocity = []
    for control in (np.zeros(6), np.array([0.01, 0, 0, 0, 0, 0])):
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, session.task.state[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        velocity.append(data.qvel.copy())
    expected = jacobian @ (velocity[1] - velocity[0]) / 0.01 / model.opt.timestep
    assert np.allclose(found[:, 0], expected, rtol=1e-2, atol=1e-3)
    assert present_basis(session, tool).angle is None
    session.close()


def test_a_tool_can_be_named_and_a_wrong_name_lists_what_there_is(opened):
    mirror = opened.mirror
    assert Tool(mirror, "tool").kind == mujoco.mjtObj.mjOBJ_SITE
    elbow = Tool(mirror, "link4")
    assert np.allclose(elbow.position, mirror.data.body("link4").xpos)
    with pytest.raises(ValueError, match=r"no part 'hand': its sites are \['tool'\], its bodies \['base', "):
        Tool(mirror, "hand")


@given(st.integers(0, 10_000), st.integers(1, 6))
def test_the_angle_to_the_jacobian_is_that_of_the_subspaces(seed, k):
    random = np.random.default_rng(seed)
    jacobian, effects = random.normal(size=(6, 7)), random.normal(size=(7, k))
    angle = angle_to_jacobian(effects, jacobian)
    assert 0 <= angle <= math.pi / 2 + 1e-9
    mixed = effects @ (random.normal(size=(k, k)) + 3 * np.eye(k))
    assert math.isclose(angle, angle_to_jacobian(mixed, jacobian), abs_tol=1e-5)
    economical = np.linalg.pinv(jacobian) @ jacobian @ effects
    assert angle_to_jacobian(economical, jacobian) < 1e-6
    within = np.linalg.svd(jacobian)[2][-1:].T  # moves the arm, not the tool
    assert math.isclose(angle_to_jacobian(within, jacobian), math.pi / 2, abs_tol=1e-6)


def test_what_rises():
    assert rises(np.array([1.0, 0, 0])) == 0
    assert math.isclose(rises(np.array([0, 1.0, 1.0])), math.pi / 4)
    assert math.isclose(rises(np.array([0, 0, -2.0])), -math.pi / 2)
    assert rises(np.zeros(3)) == 0


def test_a_capsule_is_as_large_as_it_should_be_and_closed():
    vertices, faces = capsule(0.1, 0.3)
    assert np.allclose(vertices.max(axis=0), [0.1, 0.1, 0.4], atol=1e-3)
    outward = vertices - np.clip(vertices * [0, 0, 1], [0, 0, -0.3], [0, 0, 0.3])
    assert np.allclose(np.linalg.norm(outward, axis=1), 0.1)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.linalg.norm(normal, axis=1) < 1e-12  # at the poles
    assert ((normal * outward[faces].mean(axis=1)).sum(axis=1)[~flat] > 0).all()
    volume = np.einsum("ij,ij->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    assert math.isclose(volume, math.pi * 0.01 * (0.6 + 4 / 3 * 0.1), rel_tol=0.03)


@pytest.mark.parametrize("kind", [G.mjGEOM_BOX, G.mjGEOM_CAPSULE, G.mjGEOM_ELLIPSOID, G.mjGEOM_PLANE])
def test_shapes_have_the_model_s_sizes_and_colours(kind):
    name = {G.mjGEOM_BOX: "box", G.mjGEOM_CAPSULE: "capsule", G.mjGEOM_ELLIPSOID: "ellipsoid"}.get(
        kind, "plane"
    )
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><asset><material name="red" rgba="1 0 0 .5"/></asset><worldbody>
        <geom type="{name}" size=".1 .2 .3" material="red"/><geom type="{name}" size=".1 .2 .3" rgba="0 0 1 0"/>
        <geom type="{name}" size=".1 .2 .3" group="3"/></worldbody></mujoco>""")
    shape = shape_of_geom(model, 0)
    assert (shape.kind, shape.colour, shape.opacity) == (kind, (255, 0, 0), 0.5)
    assert shape.size[0] == pytest.approx(0.1)
    assert shape_of_geom(model, 1) is None  # cannot be seen
    assert shape_of_geom(model, 2) is None  # is for collisions


@pytest.mark.parametrize(
    "words",
    [["env=wam_grasp"], ["env=gymnasium", "env.name=Pusher-v5"], ["env=dm_control", "env.name=reacher-easy"]],
)
def test_robots_of_all_suites_can_be_looked_at(words):
    session, mirror, tool = open_session(config(*words, "seed=1"))
    moves(session, [0.5] * session.interface.action_dim, 3)
    mirror.look()
    assert isinstance(mirror, Mirror)
    assert np.isfinite(tool.position).all()
    assert any(shape_of_geom(mirror.model, geom) for geom in range(mirror.model.ngeom))
    basis = present_basis(session, tool)
    assert basis.motion.shape == (6, session.interface.action_dim)
    assert np.abs(basis.motion).max() > 0
    session.close()


@pytest.mark.parametrize(
    ("env", "root"),
    [
        (["env=half_cheetah"], "torso"),
        (["env=ant"], "torso"),
        (["env=gymnasium", "env.name=Swimmer-v5"], "torso"),
        (["env=wam_grasp"], None),
        (["env=gymnasium", "env.name=InvertedPendulum-v5"], None),
        (["env=gymnasium", "env.name=Pusher-v5"], None),
    ],
)
def test_what_can_run_away_is_known(env, root):
    opened = open_session(config(*env))
    model, found = opened.mirror.model, opened.mirror.root
    opened.session.close()
    assert found == root_that_goes_about(model)
    assert (None if found is None else model.body(found).name) == root
