"""Without a seed, no two environments are alike; with one, they are to the bit."""

from contextlib import closing
from functools import partial

import pytest
import torch
from torchrl.envs import ParallelEnv

from nht.envs import TASKS, make_dm_control, make_env, make_gymnasium, make_task

FACTORIES = {
    "make_env": partial(make_env, "half_cheetah"),
    "make_gymnasium": partial(make_gymnasium, "HalfCheetah-v5"),
    "ours through Gymnasium": partial(make_gymnasium, "nht/WAMWipe-v0", start="random"),
    "make_dm_control": partial(make_dm_control, "walker-walk"),
}


@pytest.fixture(params=sorted(FACTORIES))
def make(request):
    return FACTORIES[request.param]


def starts(env, count=2):
    with closing(env):
        return torch.stack([env.reset()["observation"] for _ in range(count)])


def test_unseeded_environments_differ(make):
    found = torch.cat([starts(make(num_envs=2)) for _ in range(3)]).flatten(0, 1)
    assert len(torch.unique(found, dim=0)) == len(found)


def test_a_seed_repeats(make):
    one, other, third = (starts(make(num_envs=2, seed=seed)) for seed in (7, 7, 8))
    assert torch.equal(one, other)
    assert not torch.equal(one, third)


def test_a_fresh_seed_leaves_torchs_generator_alone(make):
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    make().close()
    assert torch.equal(torch.rand(3), expected)


@pytest.mark.parametrize("name", sorted(TASKS))
def test_tasks(name):
    one, other, third = (make_task(name, num_envs=2) for _ in range(3))
    assert (one.observe()["observation"] != other.observe()["observation"]).any()
    other.seed(None)
    third.seed(None)
    for task in (other, third):
        task.reset()
    assert (third.observe()["observation"] != other.observe()["observation"]).any()


@pytest.mark.slow
def test_workers_differ(make):
    with closing(ParallelEnv(3, make)) as env:
        for _ in range(2):
            start = env.reset()["observation"].reshape(3, -1)
            assert len(torch.unique(start, dim=0)) == 3
