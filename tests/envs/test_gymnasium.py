"""Gymnasium's side of every task, and pictures of it."""

import math

import gymnasium
import numpy as np
import pytest
import stable_baselines3.common.env_checker
import torch
from gymnasium.utils.env_checker import check_env
from torchrl.envs import GymEnv
from torchrl.envs.utils import check_env_specs

from fresh_process import run
from nht.envs import TASKS, gymnasium_id, make_env
from nht.envs.wam_grasp import HOME, grasp_point, grasp_posture
from nht.envs.wam_kinematics import tool_pose
from nht.envs.wam_wipe import GOAL_HIGH, GOAL_LOW, START_POSTURE, TABLE_HEIGHT


@pytest.fixture(params=sorted(TASKS))
def name(request):
    return request.param


@pytest.fixture
def env(name):
    env = gymnasium.make(gymnasium_id(name))
    yield env
    env.close()


# What the checker only recommends: its authors like actions in [-1, 1] and bounded observations.
@pytest.mark.filterwarnings("ignore:.*(symmetric and normalized space|value is -?infinity):UserWarning")
@pytest.mark.filterwarnings("error")
def test_passes_gymnasiums_checker(env):
    check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized Box:UserWarning")
@pytest.mark.filterwarnings("error")
def test_passes_stable_baselines3s_checker(env):
    stable_baselines3.common.env_checker.check_env(env)


@pytest.mark.parametrize("options", [{}, {"max_episode_steps": 3}, {"max_episode_steps": 1_500}])
def test_the_time_limit_is_the_tasks_or_what_is_asked_for(options):
    env = gymnasium.make("nht/HalfCheetah-v0", **options)
    limit = options.get("max_episode_steps", 1_000)
    assert env.spec.max_episode_steps == limit
    env.reset(seed=0)
    still = np.zeros(6, dtype=np.float32)
    flags = [env.step(still)[2:4] for _ in range(limit)]
    assert flags == [(False, False)] * (limit - 1) + [(False, True)]


def test_spaces(name, env):
    task = env.unwrapped.task
    assert env.observation_space.dtype == env.action_space.dtype == np.float32
    assert env.observation_space.shape == (task.observation_sizes["observation"],)
    for bound, own in zip(task.actuation_bounds, (env.action_space.low, env.action_space.high), strict=True):
        np.testing.assert_allclose(own, bound)


def test_agrees_with_the_batched_environment(name):
    single, batched = gymnasium.make(gymnasium_id(name), max_episode_steps=None), make_env(name, seed=0)
    for env in (single.unwrapped, batched):
        env.task.max_episode_steps = 20  # short enough for those who fall
    single.action_space.seed(0)
    observation, info = single.reset(seed=5)
    batched.set_seed(5)
    tensordict = batched.reset()
    truncations = 0
    for _ in range(50):
        assert_same_state(observation, info, tensordict[0])
        action = single.action_space.sample()
        observation, reward, terminated, truncated, info = single.step(action)
        frame, tensordict = batched.step_and_maybe_reset(tensordict.set("action", torch.tensor(action)[None]))
        expected = frame["next"][0]
        assert_same_state(observation, info, expected)
        assert (np.float32(reward), terminated, truncated) == tuple(
            expected[key].item() for key in ("reward", "terminated", "truncated")
        )
        if terminated or truncated:
            truncations += truncated
            observation, info = single.reset()
    assert truncations


def assert_same_state(observation, info, expected):
    values = info | {"observation": observation}
    for key, value in values.items():
        np.testing.assert_array_equal(np.atleast_1d(value), expected[key].numpy(), err_msg=key)
    assert set(values) == set(expected.keys()) - {"action", "reward", "done", "terminated", "truncated"}


def test_a_seed_repeats_and_no_seed_does_not(env):
    first, again, other = (env.reset(seed=seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    assert not np.array_equal(env.reset()[0], other)
    env_id = env.spec.id
    unseeded = [gymnasium.make(env_id).reset()[0] for _ in range(2)]
    assert not np.array_equal(*unseeded)


def test_options_reach_the_task(name):
    env = gymnasium.make(gymnasium_id(name), seed=3)
    seeded = gymnasium.make(gymnasium_id(name), seed=3)
    np.testing.assert_array_equal(env.reset()[0], seeded.reset()[0])
    with pytest.raises(TypeError, match="unexpected keyword argument 'nonesuch'"):
        gymnasium.make(gymnasium_id(name), nonesuch=1)


def test_videos_run_at_real_time(env):
    task = env.unwrapped.task
    assert env.metadata["render_fps"] == round(1 / (task.substeps * task.model.opt.timestep))


def test_works_through_torchrls_wrapper(name):
    check_env_specs(GymEnv(gymnasium_id(name)))


@pytest.mark.filterwarnings("ignore:.*not in the possible render_modes:UserWarning")
def test_unknown_render_mode(name):
    with pytest.raises(ValueError, match=r"None or one of \['rgb_array'\], got 'ansi'"):
        gymnasium.make(gymnasium_id(name), render_mode="ansi")


def test_without_a_render_mode_there_is_no_picture(env):
    env.reset()
    assert env.unwrapped.render() is None


def test_closing_twice(env):
    env.reset()
    env.unwrapped.close()
    env.unwrapped.close()
    with pytest.raises(RuntimeError, match="closed"):
        env.step(env.action_space.sample())


# Pictures.


@pytest.mark.usefixtures("can_render")
def test_pictures_show_what_moves(name):
    env = gymnasium.make(gymnasium_id(name), render_mode="rgb_array")
    env.reset(seed=0)
    before = env.render()
    kept = before.copy()
    env.action_space.seed(0)
    for _ in range(10):
        env.step(env.action_space.sample())
    after = env.render()
    env.close()
    assert before.dtype == np.uint8
    assert before.shape == (480, 640, 3)
    assert before.std() > 10, "the picture is nearly empty"
    assert (np.abs(after.astype(int) - before).max(axis=2) > 30).mean() > 1e-3
    np.testing.assert_array_equal(before, kept)


def marked(picture, colour):
    """Centre (row, column) and number of the pixels of a hue near ``colour``."""
    pixels = picture.astype(float)
    away = np.linalg.norm(pixels / pixels.sum(axis=2, keepdims=True) - np.array(colour) / sum(colour), axis=2)
    rows, columns = np.nonzero((away < 0.1) & (pixels.max(axis=2) > 100))
    return np.array([rows.mean(), columns.mean()]), len(rows)


@pytest.mark.usefixtures("can_render")
def test_the_goal_is_seen_wherever_it_lies_in_the_colour_of_its_state():
    env = gymnasium.make("nht/WAMWipe-v0", render_mode="rgb_array")
    env.reset(seed=0)
    task, orange, green, red = env.unwrapped.task, (0.95, 0.6, 0.1), (0.2, 0.7, 0.25), (0.85, 0.15, 0.15)
    seen = {}
    for x in (GOAL_LOW[0], GOAL_HIGH[0]):
        for y in (GOAL_LOW[1], GOAL_HIGH[1]):
            task.goal[0] = [x, y, TABLE_HEIGHT]
            seen[x, y], size = marked(env.render(), orange)
            assert size > 100
    # The camera looks back at the arm: x comes nearer (down the picture), y goes to the right.
    assert all(seen[GOAL_HIGH[0], y][0] > seen[GOAL_LOW[0], y][0] + 30 for y in (GOAL_LOW[1], GOAL_HIGH[1]))
    assert all(seen[x, GOAL_HIGH[1]][1] > seen[x, GOAL_LOW[1]][1] + 100 for x in (GOAL_LOW[0], GOAL_HIGH[0]))

    task.goal[0] = tool_pose(START_POSTURE[None])[0][0] + np.array([0.028, 0, 0])
    assert marked(env.render(), green)[1] > 20
    task.failed[0] = True
    assert marked(env.render(), red)[1] > 20
    env.close()


@pytest.mark.usefixtures("can_render")
def test_the_grasp_point_is_seen_wherever_it_lies_in_the_colour_of_its_state():
    env = gymnasium.make("nht/WAMGrasp-v0", render_mode="rgb_array")
    env.reset(seed=0)
    task, orange, green, red = env.unwrapped.task, (0.95, 0.6, 0.1), (0.2, 0.7, 0.25), (0.85, 0.15, 0.15)
    polar, azimuth = np.array([0.0, 0.9, 0.9]), np.array([0.0, math.pi / 2, -math.pi / 2])
    seen = []
    for goal in grasp_point(polar, azimuth):
        task.goal[0] = goal
        centre, size = marked(env.render(), orange)
        assert size > 100
        seen.append(centre)
    # The camera looks back at the arm: y goes to the right.
    assert seen[0][0] < min(seen[1][0], seen[2][0])
    assert seen[2][1] + 30 < seen[0][1] < seen[1][1] - 30

    task.qpos[0] = grasp_posture(task.goal, HOME[None])[0]
    env.step(np.zeros(7))
    assert marked(env.render(), green)[1] > 20
    task.failed[0] = True
    assert marked(env.render(), red)[1] > 20
    env.close()


@pytest.mark.usefixtures("can_render")
def test_renders_without_a_display_though_torchrl_imported_mujoco_first():
    result = run("""
import torchrl.envs, mujoco
import gymnasium, nht.envs
env = gymnasium.make("nht/WAMWipe-v0", render_mode="rgb_array")
env.reset(seed=0)
print(env.render().std() > 10)
""")
    assert result.stdout.split() == ["True"], result.stderr
    assert "Exception ignored" not in result.stderr, "the environment was not closed: a traceback at exit"
