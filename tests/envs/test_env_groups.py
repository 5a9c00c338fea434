"""Copies in groups, each on a seed of its own: a group is what an environment of that seed alone would be."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import check_env_specs

from nht.envs import make_env, make_task
from nht.recipes.run.environments import mapped_env
from nht.recipes.sections import EnvConfig

SEEDS = (3, 8)
COPIES = 3
TASKS = {
    "wam_wipe": {"start": "random", "max_episode_steps": 7},
    "wam_grasp": {"max_episode_steps": 7},
    "half_cheetah": {"max_episode_steps": 7},
    "hopper": {},  # ends at a fall, each copy at another step
}


@pytest.fixture(params=sorted(TASKS))
def task(request):
    return request.param, TASKS[request.param]


def together(task, seeds=SEEDS):
    name, options = task
    return make_env(name, COPIES, seed=list(seeds), **options)


def played(env, actions, masks, current=None):
    """What comes of ``actions``; copies start anew at their ends, and before a step where ``masks`` say so."""
    current = env.reset() if current is None else current
    frames = [current]
    for action, mask in zip(actions, masks, strict=True):
        current = env.reset(current.set("_reset", mask))
        frame, current = env.step_and_maybe_reset(current.exclude("_reset").set("action", action))
        frames += [frame["next"], current]
    return [frame.clone() for frame in frames]


def plan(env, steps=20, draws=0):
    torch.manual_seed(draws)
    actions = [env.action_spec.rand() for _ in range(steps)]
    masks = [torch.rand(*env.batch_size, 1) < 0.2 for _ in range(steps)]
    return actions, masks


def assert_same(ours, theirs):
    for mine, their in zip(ours, theirs, strict=True):
        for key in their.keys(True, True):
            assert torch.equal(mine[key], their[key]), key


def test_every_group_is_the_environment_of_its_seed(task):
    name, options = task
    env = together(task)
    assert env.batch_size == (len(SEEDS), COPIES)
    actions, masks = plan(env)
    frames = played(env, actions, masks)
    for group, seed in enumerate(SEEDS):
        alone = make_env(name, COPIES, seed=seed, **options)
        of_group = ([each[group] for each in actions], [each[group] for each in masks])
        assert_same([frame[group] for frame in frames], played(alone, *of_group))


def test_some_copies_of_each_group_stand_still(task):
    name, options = task
    env = together(task)
    alone = [make_env(name, COPIES, seed=seed, **options) for seed in SEEDS]
    mask = torch.tensor([[True, False, True], [False, True, False]])
    current, own = env.reset(), [each.reset() for each in alone]
    action = env.action_spec.rand()
    outcome = env.step(current.set("action", action).set("_step", mask))["next"]
    for group, each in enumerate(alone):
        told = own[group].set("action", action[group]).set("_step", mask[group])
        assert_same([outcome[group]], [each.step(told)["next"]])


def test_a_group_draws_the_same_whoever_is_beside_it(task):
    env, other = together(task), together(task, (SEEDS[0], 77, 5))
    actions, masks = plan(env)
    frames = played(env, actions, masks)
    actions = [torch.cat([each, each[1:]]) for each in actions]
    more = played(other, actions, [torch.cat([each, ~each[1:]]) for each in masks])
    assert_same([frame[0] for frame in more], [frame[0] for frame in frames])


def test_it_goes_on_bit_for_bit_from_what_was_saved(task):
    env, later = together(task), together(task, (0, 1))
    actions, masks = plan(env)
    current = played(env, actions, masks)[-1]
    later.reset()
    later.task.load_state_dict(copy.deepcopy(env.task.state_dict()))
    actions, masks = plan(env, draws=1)
    expected = played(env, actions, masks, current.clone())
    assert_same(played(later, actions, masks, current.clone()), expected)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_copied_and_pickled_it_goes_on_bit_for_bit(task, duplicate):
    env = together(task)
    actions, masks = plan(env)
    current = played(env, actions, masks)[-1]
    twin = duplicate(env)
    assert twin.batch_size == env.batch_size
    actions, masks = plan(env, draws=1)
    expected = played(env, actions, masks, current.clone())
    assert_same(played(twin, actions, masks, current.clone()), expected)


def test_specs(task):
    check_env_specs(together(task))


def test_threads_change_nothing():
    one, four = (
        make_env("hopper", COPIES, num_threads=threads, seed=list(SEEDS), max_episode_steps=5)
        for threads in (1, 4)
    )
    assert_same(played(one, *plan(one)), played(four, *plan(one)))


def test_one_seed_in_a_list_is_one_group():
    env, alone = make_env("hopper", COPIES, seed=[4]), make_env("hopper", COPIES, seed=4)
    assert env.batch_size == (1, COPIES)
    actions, masks = plan(env)
    frames = played(env, actions, masks)
    expected = played(alone, [each[0] for each in actions], [each[0] for each in masks])
    assert_same([frame[0] for frame in frames], expected)


def test_a_seed_for_all_gives_each_group_its_own():
    env = make_env("half_cheetah", COPIES, seed=list(SEEDS))
    env.set_seed(5)
    first = env.reset()["observation"].clone()
    env.set_seed(5)
    assert torch.equal(env.reset()["observation"], first)
    assert not torch.equal(first[0], first[1])


def test_the_same_seed_twice_gives_two_groups_alike():
    start = make_env("half_cheetah", COPIES, seed=[6, 6]).reset()["observation"]
    assert torch.equal(start[0], start[1])


def test_maps_and_their_context_keep_the_groups():
    from nht import SVD

    torch.manual_seed(0)
    map = SVD(7, 2, context_dim=10)
    map.context_keys = ("tool_position", "joint_angle")
    env = mapped_env(EnvConfig(), map, seed=list(SEEDS), num_envs=COPIES)
    assert env.action_spec.shape == (2, COPIES, 2)
    check_env_specs(env)
    stepped = env.rand_step(env.reset())
    assert stepped["next", "actuation"].shape == (2, COPIES, 7)


# Bad input.


@pytest.mark.parametrize(("count", "seeds"), [(4, [0, 1, 2]), (3, []), (2, [0, 1, 2])])
def test_seeds_that_cannot_share_the_copies(count, seeds):
    with pytest.raises(ValueError, match=f"{len(seeds)} seeds cannot share num_envs={count} copies alike"):
        make_task("hopper", num_envs=count, seed=seeds)


def test_no_seeds_at_all():
    with pytest.raises(ValueError, match="0 seeds cannot share num_envs=3 copies alike"):
        make_env("hopper", 3, seed=[])


def test_actions_of_another_shape():
    env = make_env("hopper", COPIES, seed=list(SEEDS))
    env.reset()
    with pytest.raises((ValueError, RuntimeError)):
        env.step(TensorDict({"action": torch.zeros(2, COPIES + 1, 3)}, [2, COPIES + 1]))
