"""Collisions of the arm against MuJoCo's own, the rules of WAMGrasp and its expert."""

import math

import mujoco
import numpy as np
import pytest
from test_wam import STILL, drive, posture_at, step

from nht.envs import make_expert, make_task
from nht.envs.experts import arc
from nht.envs.wam import brake
from nht.envs.wam_collision import ArmGeoms
from nht.envs.wam_grasp import (
    GRASP_POLAR_ANGLE,
    GRASP_RADIUS,
    HOME,
    OBJECT_CENTRE,
    OBJECT_RADIUS,
    TABLE_TOP,
    clearance,
    draw_grasp_points,
    grasp_model,
    grasp_point,
    grasp_posture,
)
from nht.envs.wam_kinematics import JOINT_HIGH, JOINT_LOW, MAX_SPEED, tool_pose

X, Z = np.eye(3)[0], np.eye(3)[2]
BESIDE = grasp_point(np.array([0.5]), np.array([2.0]))[0]  # a grasp point


def make_grasp(num_envs=1, **options):
    return make_task("wam_grasp", num_envs=num_envs, seed=0, **options)


# Collisions.

SNAKE = """
<mujoco>
  <worldbody>
    <geom name="ball" type="sphere" pos="0.3 0.1 0.2" size="0.15"/>
    <geom name="ground" type="plane" pos="0 0 0.2" size="1 1 1"/>
    <body pos="0.1 0 0.3" euler="30 40 50">
      <body quat="1 0 0 0"> {joints}
        <geom name="capsule" type="capsule" fromto="0 0 0 0.2 0.1 -0.15" size="0.03"/>
        <body pos="0.2 0.1 0.05">
          <joint axis="{second}" pos="-0.1 0 0.02" ref="0.3"/>
          <geom name="sphere" type="{shape}" pos="0.05 0 0.02" size="0.06 0.06 0.06"/>
          <geom name="cylinder" type="cylinder" pos="0.1 0.1 0" euler="20 70 0" size="0.05 0.1"/>
          <site name="{tool}" pos="0.2 0.1 -0.1" euler="10 50 0"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>"""


def snake(joints='<joint axis="0 -1 0"/>', second="1 0 0", shape="sphere", tool="tool", turned=False):
    """A chain of two hinges that carries all kinds of geoms."""
    xml = SNAKE.format(joints=joints, second=second, shape=shape, tool=tool)
    return mujoco.MjModel.from_xml_string(xml if turned else xml.replace('euler="30 40 50"', ""))


def test_tool_is_where_mujoco_puts_it():
    model = snake()
    data = mujoco.MjData(model)
    postures = np.random.default_rng(0).uniform(-4, 4, (50, 2))
    placed = ArmGeoms(model).place(postures)
    for i, data.qpos[:] in enumerate(postures):
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(placed.tool_position[i], data.site("tool").xpos, atol=1e-12)
        np.testing.assert_allclose(placed.tool_axis[i], data.site("tool").xmat[2::3], atol=1e-12)


def by_mujoco(model, arm, postures, ball, ground):
    """MuJoCo's distances to ball and ground, and whether it finds a contact, each ``(N, 2, G)``."""
    geoms = [model.geom(name).id for name in arm.names]
    obstacles = [model.geom(ball).id, model.geom(ground).id]
    data = mujoco.MjData(model)
    distances, contacts = [], []
    for posture in postures:
        data.qpos[:] = posture
        mujoco.mj_forward(model, data)
        touching = {frozenset(contact.geom.tolist()) for contact in data.contact}
        pairs = [[(geom, obstacle) for geom in geoms] for obstacle in obstacles]
        distances.append(
            [[mujoco.mj_geomDistance(model, data, *pair, 10.0, None) for pair in row] for row in pairs]
        )
        contacts.append([[frozenset(pair) in touching for pair in row] for row in pairs])
    return np.array(distances), np.array(contacts)


def test_distances_and_contacts_of_the_arm_are_mujocos():
    rng = np.random.default_rng(0)
    anywhere = rng.uniform(JOINT_LOW, JOINT_HIGH, (1500, 7))
    near = grasp_posture(draw_grasp_points(rng, 1500), np.tile(HOME, (1500, 1)))[0]
    postures = np.concatenate([anywhere, near + rng.uniform(-0.4, 0.4, (1500, 7))])
    model = grasp_model()
    model.opt.disableflags = 0
    arm = ArmGeoms(model)
    placed = arm.place(postures)
    ours = np.stack(
        [
            arm.distance_to_sphere(placed, OBJECT_CENTRE, OBJECT_RADIUS),
            arm.distance_to_floor(placed, TABLE_TOP),
        ],
        axis=1,
    )
    theirs, contacts = by_mujoco(model, arm, postures, "object", "table")

    # The first drum only turns about the vertical; MuJoCo divides by 0 for an upright cylinder over a plane.
    drum = arm.names.index("shoulder_yaw_housing")
    np.testing.assert_allclose(ours[:, 1, drum], -0.11 - TABLE_TOP, atol=1e-9)
    theirs[:, 1, drum] = -0.11 - TABLE_TOP
    np.testing.assert_allclose(ours, theirs, atol=1e-9)
    np.testing.assert_array_equal(ours < 0, contacts)
    np.testing.assert_array_equal(clearance(arm, placed) < 0, contacts.any(axis=(1, 2)))
    hits = contacts.sum(axis=0)
    assert (hits[:, [arm.names.index(name) for name in ("tool_pad", "palm", "wrist", "forearm")]] > 0).all()


def test_every_moving_geom_of_the_model_is_looked_at():
    model = grasp_model()
    still = {"floor", "table", "object", "base_plate", "base_column"}
    assert {model.geom(i).name for i in range(model.ngeom)} - still == set(ArmGeoms(model).names)
    assert model.geom("object").size[0] == OBJECT_RADIUS
    np.testing.assert_array_equal(model.geom("object").pos, OBJECT_CENTRE)
    assert model.geom("table").pos[2] == TABLE_TOP


def test_spheres_and_other_hinges():
    model = snake()
    arm = ArmGeoms(model)
    assert sorted(arm.names) == ["capsule", "cylinder", "sphere"]
    postures = np.random.default_rng(0).uniform(-4, 4, (500, 2))
    placed = arm.place(postures)
    ours = [
        arm.distance_to_sphere(placed, np.array([0.3, 0.1, 0.2]), 0.15),
        arm.distance_to_floor(placed, 0.2),
    ]
    theirs, contacts = by_mujoco(model, arm, postures, "ball", "ground")
    np.testing.assert_array_equal(np.stack(ours, axis=1) < 0, contacts)
    # Deeper than that the ball's centre may lie within a geom, and there is more than one way out.
    shallow = theirs > -0.15
    np.testing.assert_allclose(np.stack(ours, axis=1)[shallow], theirs[shallow], atol=1e-9)
    assert contacts.any(axis=0).all()
    assert not contacts.all(axis=0).any()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": "box"}, "moving geom 'sphere' must be a sphere, a capsule or a cylinder, got mjGEOM_BOX"),
        ({"joints": '<joint type="slide"/>'}, "must all be hinges"),
        ({"joints": ""}, None),
        ({"joints": '<joint/><body name="twig"><joint/><geom size="1"/></body>'}, "must be one chain"),
        ({"tool": "thumb"}, 'must have a site "tool" that its last joint moves'),
        ({"turned": True}, "must lie along x, y or z at joint angles 0"),
    ],
)
def test_arms_that_cannot_be_placed(change, message):
    if message is None:
        assert "capsule" not in ArmGeoms(snake(**change)).names  # no joint moves it
        return
    with pytest.raises(ValueError, match=message):
        ArmGeoms(snake(**change))


# Where episodes start and end.


def test_grasp_points_lie_on_their_sphere_and_can_all_be_reached():
    points = draw_grasp_points(np.random.default_rng(0), 3000)
    outward = (points - OBJECT_CENTRE) / GRASP_RADIUS
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0)
    assert (outward[:, 2] > math.cos(GRASP_POLAR_ANGLE)).all()
    assert len(np.unique(points, axis=0)) == 3000

    posture, exact = grasp_posture(points, np.tile(HOME, (3000, 1)), iterations=40)
    assert exact.all()
    assert brake(posture, np.ones((3000, 7))).all()
    assert brake(posture, -np.ones((3000, 7))).all()
    arm = ArmGeoms(grasp_model())
    assert clearance(arm, arm.place(posture)).min() > 0.04
    position, normal = tool_pose(posture)
    np.testing.assert_allclose(position, points, atol=1e-6)
    np.testing.assert_allclose(normal, -outward, atol=1e-6)


def test_grasp_points_are_uniform_where_the_arm_reaches():
    points = draw_grasp_points(np.random.default_rng(0), 20_000)
    outward = (points - OBJECT_CENTRE) / GRASP_RADIUS
    height = outward[:, 2]  # equal slices of a sphere have equal areas
    top, bottom = math.cos(0.5), math.cos(GRASP_POLAR_ANGLE)
    sideways = np.abs(outward[:, 1]) > np.abs(outward[:, 0])  # there nothing is cut off
    expected = (1 - top) / (1 - bottom)
    assert (height[sideways] > top).mean() == pytest.approx(expected, abs=0.02)
    assert (outward[:, 1] > 0).mean() == pytest.approx(0.5, abs=0.015)
    assert np.degrees(np.arccos(height[outward[:, 0] > 0.8 * np.sin(np.arccos(height))].min())) > 40
    # Farthest from the robot the wrist pitch ends before the cap does.
    ahead = np.abs(np.arctan2(outward[:, 1], outward[:, 0])) < 0.1
    assert np.degrees(np.arccos(height[ahead].min())) < 40


def test_a_goal_out_of_reach_is_out_of_reach():
    posture, exact = grasp_posture(grasp_point(np.array([1.0]), np.array([0.0])), HOME[None], iterations=40)
    assert exact.all()
    assert not brake(posture, np.ones((1, 7))).all() or not brake(posture, -np.ones((1, 7))).all()


@pytest.mark.parametrize("start_noise", [0.0, 0.2, 0.25])
def test_starts(start_noise):
    task = make_grasp(3000, start_noise=start_noise)
    away = task.qpos - HOME
    assert np.abs(away).max() <= start_noise
    assert (away.max(axis=0) >= 0.95 * start_noise).all()
    assert (away.min(axis=0) <= -0.95 * start_noise).all()
    np.testing.assert_array_equal(brake(task.qpos, np.full((3000, 7), MAX_SPEED)), MAX_SPEED)
    np.testing.assert_array_equal(brake(task.qpos, np.full((3000, 7), -MAX_SPEED)), -MAX_SPEED)
    assert not step(task).failure.any()
    corners = HOME + start_noise * np.array(np.meshgrid(*[[-1, 1]] * 7)).reshape(7, -1).T
    arm = ArmGeoms(task.model)
    assert clearance(arm, arm.place(corners)).min() > 0.01


def test_observation_is_angles_tool_and_grasp_point():
    task = make_grasp(4)
    seen = task.observe()
    parts = [seen["joint_angle"], seen["tool_position"], seen["goal"]]
    np.testing.assert_array_equal(seen["observation"], np.concatenate(parts, axis=1))
    np.testing.assert_array_equal(seen["joint_angle"], task.qpos)
    np.testing.assert_allclose(seen["tool_position"], tool_pose(task.qpos)[0])


# The rules.


def at_goal(task, distance=0.0, tilt=0.0, point=BESIDE):
    """Put every copy ``distance`` off a grasp point, across the line to the object, and ``tilt`` off that line."""
    inward = (OBJECT_CENTRE - point) / GRASP_RADIUS
    across = np.cross(inward, X) / np.linalg.norm(np.cross(inward, X))
    task.goal[:] = point
    task.qpos[:] = posture_at(point + distance * across, math.cos(tilt) * inward + math.sin(tilt) * across)


@pytest.mark.parametrize(
    ("options", "distance", "tilt", "success"),
    [
        ({}, 0.0, 0.0, True),
        ({}, 0.0299, 0.0, True),
        ({}, 0.0301, 0.0, False),
        ({}, 0.0, math.pi / 16 - 1e-3, True),
        ({}, 0.0, -math.pi / 16 + 1e-3, True),
        ({}, 0.0, math.pi / 16 + 1e-3, False),
        ({}, 0.0, -math.pi / 16 - 1e-3, False),
        ({"success_radius": 0.01}, 0.02, 0.0, False),
        ({"tilt_tolerance": 0.05}, 0.0, 0.1, False),
    ],
)
def test_success(options, distance, tilt, success):
    task = make_grasp(2, **options)
    at_goal(task, distance, tilt)
    outcome = step(task)
    assert outcome.success.tolist() == [success] * 2
    assert outcome.reward.tolist() == [0.0 if success else -1.0] * 2
    assert not (outcome.failure | outcome.terminated).any()


def test_success_comes_and_goes():
    task = make_grasp()
    for distance, success in [(0.0, True), (0.04, False), (0.0, True)]:
        at_goal(task, distance)
        assert step(task).success.tolist() == [success]


PAD_IN_OBJECT = posture_at(OBJECT_CENTRE + 0.99 * OBJECT_RADIUS * Z)
PAD_OVER_OBJECT = posture_at(OBJECT_CENTRE + 1.01 * OBJECT_RADIUS * Z)
PAD_IN_TABLE = posture_at(np.array([0.5, 0.3, TABLE_TOP - 0.001]))
PAD_OVER_TABLE = posture_at(np.array([0.5, 0.3, TABLE_TOP + 0.001]))
ELBOW_ON_TABLE = np.array([[0.0, 1.95, 0.0, -0.7, 0.0, -1.0, 0.0]])  # the tool is up in the air


@pytest.mark.parametrize(
    ("posture", "collides"),
    [
        (PAD_IN_OBJECT, True),
        (PAD_OVER_OBJECT, False),
        (PAD_IN_TABLE, True),
        (PAD_OVER_TABLE, False),
        (ELBOW_ON_TABLE, True),
    ],
)
def test_collisions(posture, collides):
    task = make_grasp(2)
    task.qpos[:] = posture
    outcome = step(task)
    assert outcome.failure.tolist() == [collides] * 2
    assert outcome.reward.tolist() == [-1.0] * 2
    assert not outcome.terminated.any()


def test_it_is_the_elbow_that_meets_the_table():
    arm = ArmGeoms(grasp_model())
    distance = arm.distance_to_floor(arm.place(ELBOW_ON_TABLE), TABLE_TOP)[0]
    assert [name for name, gap in zip(arm.names, distance, strict=True) if gap < 0] == ["elbow"]


def test_after_a_collision_nothing_but_minus_one():
    task = make_grasp(2, max_episode_steps=10)
    at_goal(task)
    task.qpos[0] = PAD_IN_OBJECT
    assert step(task).failure.tolist() == [True, False]
    at_goal(task)  # out of the object again: too late
    for _ in range(8):
        outcome = step(task)
        assert outcome.failure.tolist() == [True, False]
        assert outcome.success.tolist() == [False, True]
        assert outcome.reward.tolist() == [-1.0, 0.0]
        assert not outcome.terminated.any()
    assert step(task).truncated.all()
    task.reset(np.array([0]))
    at_goal(task)
    assert step(task).success.all()


def test_terminate_on_failure():
    task = make_grasp(2, terminate_on_failure=True)
    at_goal(task)
    task.qpos[0] = PAD_IN_TABLE
    assert step(task).terminated.tolist() == [True, False]


def test_terminate_on_success():
    task = make_grasp(2, terminate_on_success=True)
    at_goal(task)
    task.goal[1] += 0.1 * X
    outcome = step(task)
    assert outcome.terminated.tolist() == outcome.success.tolist() == [True, False]


def test_an_action_that_is_not_finite_is_no_success():
    task = make_grasp(2)
    at_goal(task)
    outcome = task.step(np.array([np.full(7, np.nan), STILL]))
    assert outcome.success.tolist() == [False, True]
    assert outcome.failure.tolist() == [True, False]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"tilt_tolerance": -1}, "tilt_tolerance must be positive, got -1"),
        ({"success_radius": math.nan}, "success_radius must be positive, got nan"),
        ({"start_noise": 0.3}, r"start_noise must lie in \[0, 0.25\] rad, got 0.3"),
        ({"start_noise": -0.1}, r"start_noise must lie in \[0, 0.25\] rad, got -0.1"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        make_grasp(**options)


# The expert.


@pytest.mark.parametrize("episodes", [200, pytest.param(2000, marks=pytest.mark.slow)])
def test_expert_succeeds_without_a_collision(episodes):
    task = make_grasp(episodes, seed=1, num_threads=2)
    succeeded, failed, length = drive(task, make_expert("wam_grasp"))
    assert succeeded.mean() >= 0.99
    assert not failed.any()
    assert 90 < length.mean() < 110


def test_expert_stays_at_the_goal():
    task, expert = make_grasp(50, seed=2, max_episode_steps=250), make_expert("wam_grasp")
    for _ in range(task.max_episode_steps):
        outcome = task.step(expert(task.observe()))
    assert outcome.truncated.all()
    assert outcome.success.all()
    position, normal = tool_pose(task.qpos)
    np.testing.assert_allclose(position, task.goal, atol=0.002)
    np.testing.assert_allclose(normal, (OBJECT_CENTRE - task.goal) / GRASP_RADIUS, atol=0.01)


def test_arc_leads_from_one_unit_vector_to_the_other():
    start, end = np.random.default_rng(0).normal(size=(2, 200, 3))
    start, end = (vectors / np.linalg.norm(vectors, axis=1, keepdims=True) for vectors in (start, end))
    end[0] = start[0]
    way = arc(start, end)
    angle = np.linalg.norm(way, axis=1, keepdims=True)
    np.testing.assert_allclose((way * start).sum(axis=1), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.cos(angle) * start + np.sinc(angle / np.pi) * way, end, atol=1e-12)
    np.testing.assert_array_equal(arc(Z[None], -Z[None]), [[0.0, 0.0, 0.0]])


@pytest.mark.parametrize("setting", ["speed", "gain"])
def test_expert_rejects_bad_settings(setting):
    with pytest.raises(ValueError, match="must be positive, got"):
        make_expert("wam_grasp", **{setting: 0.0})
