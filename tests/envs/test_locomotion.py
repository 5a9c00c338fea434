"""HalfCheetah, Hopper, Walker2d and Ant against Gymnasium's own, and states set from outside."""

import functools
import inspect
import math

import gymnasium
import mujoco
import numpy as np
import pytest
from scipy.stats import ks_2samp

from nht.envs import TASKS, make_task
from nht.envs.models import load_model

IDS = {
    "ant": "Ant-v5",
    "half_cheetah": "HalfCheetah-v5",
    "hopper": "Hopper-v5",
    "walker2d": "Walker2d-v5",
}
NO_CONTACTS = {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")


@pytest.fixture(params=sorted(IDS))
def name(request):
    return request.param


# In MuJoCo 4 one state of Ant in a thousand is equal within the solver's tolerance only.
SOLVER = 1e-9 if mujoco.__version__.startswith("3.") else 1e-6


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # Gymnasium's HalfCheetah makes MuJoCo log a warning into the working folder


def original(env_id, **options):
    """Gymnasium's environment without wrappers."""
    env = gymnasium.make(env_id, **options).unwrapped
    env.reset(seed=0)
    return env


@functools.cache
def visited_states(name, count=1_000, copies=50):
    """Positions and velocities ``(count, ..)`` of random motion over 100 steps: upright, falling and lying."""
    task, rng = make_task(name, num_envs=copies, seed=0), np.random.default_rng(0)
    low, high = task.actuation_bounds
    positions, velocities = [], []
    while len(positions) * copies < count:
        for _ in range(5):
            ended = task.step(rng.uniform(low, high, (copies, low.size))).terminated
            if len(positions) % 2:  # in the other half of the time they may lie
                task.reset(np.flatnonzero(ended))
        positions.append(task.qpos.copy())
        velocities.append(task.qvel.copy())
    return np.concatenate(positions), np.concatenate(velocities)


def step_both(name, env_id, options, env_options):
    """The same step from every visited state: ours as (observation, reward, terminated), and Gymnasium's."""
    qpos, qvel = visited_states(name)
    task, env = make_task(name, num_envs=len(qpos), seed=0, **options), original(env_id, **env_options)
    actions = np.random.default_rng(1).uniform(*task.actuation_bounds, (len(qpos), env.model.nu))
    task.set_state(qpos, qvel, tolerance=math.inf)
    outcome = task.step(actions)
    ours = task.observe()["observation"], outcome.reward, outcome.terminated
    theirs = []
    for position, velocity, action in zip(qpos, qvel, actions, strict=True):
        env.set_state(position, velocity)
        theirs.append(env.step(action)[:3])
    return task, ours, [np.array(column) for column in zip(*theirs, strict=True)]


# One step from states on the way.


@pytest.mark.parametrize(
    ("name", "env_id", "options", "env_options"),
    [
        ("half_cheetah", "HalfCheetah-v5", {}, {}),
        ("half_cheetah", "HalfCheetah-v4", {}, {}),
        ("hopper", "Hopper-v5", {}, {}),
        ("walker2d", "Walker2d-v5", {}, {}),
        ("ant", "Ant-v5", {}, {}),
        ("ant", "Ant-v5", NO_CONTACTS, NO_CONTACTS),
        *(
            (name, IDS[name], options, options)
            for name, options in [
                ("half_cheetah", {"forward_reward_weight": 2.0, "ctrl_cost_weight": 0.3}),
                ("hopper", {"terminate_when_unhealthy": False, "healthy_z_range": (1.0, 1.2)}),
                ("walker2d", {"healthy_reward": 3.0, "healthy_angle_range": (-0.1, 0.2)}),
                ("ant", {"contact_force_range": (-30.0, 20.0), "contact_cost_weight": 1e-3}),
            ]
        ),
    ],
)
def test_a_step_equals_gymnasiums(name, env_id, options, env_options):
    task, (observation, reward, terminated), theirs = step_both(name, env_id, options, env_options)
    np.testing.assert_allclose(observation, theirs[0], rtol=0, atol=SOLVER)
    np.testing.assert_allclose(reward, theirs[1], rtol=0, atol=SOLVER)
    np.testing.assert_array_equal(terminated, theirs[2])
    assert terminated.any() == task.terminate_when_unhealthy
    assert not terminated.all()


@pytest.mark.parametrize(
    ("name", "env_id", "options"), [("hopper", "Hopper-v4", {}), ("ant", "Ant-v4", NO_CONTACTS)]
)
def test_version_4_differs_in_the_healthy_reward_of_the_fall(name, env_id, options):
    _, (observation, reward, terminated), theirs = step_both(name, env_id, options, {})
    np.testing.assert_allclose(observation, theirs[0], rtol=0, atol=SOLVER)
    np.testing.assert_allclose(reward + terminated, theirs[1], rtol=0, atol=SOLVER)
    np.testing.assert_array_equal(terminated, theirs[2])


def test_a_hopper_beyond_its_state_range_is_unhealthy():
    task, env = make_task("hopper", num_envs=2, seed=0), original("Hopper-v5")
    qpos, qvel = np.tile(env.init_qpos, (2, 1)), np.zeros((2, 6))
    qvel[1, 0] = 150.0
    task.set_state(qpos, qvel)
    env.set_state(qpos[1], qvel[1])
    assert task.step(np.zeros((2, 3))).terminated.tolist() == [False, True]
    assert env.step(np.zeros(3))[2]


def test_the_first_steps_of_an_episode_equal_gymnasiums(name):
    """Several steps in a row: Ant's reward depends on where Gymnasium saw the torso in the step before."""
    task, env = make_task(name, seed=3), original(IDS[name])
    env.set_state(task.qpos[0], task.qvel[0])
    for action in np.random.default_rng(0).uniform(*task.actuation_bounds, (12, env.model.nu)):
        observation, reward, *_ = env.step(action)
        outcome = task.step(action[None])
        np.testing.assert_allclose(task.observe()["observation"][0], observation, rtol=0, atol=1e-7)
        np.testing.assert_allclose(outcome.reward[0], reward, rtol=0, atol=1e-7)


# Episodes as a whole.


def test_defaults_are_gymnasiums(name):
    theirs = {
        key: parameter.default
        for key, parameter in inspect.signature(type(original(IDS[name])).__init__).parameters.items()
    }
    task = make_task(name, seed=0)
    shared = set(theirs) & set(inspect.signature(TASKS[name].task_class).parameters)
    assert {"forward_reward_weight", "ctrl_cost_weight", "reset_noise_scale"} <= shared
    for key in shared:
        assert getattr(task, key) == theirs[key], key
    assert task.substeps == theirs["frame_skip"]
    assert task.max_episode_steps == gymnasium.spec(IDS[name]).max_episode_steps
    assert task.observation_sizes["observation"] == original(IDS[name]).observation_space.shape[0]


def test_starts_are_distributed_as_gymnasiums(name):
    ours = make_task(name, num_envs=400, seed=1).observe()["observation"]
    env = original(IDS[name])
    theirs = np.array([env.reset(seed=seed)[0] for seed in range(400)])
    moving = np.ptp(theirs, axis=0) > 0  # all but Ant's contact forces
    np.testing.assert_array_equal(ours[:, ~moving], theirs[:, ~moving])
    assert ks_2samp(ours[:, moving], theirs[:, moving], axis=0).pvalue.min() > 1e-3


def fixed_policy(observation, size):
    """A nonlinear feedback that depends on positions and velocities: enough to move on."""
    mixing = np.random.default_rng(5).normal(size=(observation.shape[-1], size))
    return np.sin(observation @ mixing)


def returns_of(task):
    total, running = np.zeros(task.num_envs), np.ones(task.num_envs, dtype=bool)
    size = task.actuation_bounds[0].size
    while running.any():
        outcome = task.step(fixed_policy(task.observe()["observation"], size))
        total += running * outcome.reward
        running &= ~(outcome.terminated | outcome.truncated)
    return total


def returns_of_gymnasiums(env, episodes, max_episode_steps):
    totals = []
    for seed in range(episodes):
        observation, total = env.reset(seed=seed)[0], 0.0
        for _ in range(max_episode_steps):
            observation, reward, terminated, *_ = env.step(fixed_policy(observation, env.model.nu))
            total += reward
            if terminated:
                break
        totals.append(total)
    return totals


@pytest.mark.slow
def test_returns_are_distributed_as_gymnasiums(name):
    limit = 200 if name == "ant" else 1_000  # Gymnasium takes minutes for longer ones of Ant
    ours, other = (
        returns_of(make_task(name, num_envs=100, seed=1, max_episode_steps=limit, **options))
        for options in ({}, {"ctrl_cost_weight": 2.0})
    )
    theirs = returns_of_gymnasiums(original(IDS[name]), 100, max_episode_steps=limit)
    assert ks_2samp(ours, theirs).pvalue > 0.01
    assert ks_2samp(other, theirs).pvalue < 1e-4, "a wrong reward would go unnoticed"


# States from outside.


def test_a_state_set_is_the_state(name):
    task = make_task(name, num_envs=4, seed=2)
    donor = make_task(name, num_envs=4, seed=3)
    before = task.observe()["observation"]
    task.set_state(donor.qpos[:2], donor.qvel[:2], rows=np.array([3, 1]), tolerance=1.0)
    after, expected = task.observe()["observation"], donor.observe()["observation"]
    np.testing.assert_array_equal(after[[3, 1]], expected[:2])
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda qpos, qvel: (qpos[:, :-1], qvel), r"qpos of shape \(2, 9\), got \(2, 8\)"),
        (lambda qpos, qvel: (qpos[:1], qvel), r"qpos of shape \(2, 9\), got \(1, 9\)"),
        (lambda qpos, qvel: (qpos, qvel[0]), r"qvel of shape \(2, 9\), got \(9,\)"),
        (lambda qpos, qvel: (qpos, qvel + np.array([[0], [math.nan]])), r"qvel must be finite: row 1 is not"),
        (lambda qpos, qvel: (qpos - np.array([[0], [math.inf]]), qvel), r"qpos must be finite: row 1 is not"),
        (
            lambda qpos, qvel: (qpos + np.eye(9)[[0, 4]], qvel),
            r"joint 'bshin' stands at 1 in row 1, more than 0.1 beyond its limits \[-0.785, 0.785\]",
        ),
    ],
)
def test_a_wrong_state_is_refused(change, message):
    task = make_task("half_cheetah", num_envs=2, seed=0)
    before = task.state_dict()
    with pytest.raises(ValueError, match=message):
        task.set_state(*change(np.zeros((2, 9)), np.zeros((2, 9))))
    np.testing.assert_array_equal(task.state, before["state"])


def test_the_root_of_a_runner_has_no_limits():
    task = make_task("half_cheetah", seed=0)
    task.set_state(np.eye(9)[:1] * 1e3, np.zeros((1, 9)))
    assert task.qpos[0, 0] == 1e3


def test_a_set_state_reaches_what_a_task_derives_from_it():
    task, other = make_task("wam_wipe", num_envs=2, seed=0), make_task("wam_wipe", num_envs=2, seed=0)
    other.step(np.full((2, 7), 0.3))
    task.set_state(other.qpos, np.zeros((2, 7)))
    np.testing.assert_array_equal(task.observe()["tool_position"], other.observe()["tool_position"])


def test_a_closed_task_takes_no_state():
    task = make_task("hopper", seed=0)
    task.close()
    with pytest.raises(RuntimeError, match="closed"):
        task.set_state(np.zeros((1, 6)), np.zeros((1, 6)))


# Other bad input.


def test_a_model_that_does_not_compile(tmp_path):
    file = tmp_path / "broken.xml"
    file.write_text("<mujoco><worldbody><body><joint type='bent'/></body></worldbody></mujoco>")
    with pytest.raises(ValueError, match=r"broken\.xml does not compile: XML Error: .*bent"):
        load_model(file)
    with pytest.raises(ValueError, match=r"nonesuch\.xml does not compile: .*[Oo]pen"):
        load_model(tmp_path / "nonesuch.xml")


def test_loading_leaves_nothing_in_the_working_folder(tmp_path):
    make_task("half_cheetah", seed=0)
    assert list(tmp_path.iterdir()) == []


def test_negative_noise(name):
    with pytest.raises(ValueError, match=r"reset_noise_scale must not be negative, got -0.1"):
        make_task(name, reset_noise_scale=-0.1, seed=0)
