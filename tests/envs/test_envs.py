"""What every task promises, whatever it is about: these tests run over all of ``nht.envs.TASKS``.

The file that a task's record names as ``golden`` holds its first steps (copy 0 of two, seed 0, after three steps of
`random_actions`: what the policy sees, and the three rewards) and, as ``constant``, the entries of its observations
that are the same in every state of every episode, or at least of these short ones.
"""

import inspect
import json
import math
import pickle

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from nht.envs import TASKS, gymnasium_id, make_env, make_expert, mujoco_log
from nht.envs.free_motion import FOURTH_ORDER

FLAGS = ("done", "terminated", "truncated", "success", "failure", "diverged")

EXPERTS = [name for name in TASKS if TASKS[name].expert is not None]


def golden(name):
    """What the record's file says."""
    return json.loads(TASKS[name].golden.read_text())


@pytest.fixture(params=sorted(TASKS))
def name(request):
    return request.param


def random_actions(env, count, seed=0):
    """Actuations within their bounds, ``(count, N, n)``."""
    low, high = env.task.actuation_bounds
    drawn = np.random.default_rng(seed).uniform(low, high, (count, env.task.num_envs, low.size))
    return torch.tensor(drawn, dtype=torch.float32)


def play(env, actions, tensordict=None):
    """Step ``env`` from its reset (or from ``tensordict``), with resets, to a TensorDict ``(count, N)``."""
    frames, tensordict = [], env.reset() if tensordict is None else tensordict
    for action in actions:
        frame, tensordict = env.step_and_maybe_reset(tensordict.set("action", action.clone()))
        frames.append(frame.clone())
    return torch.stack(frames)


def assert_same(one, other):
    """Equal to the bit."""
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    differing = [key for key in one.keys(True, True) if not torch.equal(one[key], other[key])]
    assert differing == []


# What an environment says of itself.


@pytest.mark.parametrize("num_envs", [1, 3])
def test_specs(name, num_envs):
    env = make_env(name, num_envs=num_envs, seed=0)
    check_env_specs(env)
    assert env.batch_size == (num_envs,)
    assert env.action_spec.shape == (num_envs, env.task.actuation_bounds[0].size)
    assert env.action_spec.dtype == env.reward_spec.dtype == torch.float32
    for key, size in env.task.observation_sizes.items():
        assert env.observation_spec[key].shape == (num_envs, size)
        assert env.observation_spec[key].dtype == torch.float32
    data = env.rollout(2)["next"]
    assert all(data[flag].shape == (num_envs, 2, 1) and data[flag].dtype == torch.bool for flag in FLAGS)


def test_shared_options_and_gymnasium_id(name):
    shared = {"num_envs", "num_threads", "seed", "max_episode_steps"}
    parameters = inspect.signature(TASKS[name].task_class).parameters
    assert shared <= set(parameters)
    assert TASKS[name].max_episode_steps == parameters["max_episode_steps"].default
    assert gymnasium_id(name) in gymnasium.registry


def test_no_observation_entry_is_constant(name):
    env = make_env(name, num_envs=16, max_episode_steps=10, seed=0)
    data = play(env, random_actions(env, 30)).flatten()
    constant = {
        (key, entry)
        for key, size in env.task.observation_sizes.items()
        for entry in range(size)
        if (data["next", key][:, entry] == data["next", key][0, entry]).all()
    }
    assert constant == {
        (key, entry) for key, entries in golden(name)["constant"].items() for entry in entries
    }


def test_flags_agree(name):
    env = make_env(name, num_envs=32, max_episode_steps=20, seed=0)
    data = play(env, random_actions(env, 60))["next"]
    assert torch.equal(data["done"], data["terminated"] | data["truncated"])
    assert not (data["success"] & data["failure"]).any()
    assert not data["diverged"].any()
    assert data["reward"].isfinite().all()


def test_actuation_is_clipped_to_its_bounds(name):
    env, wild = make_env(name, num_envs=2, seed=0), make_env(name, num_envs=2, seed=0)
    low, high = (torch.tensor(bound, dtype=torch.float32) for bound in env.task.actuation_bounds)
    for within, beyond in [(high, high + 100), (low, low - 100)]:
        data, other = (play(each, bound.expand(3, 2, -1)) for each, bound in [(env, within), (wild, beyond)])
        assert_same(data["next"], other["next"])


def test_golden_first_steps(name):
    if name == "ant" and FOURTH_ORDER:
        pytest.skip("recorded with MuJoCo 3, whose Runge-Kutta steps turn otherwise")
    env = make_env(name, num_envs=2, seed=0)
    env.set_seed(0)
    data = play(env, random_actions(env, 3))["next"]
    observation, rewards = golden(name)["observation"], golden(name)["rewards"]
    np.testing.assert_allclose(data["observation"][-1, 0].numpy(), observation, atol=2e-5)
    np.testing.assert_allclose(data["reward"][:, 0, 0].numpy(), rewards, atol=2e-5)


# The same again, to the bit.


def test_a_seed_repeats_the_trajectory(name):
    one, other = (make_env(name, num_envs=3, seed=7, max_episode_steps=6) for _ in range(2))
    actions = random_actions(one, 20)
    assert_same(play(one, actions), play(other, actions))
    play(one, actions[:3])
    one.set_seed(5)
    other.set_seed(5)
    assert_same(play(one, actions), play(other, actions))


def test_each_seed_and_each_reset_acts(name):
    env = make_env(name, num_envs=2, seed=0)
    starts = [make_env(name, num_envs=2, seed=seed).reset() for seed in (1, 2)]
    for seed in (11, 12):
        env.set_seed(seed)
        starts += [env.reset(), env.reset()]
    assert len({tuple(start["observation"].flatten().tolist()) for start in starts}) == len(starts)


def test_number_of_threads_does_not_matter(name):
    one, two = (
        make_env(name, num_envs=5, num_threads=threads, max_episode_steps=8, seed=0) for threads in (1, 2)
    )
    actions = random_actions(one, 20)
    assert_same(play(one, actions), play(two, actions))


def test_a_batch_equals_single_copies(name):
    batch = make_env(name, num_envs=4, seed=0)
    play(batch, random_actions(batch, 5))
    saved = batch.task.state_dict()
    actions = random_actions(batch, 10, seed=1)
    together = play(batch, actions, batch.fake_tensordict())
    for row in range(4):
        single = make_env(name, num_envs=1, seed=row)
        single.task.load_state_dict(row_of(saved, row))
        alone = play(single, actions[:, row : row + 1], single.fake_tensordict())
        assert_same(alone["next"], together["next"][:, row : row + 1])


def row_of(saved, row):
    return {
        key: value[row : row + 1] if isinstance(value, np.ndarray) else value for key, value in saved.items()
    }


def test_goes_on_from_a_saved_state(name):
    env = make_env(name, num_envs=3, max_episode_steps=8, seed=0)
    actions = random_actions(env, 30)
    play(env, actions[:5])
    saved, observed = pickle.dumps(env.task.state_dict()), env.task.observe()
    expected = play(env, actions, env.fake_tensordict())["next"]
    assert expected["done"].any()

    fresh = make_env(name, num_envs=3, seed=9, max_episode_steps=8)
    for resumed in (env, fresh):
        state = pickle.loads(saved)
        resumed.task.load_state_dict(state)
        for key, values in resumed.task.observe().items():
            np.testing.assert_array_equal(values, observed[key])
        assert_same(play(resumed, actions, resumed.fake_tensordict())["next"], expected)
        assert pickle.dumps(state) == saved, "the saved state was written to"


def test_a_reset_after_loading_is_a_reset(name):
    env = make_env(name, num_envs=2, seed=0)
    play(env, random_actions(env, 1))
    before = env.task.state_dict()
    env.task.load_state_dict(before)
    env.reset()
    assert env.task.steps.tolist() == [0, 0]
    assert env.task.state_dict()["rng"] != before["rng"]


# One copy's business is its own.


def test_partial_reset_touches_its_rows_only(name):
    env = make_env(name, num_envs=4, seed=0)
    before = play(env, random_actions(env, 3))["next"][-1]
    state = env.task.state_dict()
    mask = torch.tensor([False, True, False, True])
    request = before.exclude("reward").set("_reset", mask[:, None])
    after = env.reset(request.clone())
    assert_same(after[~mask], before.exclude("reward")[~mask])
    for key, values in env.task.state_dict().items():
        if isinstance(values, np.ndarray):
            np.testing.assert_array_equal(values[~mask.numpy()], state[key][~mask.numpy()])
    assert env.task.steps.tolist() == [3, 0, 3, 0]
    assert (after["observation"] != before["observation"])[mask].any(dim=1).all()


def test_a_reset_of_no_copy_changes_nothing(name):
    task = make_env(name, num_envs=2, seed=0).task
    before = task.state.copy(), task.rng.bit_generator.state
    task.reset(np.array([], dtype=np.intp))
    np.testing.assert_array_equal(task.state, before[0])
    assert task.rng.bit_generator.state == before[1]


def test_a_finished_copy_starts_anew_and_its_last_observation_stays(name):
    env = make_env(name, num_envs=3, max_episode_steps=10, seed=0)
    tensordict = env.reset()
    env.task.steps[1] = 9
    reference = make_env(name, num_envs=3, seed=0)
    reference.task.load_state_dict(env.task.state_dict())
    action = random_actions(env, 1)[0]
    frame, after = env.step_and_maybe_reset(tensordict.set("action", action))
    expected = reference.step(reference.fake_tensordict().set("action", action))["next"]
    assert frame["next", "done"].squeeze().tolist() == [False, True, False]
    assert torch.equal(frame["next", "observation"], expected["observation"])
    assert not after["done"].any()
    assert not torch.equal(after["observation"][1], expected["observation"][1])
    assert torch.equal(after["observation"][[0, 2]], expected["observation"][[0, 2]])
    assert env.task.steps.tolist() == [1, 0, 1]


def test_returned_tensors_belong_to_the_caller(name):
    """Neither does a later step write into them, nor does the environment read them again."""
    env, vandalised = (make_env(name, num_envs=3, max_episode_steps=4, seed=0) for _ in range(2))
    for each in (env, vandalised):
        each.task.steps[1] = 2  # so that copies finish at different steps
    actions = random_actions(env, 12)
    kept, frames, tensordict = [], [], env.reset()
    for action in actions:
        frame, tensordict = env.step_and_maybe_reset(tensordict.set("action", action.clone()))
        kept.append((frame, frame.clone()))
    for frame, copy in kept:
        assert_same(frame, copy)

    tensordict = vandalised.reset()
    for action in actions:
        frame, tensordict = vandalised.step_and_maybe_reset(tensordict.set("action", action.clone()))
        frames.append(frame["next"].clone())
        for leaf in [*frame.values(True, True), *tensordict.values(True, True)]:
            leaf.fill_(True)
    assert_same(torch.stack(frames), torch.stack([copy["next"] for _, copy in kept]))


def test_returned_arrays_belong_to_the_caller(name):
    task = make_env(name, num_envs=3, seed=0).task
    actuation = random_actions(make_env(name, num_envs=3, seed=0), 1)[0].numpy()
    outcome = task.step(actuation)
    kept = task.observe() | vars(outcome)
    copies = {key: values.copy() for key, values in kept.items()}
    task.step(-actuation)
    task.reset()
    for key, values in kept.items():
        np.testing.assert_array_equal(values, copies[key], err_msg=key)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_an_action_that_is_not_finite_fails_its_copy_only(name, value, monkeypatch):
    env, healthy = make_env(name, num_envs=3, seed=0), make_env(name, num_envs=3, seed=0)
    monkeypatch.setattr(mujoco_log, "_told", told := set())  # models may be warned of when they are compiled
    actions = random_actions(env, 6)
    expected = play(healthy, actions)
    actions[2, 1, -1] = value
    data = play(env, actions)
    assert_one_copy_failed(data, expected, row=1, step=2)
    assert not told, "it reached the simulation"


@pytest.mark.parametrize("num_threads", [1, 2])
def test_diverged_physics_fails_its_copy_only(name, num_threads):
    env, healthy = (make_env(name, num_envs=3, num_threads=num_threads, seed=0) for _ in range(2))
    actions = random_actions(env, 6)
    expected = play(healthy, actions)
    before = play(env, actions[:2])
    env.task.qpos[0] = 1e12
    env.task.qvel[0] = 1e12
    after = play(env, actions[2:], env.fake_tensordict())
    assert_one_copy_failed(torch.cat([before, after]), expected, row=0, step=2)


def test_a_diverged_copy_stays_where_it_was(name):
    env = make_env(name, num_envs=2, seed=0)
    env.task.qpos[0] = 1e12
    for action in random_actions(env, 2):
        assert env.task.step(action.numpy()).diverged.tolist() == [True, False]
        assert (env.task.qpos[0] == 1e12).all()


def assert_one_copy_failed(data, expected, row, step):
    """Copy ``row`` fails at ``step``, is reset and goes on; the others are as ``expected``."""
    others = [other for other in range(data.shape[1]) if other != row]
    assert_same(data["next"][:, others], expected["next"][:, others])
    bad = data["next"][step, row]
    assert [bool(bad[flag]) for flag in FLAGS] == [True, True, False, False, True, True]
    assert all(leaf.float().isfinite().all() for leaf in data["next"].values())
    assert not data["next", "diverged"][step + 1 :].any()
    assert not data["next", "done"][step + 1 :].any()


def test_the_time_limit_truncates_and_does_not_terminate(name):
    env = make_env(name, num_envs=2, max_episode_steps=5, seed=0)
    still = torch.zeros_like(random_actions(env, 10))
    data = play(env, still)["next"]
    assert data["truncated"][:, 0, 0].tolist() == ([False] * 4 + [True]) * 2
    assert torch.equal(data["done"], data["truncated"])
    assert not data["terminated"].any()


# Ends and errors.


def test_closing(name):
    env = make_env(name, num_threads=2, seed=0)
    tensordict = env.rand_action(env.reset())
    env.close()
    env.close()
    assert env.is_closed
    with pytest.raises(RuntimeError, match="closed"):
        env.step(tensordict)
    with pytest.raises(RuntimeError, match="closed"):
        env.reset()


def test_wrong_action_shape(name):
    env = make_env(name, num_envs=2, seed=0)
    size = env.action_spec.shape[-1]
    with pytest.raises(ValueError, match=rf"\(2, {size}\), got \(2, {size + 1}\)"):
        env.step(env.reset().set("action", torch.zeros(2, size + 1)))
    with pytest.raises(ValueError, match=rf"\(2, {size}\), got \({size},\)"):
        env.task.step(np.zeros(size))


@pytest.mark.parametrize("option", ["num_envs", "num_threads", "max_episode_steps"])
def test_counts_below_one(name, option):
    with pytest.raises(ValueError, match=f"{option} must be at least 1, got 0"):
        make_env(name, seed=0, **{option: 0})


def test_unknown_names(name):
    with pytest.raises(ValueError, match=rf"unknown environment 'nonesuch'.*{name}"):
        make_env("nonesuch", seed=0)
    with pytest.raises(ValueError, match=rf"{name} got an unexpected .*'nonesuch': .*max_episode_steps"):
        make_env(name, nonesuch=1, seed=0)
    with pytest.raises(ValueError, match=rf"'nonesuch' has no scripted expert.*{sorted(EXPERTS)[0]}"):
        make_expert("nonesuch")
    with pytest.raises(ValueError, match="unexpected keyword argument 'nonesuch'"):
        make_expert(sorted(EXPERTS)[0], nonesuch=1)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_device(name):
    check_env_specs(make_env(name, num_envs=2, device="cuda", seed=0))
    on_gpu, on_cpu = make_env(name, num_envs=2, device="cuda", seed=0), make_env(name, num_envs=2, seed=0)
    actions = random_actions(on_cpu, 5)
    data = play(on_gpu, actions.cuda())
    assert data.device.type == "cuda"
    assert_same(data.cpu(), play(on_cpu, actions))
