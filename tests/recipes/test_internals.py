"""Contracts with private parts of other libraries: what breaks in an upgrade is named here."""

import inspect
import signal
from functools import partial

import pytest
import torch
from hydra import initialize_config_module
from torchrl.collectors import Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.objectives import SoftUpdate

from nht.envs import make_env
from nht.recipes.agents.ddpg import DDPGConfig, PaperDDPGLoss, networks
from nht.recipes.config import DDPG
from nht.recipes.hydra_internals import choices
from nht.recipes.launch import configure
from nht.recipes.torch_internals import layout_versions, lerp_all, set_layout_versions
from nht.recipes.torchrl_internals import (
    carrier,
    count_frames_from,
    counted_frames,
    ended_workers,
    followed_pairs,
    kill_workers,
)


def test_torchrl_counts_a_collectors_frames_in__frames_and_starts_from__carrier():
    env = make_env("half_cheetah", 2, seed=0)
    collector = Collector(env, None, frames_per_batch=10, total_frames=-1)
    batches = iter(collector)
    data = next(batches)
    assert counted_frames(collector) == 10
    assert torch.equal(carrier(collector)["observation"], data["next", "observation"][:, -1])
    count_frames_from(collector, 50)
    next(batches)
    assert counted_frames(collector) == 60
    collector.shutdown()


def test_torchrl_gives_a_workers_number_first_in__get_from_queue():
    source = inspect.getsource(MultiAsyncCollector._get_from_queue)
    assert "return idx, j, out" in source


@pytest.mark.slow
def test_torchrl_keeps_a_collectors_workers_in_procs():
    env = partial(make_env, "half_cheetah", 1, seed=0)
    collector = MultiSyncCollector([env, env], None, frames_per_batch=20, total_frames=-1, cat_results=0)
    assert ended_workers(collector) == {}
    collector.procs[1].kill()
    collector.procs[1].join()
    assert ended_workers(collector) == {1: -signal.SIGKILL}
    kill_workers(collector)
    collector.procs[0].join()
    assert ended_workers(collector) == {0: -signal.SIGKILL, 1: -signal.SIGKILL}
    collector.procs[0].close()
    assert ended_workers(collector) == {1: -signal.SIGKILL}
    kill_workers(collector)
    collector.procs[1].close()
    collector.shutdown()


def test_torchrl_keeps_what_targets_follow_in__sources_and__targets():
    env = make_env("half_cheetah", 1, seed=0)
    _, actor, critic = networks(env, DDPGConfig(hidden=[4]))
    loss = PaperDDPGLoss(actor, critic, gamma=0.9, action_l2=0.0)
    pairs = list(followed_pairs(SoftUpdate(loss, eps=0.9)))
    assert len(pairs) == 8  # weights and biases of two layers, of actor and critic
    learned = {parameter.data_ptr() for parameter in (*actor.parameters(), *critic.parameters())}
    assert {source.data_ptr() for source, _ in pairs} == learned
    assert all(target.data_ptr() not in learned for _, target in pairs)


def test_torch_moves_many_tensors_with__foreach_lerp_():
    values, ends = [torch.zeros(2), torch.ones(3)], [torch.ones(2), torch.zeros(3)]
    lerp_all(values, ends, 0.25)
    assert values[0].tolist() == [0.25, 0.25]
    assert values[1].tolist() == [0.75, 0.75, 0.75]


def test_hydra_lists_the_files_of_a_group():
    with initialize_config_module("nht.configs", version_base="1.3"):
        assert {"ddpg", "ppo", "sac", "td3"} <= set(choices(""))
        assert {"nht", "svd", "none"} <= set(choices("map"))


def test_hydra_says_where_it_found_nothing_and_lists_choices():
    with pytest.raises(ValueError, match=r"Could not override 'algo\.gama'.*Keys here: \[.*'gamma'"):
        configure(DDPG, "ddpg", ["algo.gama=0.9"])
    with pytest.raises(ValueError, match=r"Could not find 'algo/none'.*ddpg_paper"):
        configure(DDPG, "ddpg", ["algo=none"])


def test_torch_keeps_layout_versions_in__metadata_and_looks_at_them_when_it_loads():
    class Versioned(torch.nn.Linear):
        _version = 7

        def _load_from_state_dict(self, state, prefix, local_metadata, *args):
            self.seen = local_metadata.get("version")
            super()._load_from_state_dict(state, prefix, local_metadata, *args)

    network = Versioned(1, 1)
    state = network.state_dict()
    versions = layout_versions(state)
    assert versions[""] == {"version": 7}
    again = type(state)(state)
    assert layout_versions(again) is None
    set_layout_versions(again, versions)
    network.load_state_dict(again)
    assert network.seen == 7
