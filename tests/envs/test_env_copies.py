"""Copied and pickled environments go on bit for bit, on their own; instances are handed to collectors' workers."""

import copy
import pickle
from contextlib import closing

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.collectors import MultiSyncCollector
from torchrl.envs import GymEnv, TransformedEnv
from torchrl.envs.transforms import DoubleToFloat, RewardSum

from nht.envs import TASKS, make_dm_control, make_env, make_gymnasium, make_task, make_torchrl


def pickled(something):
    return pickle.loads(pickle.dumps(something))


WAYS = {"deepcopy": copy.deepcopy, "pickle": pickled}


@pytest.fixture(params=sorted(WAYS))
def duplicate(request):
    return WAYS[request.param]


@pytest.fixture(params=sorted(TASKS))
def name(request):
    return request.param


def played(env, actions, current):
    frames = []
    for action in actions:
        frame, current = env.step_and_maybe_reset(current.clone().set("action", action))
        frames.append(frame["next"])
    return [*frames, env.reset()]


def assert_same(ours, theirs):
    for mine, their in zip(ours, theirs, strict=True):
        assert all(torch.equal(mine[key], their[key]) for key in their.keys(True, True))


def assert_independent_twins(env, duplicate, count=6):
    """The copy goes on as the original does, whatever each of them has done in the meantime."""
    current = env.reset()
    actions = [env.action_spec.rand() for _ in range(count)]
    for action in actions[:3]:
        _, current = env.step_and_maybe_reset(current.set("action", action))
    twin, third = duplicate(env), duplicate(env)
    expected = played(env, actions, current)
    assert_same(played(twin, actions, current), expected)
    twin.close()
    assert_same(played(third, actions, current), expected)


def test_tasks(name, duplicate):
    task = make_task(name, num_envs=2, num_threads=2, seed=0, max_episode_steps=5)
    low, high = task.actuation_bounds
    drawn = np.random.default_rng(0).uniform(low, high, (7, 2, low.size))
    task.step(drawn[0])
    twin = duplicate(task)
    assert twin.qpos.base is twin.state
    assert twin.qvel.base is twin.state
    for actuation in drawn:
        for each in (task, twin):
            each.step(actuation)
        for key, values in task.observe().items():
            np.testing.assert_array_equal(twin.observe()[key], values, err_msg=key)
    task.reset()
    twin.reset()
    np.testing.assert_array_equal(twin.state, task.state)
    task.close()
    twin.step(drawn[0])
    assert duplicate(task).closed


def test_torchrls_side(name, duplicate):
    with closing(make_env(name, num_envs=2, seed=0, max_episode_steps=5)) as env:
        assert_independent_twins(env, duplicate)


@pytest.mark.parametrize(
    "make", [lambda: make_gymnasium("Ant-v5", 2, 0), lambda: make_dm_control("reacher-easy", 2, 0)]
)
def test_environments_of_others(make, duplicate):
    with closing(make()) as env:
        assert_independent_twins(env, duplicate)


def test_transforms_come_along(duplicate):
    with closing(TransformedEnv(make_env("hopper", num_envs=2, seed=0), RewardSum())) as env:
        assert_independent_twins(env, duplicate)


@pytest.mark.parametrize("vector", [False, True])
def test_gymnasiums_side(vector, duplicate):
    make = gymnasium.make_vec if vector else gymnasium.make
    options = {"num_envs": 2} if vector else {}
    env = make("nht/WAMWipe-v0", start="random", max_episode_steps=4, render_mode="rgb_array", **options)
    env.reset(seed=0)
    env.action_space.seed(0)
    actions = [env.action_space.sample() for _ in range(9)]
    env.step(actions[0])
    twin = duplicate(env)
    for action in actions:
        for mine, theirs in zip(twin.step(action)[:4], env.step(action)[:4], strict=True):
            np.testing.assert_array_equal(mine, theirs)
        if not vector and env.unwrapped.task.steps[0] == 4:
            np.testing.assert_array_equal(twin.reset()[0], env.reset()[0])
    env.close()
    twin.reset(seed=3)


@pytest.mark.usefixtures("can_render")
def test_a_copy_draws_for_itself(duplicate):
    env = make_env("wam_wipe", num_envs=1, seed=0)
    env.reset()
    picture = env.render(width=64, height=48)
    twin = duplicate(env)
    env.close()
    np.testing.assert_array_equal(twin.render(width=64, height=48), picture)


def test_what_cannot_be_saved_cannot_be_copied(duplicate):
    env = make_torchrl(lambda: TransformedEnv(GymEnv("HalfCheetah-v5"), DoubleToFloat()), seed=0)
    with closing(env), pytest.raises(TypeError, match=r"neither copied nor pickled: .*Hand over a function"):
        duplicate(env)


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [lambda seed: make_env("wam_wipe", 2, seed=seed), lambda seed: make_gymnasium("Hopper-v5", 2, seed)],
)
def test_instances_are_handed_to_workers(make):
    envs = [make(0), make(1)]
    collector = MultiSyncCollector(envs, frames_per_batch=40, total_frames=80, cat_results=0)
    batches = [batch.clone() for batch in collector]
    collector.shutdown()
    assert [batch.shape for batch in batches] == [(4, 10), (4, 10)]
    first = batches[0]["observation"][:, 0]
    assert len(torch.unique(first, dim=0)) == 4
    for env in envs:
        env.reset()  # they are nobody else's
        env.close()
