"""Steps of some copies: TorchRL's "_step" mask, and what asks for it. The others keep all that they are."""

from contextlib import closing
from functools import cache

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchrl.envs import ConditionalSkip, TransformedEnv
from torchrl.envs.transforms import MultiAction, ObservationNorm, RewardSum

from nht.envs import TASKS, make_dm_control, make_env, make_gymnasium

FLAGS = ("terminated", "truncated", "success", "failure", "diverged")
N = 4


@pytest.fixture(params=sorted(TASKS), scope="module")
def name(request):
    return request.param


def drawn(task, count=1, seed=0):
    low, high = task.actuation_bounds
    return np.random.default_rng(seed).uniform(low, high, (count, task.num_envs, low.size))


@cache
def made(name, which):
    """A task in the middle of its episodes, and its state."""
    env = make_env(name, num_envs=N, seed=3)
    for actuation in drawn(env.task, 3, seed=5):
        env.task.step(actuation)
    return env, env.task.state_dict()


def going(name, which=0):
    env, state = made(name, which)
    env.task.load_state_dict(state)
    return env


def arrays(task):
    return {key: value for key, value in task.state_dict().items() if isinstance(value, np.ndarray)}


# The task.


def test_copies_that_stand_still_keep_everything(name):
    task = going(name).task
    before, seen, generator = arrays(task), task.observe(), task.rng.bit_generator.state
    still = np.array([True, False, True, False])
    outcome = task.step(drawn(task)[0], np.flatnonzero(~still))
    for key, values in arrays(task).items():
        np.testing.assert_array_equal(values[still], before[key][still], err_msg=key)
    for key, values in task.observe().items():
        np.testing.assert_array_equal(values[still], seen[key][still], err_msg=key)
    assert (task.state[~still] != before["state"][~still]).any(axis=1).all()
    assert task.steps.tolist() == [3, 4, 3, 4]
    assert task.rng.bit_generator.state == generator
    np.testing.assert_array_equal(outcome.reward[still], 0.0)


@settings(max_examples=5, deadline=None)
@given(rows=st.lists(st.integers(0, N - 1), unique=True), seed=st.integers(0, 100))
def test_two_parts_of_a_step_are_the_step(name, rows, seed):
    whole, parts = going(name).task, going(name, 1).task
    actuation = drawn(whole, seed=seed)[0]
    first = np.zeros(N, dtype=bool)
    first[rows] = True
    expected = whole.step(actuation)
    one = parts.step(actuation, np.array(rows, dtype=np.intp))
    other = parts.step(actuation, np.flatnonzero(~first))
    for key, values in arrays(whole).items():
        np.testing.assert_array_equal(arrays(parts)[key], values, err_msg=key)
    for key, values in whole.observe().items():
        np.testing.assert_array_equal(parts.observe()[key], values, err_msg=key)
    np.testing.assert_array_equal(np.where(first, one.reward, other.reward), expected.reward)
    for flag in FLAGS:
        np.testing.assert_array_equal(getattr(other, flag), getattr(expected, flag), err_msg=flag)


def test_the_order_of_rows_does_not_matter_nor_naming_one_twice(name):
    one, other = going(name).task, going(name, 1).task
    actuation = drawn(one)[0]
    one.step(actuation, np.array([3, 1]))
    other.step(actuation, np.array([1, 3, 1]))
    np.testing.assert_array_equal(one.state, other.state)


def test_numbers_that_are_not_finite_matter_only_where_a_copy_steps(name):
    task = going(name).task
    actuation = drawn(task)[0]
    actuation[:2] = np.nan
    outcome = task.step(actuation, np.array([0, 2]))
    assert outcome.diverged.tolist() == [True, False, False, False]
    assert outcome.failure[0]
    assert outcome.terminated.tolist() == [True, *[False] * 3]
    later = task.step(drawn(task)[0], np.array([3]))
    assert later.diverged.tolist() == [True, False, False, False], "the flags of its last step"
    task.reset(np.array([0]))
    assert not task.step(drawn(task)[0], np.array([3])).diverged.any()


def test_flags_of_copies_that_stand_still_are_saved(name):
    task = going(name).task
    actuation = drawn(task)[0]
    actuation[1] = np.inf
    task.step(actuation)
    other = going(name, 1).task
    other.load_state_dict(task.state_dict())
    assert other.step(actuation, np.array([0])).failure[1]
    older = {key: value for key, value in task.state_dict().items() if key != "flags"}
    other.load_state_dict(older)
    assert not other.step(actuation, np.array([0])).diverged.any()


def test_what_is_returned_belongs_to_the_caller():
    task, twin = going("wam_wipe").task, going("wam_wipe", 1).task
    for rows in ([1], [], [0, 2]):
        outcome, expected = (
            each.step(drawn(task)[0], np.array(rows, dtype=np.intp)) for each in (task, twin)
        )
        np.testing.assert_array_equal(outcome.failure, expected.failure)
        outcome.failure[:] = ~outcome.failure


# TorchRL's mask.


@pytest.mark.parametrize("shape", [(N,), (N, 1)])
def test_a_mask(name, shape):
    env, whole = going(name), going(name, 1)
    mask = torch.tensor([True, False, False, True])
    current = env.fake_tensordict().exclude("next").set("action", torch.tensor(drawn(env.task)[0]).float())
    seen = {key: torch.tensor(value).float() for key, value in env.task.observe().items()}
    expected = whole.step(current.clone())["next"]
    stepped = env.step(current.clone().set("_step", mask.view(shape)))["next"]
    assert set(stepped.keys()) == set(expected.keys())
    for key, values in stepped.items():
        assert torch.equal(values[mask], expected[key][mask]), key
        if key in seen:
            assert torch.equal(values[~mask], seen[key][~mask]), key
    assert not stepped["reward"][~mask].any()


def test_a_mask_of_all_is_no_mask(name):
    env, whole = going(name), going(name, 1)
    current = env.fake_tensordict().exclude("next").set("action", torch.tensor(drawn(env.task)[0]).float())
    expected = whole.step(current.clone())["next"]
    stepped = env.step(current.set("_step", torch.ones(N, dtype=torch.bool)))["next"]
    assert all(torch.equal(stepped[key], values) for key, values in expected.items())


def foreign(maker, name, num_envs=3):
    return lambda: maker(name, num_envs=num_envs, seed=0)


ALL_KINDS = {
    "ours": lambda: make_env("hopper", num_envs=3, seed=0),
    "gymnasium": foreign(make_gymnasium, "Hopper-v5"),
    "dm_control": foreign(make_dm_control, "reacher-easy"),
}


@pytest.fixture(params=sorted(ALL_KINDS))
def env(request):
    with closing(ALL_KINDS[request.param]()) as env:
        yield env


def test_a_skipped_copy_is_shown_as_before_behind_transforms(env):
    """Where TorchRL fills in what the policy saw, a normaliser would normalise it twice."""
    skip = ConditionalSkip(lambda td: torch.tensor([False, True, False]))
    norm = ObservationNorm(loc=1.0, scale=3.0, in_keys=["observation"], standard_normal=True)
    env = TransformedEnv(TransformedEnv(env, norm), skip, auto_unwrap=False)
    current = env.reset()
    start = current["observation"].clone()
    for _ in range(3):
        frame, current = env.step_and_maybe_reset(env.rand_action(current))
        after = frame["next"]
        assert torch.equal(after["observation"][1], start[1])
        assert (after["observation"] != start)[[0, 2]].any(-1).all()
        assert not after["reward"][1].any()


def test_a_copy_skipped_after_another_one_was_reset(env):
    current = env.reset()
    for _ in range(2):
        current = env.step_mdp(env.step(env.rand_action(current)))
    seen = current["observation"].clone()
    mask = torch.tensor([[True], [False], [False]])
    current = env.reset(current.exclude("reward").set("_reset", mask))
    hidden = env.rand_action(current).set("observation", torch.full_like(seen, 9.0))
    after = env.step(hidden.set("_step", torch.tensor([True, False, True])))["next"]
    assert torch.equal(after["observation"][1], seen[1])
    assert not after["done"].any()


def test_the_return_of_a_skipped_copy_does_not_grow():
    env = make_env("hopper", num_envs=3, seed=0)
    env = TransformedEnv(
        TransformedEnv(env, RewardSum()),
        ConditionalSkip(lambda td: torch.tensor([True, False, False])),
        auto_unwrap=False,
    )
    total = env.rollout(4, break_when_any_done=False)["next", "episode_reward"][..., 0]
    assert not total[0].any()
    assert (total[1:, -1] > total[1:, 0]).all()


def test_a_chunk_of_actions_stops_at_the_end_of_an_episode():
    env = TransformedEnv(make_env("hopper", num_envs=2, seed=0), MultiAction())
    current = env.reset()
    task = env.base_env.task
    task.steps[0] = task.max_episode_steps - 2
    other = make_env("hopper", num_envs=2, seed=0)
    seen = other.reset()
    other.task.steps[0] = task.max_episode_steps - 2
    chunk = torch.full((2, 4, 3), 0.1)
    after = env.step(current.set("action", chunk))["next"]
    assert task.steps.tolist() == [task.max_episode_steps, 4]
    assert after["done"].squeeze(-1).tolist() == [True, False]
    states = [other.step(seen.set("action", chunk[:, i]))["next", "observation"] for i in range(4)]
    assert torch.equal(after["observation"][0], states[1][0])
    assert torch.equal(after["observation"][1], states[3][1])


def test_a_rollout_until_all_are_done(name):
    env = make_env(name, num_envs=2, seed=0, max_episode_steps=6)
    env.reset()
    env.task.steps[0] = 3
    start = env.fake_tensordict().exclude("next")
    policy = lambda td: td.set("action", torch.zeros_like(env.full_action_spec["action"].rand()))  # noqa: E731
    data = env.rollout(
        20, policy, auto_reset=False, tensordict=start, break_when_any_done=False, break_when_all_done=True
    )
    assert env.task.steps.tolist() == [6, 6]
    assert data.shape == (2, 6)
    assert data["next", "done"][:, -1].all()


def test_skipping_all(env):
    env = TransformedEnv(env, ConditionalSkip(lambda td: torch.ones(3, dtype=torch.bool)))
    current = env.reset()
    after = env.step(env.rand_action(current.clone()))["next"]
    assert torch.equal(after["observation"], current["observation"])


def test_rows_cost_what_they_are(monkeypatch):
    """Only the copies that step are simulated."""
    task = going("half_cheetah").task
    simulated = []
    real = task._rollout

    class Counting:
        def rollout(self, models, *args, **kwargs):
            simulated.append(len(models))
            return real.rollout(models, *args, **kwargs)

        def close(self):
            real.close()

    monkeypatch.setattr(task, "_rollout", Counting())
    task.step(drawn(task)[0], np.array([2]))
    task.step(drawn(task)[0], np.array([], dtype=np.intp))
    assert simulated == [1]
