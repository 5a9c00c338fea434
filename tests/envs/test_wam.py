"""The WAM arm's kinematics, the rules of WAMWipe and its expert."""

import math

import mujoco
import numpy as np
import pytest
from mujoco import mjtObj

from nht.envs import make_expert, make_task
from nht.envs.wam import BRAKE_ZONE, brake
from nht.envs.wam_kinematics import (
    JOINT_HIGH,
    JOINT_LOW,
    MAX_SPEED,
    damped_solve,
    forward_kinematics,
    tool_pose,
)
from nht.envs.wam_wipe import DOWN, GOAL_HIGH, GOAL_LOW, START_POSTURE, TABLE_HEIGHT, flush_posture

STILL = np.zeros(7)
AT = np.array([0.5, 0.05, TABLE_HEIGHT])  # somewhere on the table
X, Z = np.eye(3)[0], np.eye(3)[2]


def make_wipe(num_envs=1, **options):
    return make_task("wam_wipe", num_envs=num_envs, seed=0, **options)


def step(task, actuation=STILL):
    return task.step(np.broadcast_to(actuation, (task.num_envs, 7)))


def posture_at(position, normal=DOWN):
    """A posture with the tool face at ``position`` and its normal along ``normal``, by Newton's method."""
    posture = START_POSTURE[None]
    for _ in range(50):
        pose = forward_kinematics(posture)
        error = np.concatenate([position - pose.position, (normal - pose.normal)[:, :2]], axis=1)
        jacobian = np.concatenate([pose.linear_jacobian(), pose.normal_jacobian()[:, :2]], axis=1)
        posture = posture + damped_solve(jacobian, error)
    reached = tool_pose(posture)
    np.testing.assert_allclose(reached[0][0], position, atol=1e-9)
    np.testing.assert_allclose(reached[1][0], normal, atol=1e-9)
    return posture


# The arm.


@pytest.fixture(scope="module")
def model():
    return make_wipe().model


@pytest.fixture(scope="module")
def postures():
    return np.random.default_rng(0).uniform(JOINT_LOW, JOINT_HIGH, (100, 7))


@pytest.fixture(scope="module")
def by_mujoco(model, postures):
    """Tool positions, normals, and both halves of the Jacobian as MuJoCo has them."""
    data, tool = mujoco.MjData(model), mujoco.mj_name2id(model, mjtObj.mjOBJ_SITE, "tool")
    rows = []
    for posture in postures:
        data.qpos[:] = posture
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        linear, angular = np.zeros((3, 7)), np.zeros((3, 7))
        mujoco.mj_jacSite(model, data, linear, angular, tool)
        rows.append(
            (data.site_xpos[tool].copy(), data.site_xmat[tool].reshape(3, 3)[:, 2].copy(), linear, angular)
        )
    return [np.array(column) for column in zip(*rows, strict=True)]


def test_kinematics_are_those_of_the_model(postures, by_mujoco):
    position, normal, linear, angular = by_mujoco
    pose = forward_kinematics(postures)
    np.testing.assert_allclose(pose.position, position, atol=1e-12)
    np.testing.assert_allclose(pose.normal, normal, atol=1e-12)
    np.testing.assert_allclose(pose.linear_jacobian(), linear, atol=1e-9)
    np.testing.assert_allclose(pose.angular_jacobian(), angular, atol=1e-9)
    rate = np.cross(angular, normal[:, :, None], axis=1)
    np.testing.assert_allclose(pose.normal_jacobian(), rate, atol=1e-9)


def test_tool_pose_is_the_short_way_to_the_same(postures):
    pose = forward_kinematics(postures)
    position, normal = tool_pose(postures)
    np.testing.assert_allclose(position, pose.position, atol=1e-14)
    np.testing.assert_allclose(normal, pose.normal, atol=1e-14)


def test_damped_solve_is_the_pseudo_inverse_and_bounded_at_singularities():
    rng = np.random.default_rng(0)
    jacobian, velocity = rng.normal(size=(5, 4, 7)), rng.normal(size=(5, 4))
    expected = np.einsum("nij,nj->ni", np.linalg.pinv(jacobian), velocity)
    np.testing.assert_allclose(damped_solve(jacobian, velocity), expected, rtol=1e-4)
    assert np.abs(damped_solve(np.zeros((1, 4, 7)), velocity[:1])).max() == 0


def test_model_has_the_makers_numbers(model):
    masses = [10.7677, 3.8749, 1.8023, 2.17266, 0.35656, 0.40916, 0.07548]
    np.testing.assert_allclose([model.body(f"link{i}").mass[0] for i in range(1, 8)], masses)
    np.testing.assert_allclose(model.body("link4").ipos, [0.00553, 0.00007, 0.11928])
    np.testing.assert_array_equal(model.jnt_range, np.stack([JOINT_LOW, JOINT_HIGH], axis=1))
    low, high = make_wipe().actuation_bounds
    assert low.tolist() == [-MAX_SPEED] * 7
    assert high.tolist() == [MAX_SPEED] * 7


def test_model_is_kinematic_and_steps_of_20_ms(model):
    task = make_wipe()
    assert model.opt.gravity.tolist() == [0, 0, 0]
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    start = task.state[0, 0]
    step(task)
    assert task.state[0, 0] - start == pytest.approx(0.02)


def test_start_posture_lies_flush_on_the_table():
    (position,), (normal,) = tool_pose(START_POSTURE[None])
    assert position[2] == pytest.approx(TABLE_HEIGHT, abs=1e-5)
    assert math.acos(normal @ DOWN) < 1e-4
    assert (position[:2] > GOAL_LOW).all()
    assert (position[:2] < GOAL_HIGH).all()


def test_actuation_sets_the_joint_velocities():
    velocity = np.random.default_rng(0).uniform(-1, 1, (64, 7))
    # Links push each other about within the step, with the square of the speed.
    for speed, error in [(0.1, 3e-5), (MAX_SPEED, 8e-3)]:
        task = make_wipe(64, start="random")
        before = task.qpos.copy()
        task.step(speed * velocity)
        task.step(speed * velocity)  # what moved before does not matter
        task.step(0 * velocity)
        np.testing.assert_allclose(task.qpos - before, 2 * 0.02 * speed * velocity, atol=2 * error)


def test_brake():
    """14 copies: every joint within the zone of either limit, driven towards it, then away from it."""
    inside = np.zeros((14, 7))
    outward = np.concatenate([-np.eye(7), np.eye(7)])
    near = np.concatenate([JOINT_LOW + 0.99 * BRAKE_ZONE, JOINT_HIGH - 0.99 * BRAKE_ZONE])
    np.put_along_axis(inside, np.tile(np.arange(7), 2)[:, None], near[:, None], axis=1)
    assert not brake(inside, outward).any()
    np.testing.assert_array_equal(brake(inside, -outward), -outward)
    further = inside - 0.02 * BRAKE_ZONE * outward  # out of the zone
    np.testing.assert_array_equal(brake(further, outward), outward)

    task = make_wipe(14)
    task.qpos[:] = inside
    task.step(outward)
    np.testing.assert_array_equal(task.qpos, inside)
    task.step(-outward)
    assert ((task.qpos - inside) * -outward).sum(axis=1).min() > 0.015


def test_no_joint_passes_its_limit():
    task = make_wipe(64, max_episode_steps=10**6)
    towards = np.sign(np.random.default_rng(0).normal(size=(64, 7))) * MAX_SPEED
    for _ in range(150):
        task.step(towards)
    assert (task.qpos > JOINT_LOW - 0.005).all()
    assert (task.qpos < JOINT_HIGH + 0.005).all()


# The rules of WAMWipe.


@pytest.mark.parametrize(
    ("height", "tilt", "violated"),
    [
        (0.0, 0.0, False),
        (0.0149, 0.0, False),
        (-0.0149, 0.0, False),
        (0.0151, 0.0, True),  # lifted
        (-0.0151, 0.0, True),  # pressed into the table
        (0.0, math.pi / 16 - 1e-3, False),
        (0.0, math.pi / 16 + 1e-3, True),
    ],
)
def test_violations(height, tilt, violated):
    task = make_wipe(4)
    directions = [0.0, math.pi / 2, math.pi, -math.pi / 2]
    for row, direction in enumerate(directions):
        lean = np.array([math.cos(direction), math.sin(direction), 0.0])
        normal = math.cos(tilt) * DOWN + math.sin(tilt) * lean
        task.qpos[row] = posture_at(AT + height * Z, normal)[0]
    outcome = step(task)
    assert outcome.failure.tolist() == [violated] * 4
    assert not outcome.terminated.any()


@pytest.mark.parametrize(
    ("option", "posture"),
    [
        ({"height_tolerance": 0.002}, lambda: posture_at(AT + 0.003 * Z)),
        ({"tilt_tolerance": 0.01}, lambda: posture_at(AT, np.array([0.02, 0.0, -math.sqrt(1 - 0.02**2)]))),
    ],
)
def test_tolerances_are_options(option, posture):
    strict, default = make_wipe(**option), make_wipe()
    for task, violated in [(strict, True), (default, False)]:
        task.qpos[:] = posture()
        assert step(task).failure.tolist() == [violated]


def at_goal(task, distance=0.0):
    """Put every copy on the table, ``distance`` from its goal."""
    task.qpos[:] = posture_at(AT)
    task.goal[:] = AT + distance * X


def test_success_within_its_radius():
    for radius, distance, success in [(0.03, 0.0299, True), (0.03, 0.0301, False), (0.01, 0.02, False)]:
        task = make_wipe(2, success_radius=radius)
        at_goal(task, distance)
        outcome = step(task)
        assert outcome.success.tolist() == [success] * 2
        assert outcome.reward.tolist() == [0.0 if success else -1.0] * 2
        assert not (outcome.failure | outcome.terminated).any()


def test_success_comes_and_goes():
    task = make_wipe()
    for distance, success in [(0.0, True), (0.1, False), (0.0, True)]:
        at_goal(task, distance)
        assert step(task).success.tolist() == [success]


def test_after_a_violation_nothing_but_minus_one():
    task = make_wipe(2, max_episode_steps=10)
    at_goal(task)
    task.qpos[0] = posture_at(AT + 0.02 * Z)
    assert step(task).failure.tolist() == [True, False]
    at_goal(task)  # back on the table: too late
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
    task = make_wipe(2, terminate_on_failure=True)
    at_goal(task)
    task.qpos[0] = posture_at(AT + 0.02 * Z)
    assert step(task).terminated.tolist() == [True, False]


def test_terminate_on_success():
    task = make_wipe(2, terminate_on_success=True)
    at_goal(task)
    task.goal[1] += 0.1 * X
    outcome = step(task)
    assert outcome.terminated.tolist() == outcome.success.tolist() == [True, False]


def test_an_action_that_is_not_finite_is_no_success():
    task = make_wipe(2)
    at_goal(task)
    outcome = task.step(np.array([np.full(7, np.nan), STILL]))
    assert outcome.success.tolist() == [False, True]
    assert outcome.failure.tolist() == [True, False]
    assert outcome.reward.tolist() == [-1, 0]


def test_goals_lie_in_their_area_and_differ():
    task = make_wipe(500)
    goals = task.goal.copy()
    assert (goals[:, :2] > GOAL_LOW).all()
    assert (goals[:, :2] < GOAL_HIGH).all()
    assert (goals[:, 2] == TABLE_HEIGHT).all()
    span = (goals.max(axis=0) - goals.min(axis=0))[:2]
    assert (span > 0.97 * (GOAL_HIGH - GOAL_LOW)).all()
    assert len(np.unique(goals, axis=0)) == 500
    task.reset()
    assert (task.goal[:, :2] != goals[:, :2]).all()


def test_fixed_start_is_the_authors_posture():
    task = make_wipe(3)
    np.testing.assert_array_equal(task.qpos, np.tile(START_POSTURE, (3, 1)))
    assert not task.qvel.any()


@pytest.mark.parametrize("swivel_range", [0.0, 0.5, 1.0])
def test_random_starts_are_flush_and_swivelled(swivel_range):
    task = make_wipe(300, start="random", swivel_range=swivel_range)
    position, normal = tool_pose(task.qpos)
    np.testing.assert_allclose(position[:, 2], TABLE_HEIGHT, atol=1e-6)
    np.testing.assert_allclose(normal, np.tile(DOWN, (300, 1)), atol=1e-4)
    assert (position[:, :2] > GOAL_LOW - 1e-6).all()
    assert (position[:, :2] < GOAL_HIGH + 1e-6).all()
    span = (position.max(axis=0) - position.min(axis=0))[:2]
    assert (span > 0.9 * (GOAL_HIGH - GOAL_LOW)).all()

    swivel = task.qpos[:, 2] - START_POSTURE[2]
    assert np.abs(swivel).max() <= swivel_range + 1e-12
    assert swivel.max() >= 0.9 * swivel_range
    assert swivel.min() <= -0.9 * swivel_range
    np.testing.assert_array_equal(brake(task.qpos, np.full((300, 7), MAX_SPEED)), MAX_SPEED)
    assert not step(task).failure.any()


def test_flush_postures_that_are_found_are_exact_and_free_to_move():
    rng = np.random.default_rng(0)
    target = np.column_stack([rng.uniform([0.2, -0.8], [1.0, 0.8], (500, 2)), np.full(500, TABLE_HEIGHT)])
    posture, found = flush_posture(target, rng.uniform(-0.5, 0.5, 500))
    position, normal = tool_pose(posture)
    exact = (np.linalg.norm(position - target, axis=1) < 1e-5) & (normal @ DOWN > 1 - 1e-6)
    free = (brake(posture, np.full(7, 1.0)) * brake(posture, np.full(7, -1.0))).all(axis=1)
    np.testing.assert_array_equal(found, exact & free)
    assert (exact & ~free).any(), "the limits did not matter"
    assert (free & ~exact).any(), "reach did not matter"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"start": "anywhere"}, r"start must be one of \('fixed', 'random'\), got 'anywhere'"),
        ({"height_tolerance": 0.0}, "height_tolerance must be positive, got 0.0"),
        ({"tilt_tolerance": -1}, "tilt_tolerance must be positive, got -1"),
        ({"success_radius": math.nan}, "success_radius must be positive, got nan"),
        ({"swivel_range": 2.0}, r"swivel_range must lie in \[0, 1.5\] rad, got 2.0"),
        ({"swivel_range": -0.1}, r"swivel_range must lie in \[0, 1.5\] rad, got -0.1"),
    ],
)
def test_bad_options(options, message):
    with pytest.raises(ValueError, match=message):
        make_wipe(**options)


# The expert.


def drive(task, expert):
    """Until every copy has been at its goal or failed: whether it succeeded, failed, and after how many steps."""
    succeeded, failed = np.zeros((2, task.num_envs), dtype=bool)
    length = np.zeros(task.num_envs)
    for _ in range(task.max_episode_steps):
        length += ~succeeded
        outcome = task.step(expert(task.observe()))
        succeeded |= outcome.success
        failed |= outcome.failure
        if (succeeded | failed).all():
            break
    return succeeded, failed, length


@pytest.mark.parametrize("start", ["fixed", "random"])
def test_expert_succeeds_in_2000_episodes_without_a_violation(start):
    task = make_wipe(2000, start=start, seed=1, num_threads=2)
    succeeded, failed, _ = drive(task, make_expert("wam_wipe"))
    assert succeeded.mean() >= 0.995
    assert not failed.any()


def test_expert_stays_at_the_goal():
    task, expert = make_wipe(100, start="random", seed=2), make_expert("wam_wipe")
    for _ in range(task.max_episode_steps):
        outcome = task.step(expert(task.observe()))
    assert outcome.truncated.all()
    assert outcome.success.all()
    assert np.linalg.norm(tool_pose(task.qpos)[0] - task.goal, axis=1).max() < 0.005


def test_expert_drives_out_errors_of_height_and_tilt():
    task, expert = make_wipe(), make_expert("wam_wipe")
    at_goal(task, 0.1)
    task.qpos[:] = posture_at(AT + 0.01 * Z, math.cos(0.1) * DOWN + math.sin(0.1) * X)
    step(task)
    for _ in range(100):
        task.step(expert(task.observe()))
    (position,), (normal,) = tool_pose(task.qpos)
    np.testing.assert_allclose(position, task.goal[0], atol=1e-4)
    np.testing.assert_allclose(normal, DOWN, atol=1e-4)


def test_slow_expert_takes_the_papers_250_steps():
    task = make_wipe(150, seed=3, max_episode_steps=700)
    succeeded, _, length = drive(task, make_expert("wam_wipe", speed=0.032))
    assert succeeded.all()
    assert 225 < length.mean() < 275


@pytest.mark.parametrize("setting", ["speed", "gain"])
def test_expert_rejects_bad_settings(setting):
    with pytest.raises(ValueError, match="must be positive, got"):
        make_expert("wam_wipe", **{setting: 0.0})
