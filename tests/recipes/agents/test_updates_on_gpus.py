"""An update asks for no tensor's values: on a GPU that would make the host wait, some twenty times a batch."""

import copy

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.objectives.value import GAE

import tiny_runs
import two_ranks
from nht.envs import make_env
from nht.recipes import ppo
from nht.recipes.agents.adam import LearnersAdam
from nht.recipes.agents.ddpg import PaperDDPGLoss
from nht.recipes.agents.norm import ReturnNorm, RunningNorm
from nht.recipes.agents.off_policy import JointSoftUpdate, descend
from nht.recipes.agents.ppo import GaussianPPOLoss, estimate_advantages
from nht.recipes.agents.returns import charge_failure, n_step_returns
from nht.recipes.agents.sac import DirectSACLoss
from nht.recipes.agents.td3 import DirectTD3Loss
from nht.recipes.run.graphs import graphed
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.statistics import TrainingStatistics
from no_sync import Waits

RANGE = (-1.0, 1.0)
COPIES, STEPS, SIZE = 3, 6, 5


def make_loss(algorithm):
    norm, actor, critic = two_ranks.networks(algorithm)
    if algorithm == "ddpg":
        loss = PaperDDPGLoss(actor, critic, gamma=0.9, action_l2=0.1, reward_range=RANGE)
    elif algorithm == "td3":
        loss = DirectTD3Loss(actor, critic, gamma=0.9, reward_range=RANGE)
    elif algorithm == "sac":
        loss = DirectSACLoss(actor, critic, gamma=0.9, target_entropy=-2.0)
    else:
        loss = GaussianPPOLoss(actor, critic, clip=0.2, clip_value=True, critic_coeff=0.5, entropy_coeff=0.01)
    return norm, loss


def prepared(norm):
    """A batch that the normaliser has seen."""
    batch = next(two_ranks.batches())
    norm.module.update(batch["observation"])
    norm(batch), norm(batch["next"])
    return batch


@pytest.mark.parametrize("algorithm", tiny_runs.RECIPES)
def test_an_update_makes_nobody_wait(algorithm):
    norm, loss = make_loss(algorithm)
    target = None if algorithm == "ppo" else JointSoftUpdate(loss, eps=0.9)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-2, fused=True)
    batch, ranks = prepared(norm), Ranks()
    before = copy.deepcopy(loss.state_dict())

    def update():
        if algorithm == "ppo":
            return ppo.descend(batch, loss, optimiser, 0.5, ranks)
        losses = loss(batch)
        descend([value for name, value in losses.items() if name.startswith("loss")], optimiser, ranks)
        target.step()
        return losses

    losses = update()  # what is made once is made
    statistics = TrainingStatistics(make_env("wam_wipe").action_spec.space, list(losses.keys()))
    with Waits() as waits:
        statistics.add_losses(update())
    assert waits.found == []
    assert any(not torch.equal(value, before[name]) for name, value in loss.state_dict().items())


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("algorithm", tiny_runs.RECIPES)
def test_updates_on_a_gpu_are_those_on_the_cpu(algorithm):
    on_gpu, on_cpu = (two_ranks.update(algorithm, Ranks(device)) for device in ("cuda", "cpu"))
    for found, expected in zip(on_gpu, on_cpu, strict=True):
        torch.testing.assert_close(found.cpu(), expected, rtol=1e-3, atol=1e-4)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_an_update_played_from_a_graph_is_the_update():
    def weights(decorate):
        ranks = Ranks("cuda")
        _, actor, critic = (module.to("cuda") for module in two_ranks.networks("ddpg"))
        loss = PaperDDPGLoss(actor, critic, gamma=0.9, action_l2=0.1)
        groups = [(loss.actor_network_params.values(True, True), 1e-3)]
        optimiser = LearnersAdam([*groups, (loss.value_network_params.values(True, True), 1e-2)])

        @decorate(ranks)
        def update(batch):
            losses = loss(batch)
            descend([losses["loss_actor"], losses["loss_value"]], optimiser, ranks)
            return losses.detach()

        for whole in two_ranks.batches():
            batch = whole.to("cuda")
            batch["features"], batch["next", "features"] = batch["observation"], batch["next", "observation"]
            update(batch)
        return loss.state_dict()

    graphed_weights, expected = weights(graphed), weights(lambda ranks: lambda update: update)
    for name, value in expected.items():
        torch.testing.assert_close(graphed_weights[name], value, rtol=1e-4, atol=1e-5)


def test_on_a_cpu_an_update_stays_as_it_is():
    def update(batch):
        return batch

    assert graphed(Ranks())(update) is update


@pytest.mark.parametrize("algorithm", ["ddpg", "ppo"])  # TorchRL's others cannot be made there
def test_a_loss_is_computed_on_a_device_that_has_no_values(algorithm):
    norm, loss = make_loss(algorithm)
    batch = prepared(norm)
    on_cpu = loss(batch)
    if algorithm == "ppo":
        loss = loss.to("meta")
    else:
        with torch.device("meta"):
            _, loss = make_loss(algorithm)
    batch = batch.to("meta")
    found = loss(batch)
    assert {value.device.type for value in found.values()} == {"meta"}
    assert {name: value.shape for name, value in found.items()} == {
        name: value.shape for name, value in on_cpu.items()
    }


def collected(device="cpu"):
    """Steps ``(copies, steps)``, as a collector gives them."""
    shape = (COPIES, STEPS)

    def flag():
        return torch.zeros(*shape, 1, dtype=torch.bool, device=device)

    outcome = {name: flag() for name in ("done", "terminated", "truncated", "success", "failure", "diverged")}
    outcome |= {
        "observation": torch.rand(*shape, SIZE, device=device),
        "reward": torch.rand(*shape, 1, device=device),
        "actuation": torch.rand(*shape, 7, device=device),
    }
    data = {
        "observation": torch.rand(*shape, SIZE, device=device),
        "action": torch.rand(*shape, 2, device=device),
    }
    return TensorDict(data | {"next": outcome}, shape)


def batch_work(device):
    """What recipes do with a batch before its updates, each by name."""
    norm = TensorDictModule(RunningNorm(SIZE).to(device), ["observation"], ["features"])
    critic = TensorDictModule(nn.Linear(SIZE, 1, device=device), ["features"], ["state_value"])
    rewards, gae = ReturnNorm(COPIES, 0.9).to(device), GAE(gamma=0.9, lmbda=0.9, value_network=None)
    look_ahead = n_step_returns(0.9, 3)

    def advantages(data):
        estimate_advantages(norm(data), norm, critic, gae)

    return {
        "running norm": lambda data: norm.module.update(data["observation"]),
        "return norm": rewards,
        "charge failure": lambda data: charge_failure(data, 0.9, RANGE),
        "advantages": advantages,
        "n steps": look_ahead,
    }


@pytest.mark.parametrize("work", batch_work("cpu"))
def test_work_on_a_batch_makes_nobody_wait(work):
    run = batch_work("cpu")[work]
    run(collected())
    with Waits() as waits:
        run(collected())
    assert len(waits.found) == (1 if work == "n steps" else 0)  # TorchRL's MultiStep asks for the longest


@pytest.mark.parametrize("work", batch_work("cpu").keys() - {"n steps"})
def test_work_on_a_batch_is_done_on_a_device_that_has_no_values(work):
    batch_work("meta")[work](collected("meta"))


def test_counting_steps_makes_nobody_wait():
    statistics = TrainingStatistics(make_env("wam_wipe").action_spec.space)
    with Waits() as waits:
        statistics.add_steps(collected().reshape(-1))
    assert waits.found == []
    assert statistics.state_dict()["counts"]["episodes"] == 0
    (row,) = statistics.take()
    assert row["clipped"] == 0.0
