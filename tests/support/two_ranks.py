"""What tests/test_ranks.py lets torchrun start: updates of either algorithm, each rank on its share of the batches."""

import sys
from pathlib import Path
from types import SimpleNamespace

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import MLP

from nht.recipes import ppo
from nht.recipes.agents.ddpg import PaperDDPGLoss
from nht.recipes.agents.norm import ReturnNorm, RunningNorm
from nht.recipes.agents.off_policy import JointSoftUpdate, descend
from nht.recipes.agents.ppo import GaussianActor, GaussianPPOLoss
from nht.recipes.agents.sac import DirectSACLoss, GaussianHead, tanh_gaussian
from nht.recipes.agents.start_from_demos import start_from_demos
from nht.recipes.agents.td3 import DirectTD3Loss
from nht.recipes.run.ranks import Ranks
from nht.recipes.sections import AlgoDemosConfig

OBSERVATION, ACTION, BATCH, UPDATES = 5, 2, 64, 10


def networks(features):
    torch.manual_seed(0)
    norm = TensorDictModule(RunningNorm(OBSERVATION), ["observation"], ["features"])
    mean = MLP(OBSERVATION, ACTION, num_cells=[16, 16])
    if features == "sac":
        head = GaussianHead(MLP(OBSERVATION, 2 * ACTION, num_cells=[16, 16]))
        return norm, tanh_gaussian(head), relu_critic()
    if features == "td3":
        return norm, TensorDictModule(nn.Sequential(mean, nn.Tanh()), ["features"], ["action"]), relu_critic()
    if features == "ppo":
        actor = TensorDictModule(
            GaussianActor(mean, ACTION, 0.5), ["features"], ["sample", "sample_log_prob", "action"]
        )
        critic = TensorDictModule(MLP(OBSERVATION, 1, num_cells=[16]), ["features"], ["state_value"])
    else:
        actor = TensorDictModule(nn.Sequential(mean, nn.Tanh()), ["features"], ["action"])
        critic = TensorDictModule(
            MLP(OBSERVATION + ACTION, 1, num_cells=[16]), ["features", "action"], ["state_action_value"]
        )
    return norm, actor, critic


def relu_critic():
    critic = MLP(OBSERVATION + ACTION, 1, num_cells=[16], activation_class=nn.ReLU)
    return TensorDictModule(critic, ["features", "action"], ["state_action_value"])


class Draws:
    """Normal noise for the whole batch, wherever it is drawn; a rank takes the part that goes with its share."""

    def __init__(self, ranks):
        self.ranks, self.generator = ranks, torch.Generator().manual_seed(2)

    def __call__(self, like):
        whole = torch.randn(BATCH, *like.shape[1:], generator=self.generator).to(like.device)
        return whole.chunk(self.ranks.size)[self.ranks.rank]


def batches():
    """Steps of all ranks, the same wherever they are drawn."""
    draws = torch.Generator().manual_seed(1)

    def normal(*shape):
        return torch.randn(BATCH, *shape, generator=draws)

    for _ in range(UPDATES):
        yield TensorDict(
            {
                "observation": 3 * normal(OBSERVATION) + 1,
                "action": normal(ACTION).tanh(),
                "sample": normal(ACTION),
                "sample_log_prob": normal(),
                "advantage": 5 * normal(1) + 2,
                "value_target": normal(1),
                "state_value": normal(1),
                "steps_to_next_obs": torch.ones(BATCH, dtype=torch.int64),
                "next": {
                    "observation": 3 * normal(OBSERVATION) + 1,
                    "reward": normal(1),
                    "done": normal(1) > 1,
                    "terminated": normal(1) > 1,
                },
            },
            [BATCH],
        )


def update(algorithm, ranks):
    """Weights and statistics after the updates."""
    norm, actor, critic = (module.to(ranks.device) for module in networks(algorithm))
    rewards = ReturnNorm(BATCH // ranks.size, gamma=0.9).to(ranks.device)
    if algorithm == "ddpg":
        loss = PaperDDPGLoss(actor, critic, gamma=0.9, action_l2=0.1)
    elif algorithm == "td3":
        loss = DirectTD3Loss(actor, critic, gamma=0.9, draw=Draws(ranks))
    elif algorithm == "sac":
        loss = DirectSACLoss(actor, critic, gamma=0.9, target_entropy=-ACTION, draw=Draws(ranks))
    else:
        coefficients = {"clip": 0.2, "clip_value": True, "critic_coeff": 0.5, "entropy_coeff": 0.01}
        loss = GaussianPPOLoss(actor, critic, **coefficients, add=ranks.sum if ranks.size > 1 else None)
    target = None if algorithm == "ppo" else JointSoftUpdate(loss, eps=0.9)
    if ranks.rank:
        with torch.no_grad():  # started apart, they must come together
            for parameter in loss.parameters():
                parameter.add_(1.0)
    ranks.broadcast(loss)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-2)
    for whole in batches():
        batch = whole.chunk(ranks.size)[ranks.rank].to(ranks.device).clone()
        norm.module.update(batch["observation"], ranks.sum)
        rewards(batch.unsqueeze(1), add=ranks.sum)
        norm(batch)
        norm(batch["next"])
        if algorithm == "ppo":
            ppo.descend(batch, loss, optimiser, 0.5, ranks)
        else:
            losses = loss(batch)
            descend([value for name, value in losses.items() if name.startswith("loss")], optimiser, ranks)
        if target is not None:
            target.step()
    return [
        *loss.state_dict().values(),
        *norm.state_dict().values(),
        *rewards.statistics.state_dict().values(),
    ]


def start(ranks):
    """Weights and statistics of an actor that started from demonstrations."""
    norm, actor, _ = (module.to(ranks.device) for module in networks("td3"))
    steps = next(batches()).select("observation", "action").unsqueeze(0).to(ranks.device)
    demos = AlgoDemosConfig(transitions=BATCH, cloning_start=UPDATES)
    config = SimpleNamespace(seed=3, algo=SimpleNamespace(demos=demos))
    start_from_demos(steps, norm, actor, [config], 1e-2, ranks)
    return [*actor.state_dict().values(), *norm.state_dict().values()]


if __name__ == "__main__":
    ranks = Ranks()
    torch.save(start(ranks), Path(sys.argv[1]) / f"start-{ranks.rank}.pt")
    for algorithm in ("ddpg", "ppo", "sac", "td3"):
        torch.save(update(algorithm, ranks), Path(sys.argv[1]) / f"{algorithm}-{ranks.rank}.pt")
    ranks.part()
