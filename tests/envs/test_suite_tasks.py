"""cheetah-run and manipulator-bring_ball on the batched engine against dm_control's own."""

import numpy as np
import pytest
from scipy.stats import ks_2samp

from nht.envs import make_task
from nht.envs.dm_control import MISSING

suite = pytest.importorskip("dm_control.suite", reason=MISSING)
NAMES = {"cheetah_run": ("cheetah", "run"), "manipulator_bring_ball": ("manipulator", "bring_ball")}


@pytest.fixture(params=sorted(NAMES))
def name(request):
    return request.param


def original(name, seed=0):
    env = suite.load(*NAMES[name], task_kwargs={"random": seed})
    return env, env.reset()


def flat(time_step):
    return np.concatenate([np.ravel(values) for values in time_step.observation.values()])


def put(env, task, row):
    """The suite's environment into the state of a copy of ours, its solver without a guess."""
    physics = env.physics
    if "target" in task._episode_arrays:
        physics.named.model.body_pos["target_ball", ["x", "z"]] = task.target[row, :2]
        physics.named.model.body_quat["target_ball", ["qw", "qy"]] = task.target[row, 2:]
    physics.set_state(task.state[row, 1:])
    physics.forward()
    physics.data.qacc_warmstart[:] = 0


def steps_of_both(name, copies=25, steps=40):
    """Observation and reward after the same step from the same state, ``(steps * copies, ..)``, ours and theirs."""
    task, (env, _), rng = make_task(name, num_envs=copies, seed=0), original(name), np.random.default_rng(0)
    low, high = task.actuation_bounds
    push = np.zeros((copies, low.size))
    ours, theirs = [], []
    for _ in range(steps):
        push = np.clip(
            0.9 * push + 0.5 * rng.standard_normal(push.shape), low, high
        )  # it moves, not only shakes
        for row in range(copies):
            put(env, task, row)
            time_step = env.step(push[row])
            theirs.append((flat(time_step), time_step.reward))
        outcome = task.step(push)
        ours += zip(task.observe()["observation"], outcome.reward, strict=True)
    return [[np.array(column) for column in zip(*each, strict=True)] for each in (ours, theirs)]


def test_a_step_equals_the_suites(name):
    ours, theirs = steps_of_both(name)
    np.testing.assert_allclose(ours[0], theirs[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(ours[1], theirs[1], rtol=0, atol=1e-9)
    assert 0 < (theirs[1] > 0.01).mean() < 1
    if name == "manipulator_bring_ball":
        assert (theirs[0][:, 24:29] > 0).any(axis=0).sum() >= 3  # it feels something, in most of its sensors


def test_the_suites_own_episodes_are_followed_step_by_step(name):
    """In these the suite's solver starts from the last step's accelerations, ours does not."""
    task, (env, _), rng = make_task(name, seed=0), original(name, seed=3), np.random.default_rng(0)
    physics = env.physics
    if name == "manipulator_bring_ball":
        task.target[0, :2] = physics.named.model.body_pos["target_ball", ["x", "z"]]
        task.target[0, 2:] = physics.named.model.body_quat["target_ball", ["qw", "qy"]]
    push = np.zeros(physics.model.nu)
    for _ in range(300):
        push = np.clip(0.9 * push + 0.5 * rng.standard_normal(push.shape), -1, 1)
        task.set_state(physics.data.qpos[None], physics.data.qvel[None], tolerance=np.inf)
        time_step, outcome = env.step(push), task.step(push[None])
        np.testing.assert_allclose(task.observe()["observation"][0], flat(time_step), rtol=0, atol=1e-6)
        assert outcome.reward[0] == pytest.approx(time_step.reward, abs=1e-6)


def test_the_names_and_order_of_observations_are_the_suites(name):
    task, (_, first) = make_task(name, seed=0), original(name)
    sizes = {key: np.size(values) for key, values in first.observation.items()}
    assert {"observation": sum(sizes.values()), **sizes} == task.observation_sizes
    assert list(task.observe()) == ["observation", *sizes]
    assert {key: values.shape[1] for key, values in task.observe().items()} == task.observation_sizes


def test_an_episode_lasts_as_long_as_the_suites(name):
    task, (env, _) = make_task(name, seed=0), original(name)
    assert task.time_per_step == pytest.approx(env.control_timestep())
    assert task.max_episode_steps == env._step_limit
    spec = env.action_spec()
    np.testing.assert_array_equal(task.actuation_bounds, [spec.minimum, spec.maximum])


def test_a_cheetah_settles_as_in_the_suite():
    task = make_task("cheetah_run", num_envs=4, seed=0)
    low, high = task.model.jnt_range[3:].T
    drawn = [np.random.RandomState(seed).uniform(low, high) for seed in range(3)]
    task.settle(np.arange(1, 4), np.array(drawn))
    for seed in range(3):
        env, first = original("cheetah_run", seed)
        np.testing.assert_allclose(task.state[seed + 1, 1:], env.physics.get_state(), rtol=0, atol=1e-9)
        np.testing.assert_allclose(task.observe()["observation"][seed + 1], flat(first), rtol=0, atol=1e-9)


def test_starts_of_bring_ball_are_distributed_as_in_the_suite():
    env, _ = original("manipulator_bring_ball")
    theirs = np.array([flat(env.reset()) for _ in range(400)])
    task = make_task("manipulator_bring_ball", num_envs=2_000, seed=1)
    ours = task.observe()["observation"]
    for entry in range(ours.shape[1]):
        assert ks_2samp(ours[:, entry], theirs[:, entry]).pvalue > 1e-4, entry
    ball, target = ours[:, 33:35], ours[:, 40:42]
    on_target = (np.abs(ball - target) < 1e-12).all(axis=1).mean()
    assert on_target == pytest.approx((theirs[:, 33:35] == theirs[:, 40:42]).all(axis=1).mean(), abs=0.05)
    assert not any(task._penetrates(row) for row in range(100))


def test_a_ball_in_the_hand_is_where_the_suite_has_it():
    task = make_task("manipulator_bring_ball", num_envs=3_000, seed=0)
    x, z, _ = task._hand(task.qpos, task._grasp)
    held = np.flatnonzero(np.hypot(x - task.qpos[:, 8], z - task.qpos[:, 9]) < 1e-9)
    assert 0.02 < len(held) / task.num_envs < 0.2
    env, _ = original("manipulator_bring_ball")
    for row in held[:5]:
        put(env, task, row)
        site = env.physics.named.data.site_xpos["grasp"]
        np.testing.assert_allclose(site[[0, 2]], task.qpos[row, 8:10], atol=1e-12)
        xx, zx = env.physics.named.data.site_xmat["grasp", ["xx", "zx"]]
        difference = np.pi - np.arctan2(zx, xx) - task.qpos[row, 10]
        assert np.sin(difference / 2) == pytest.approx(0, abs=1e-9)


def test_what_is_felt_survives_saving():
    task, other = (make_task("manipulator_bring_ball", num_envs=8, seed=seed) for seed in (0, 1))
    for _ in range(30):
        task.step(np.tile([1.0, 1.0, 1.0, 1.0, -1.0], (8, 1)))
    other.load_state_dict(task.state_dict())
    assert task.observe()["touch"].any()
    np.testing.assert_array_equal(other.observe()["observation"], task.observe()["observation"])
