"""PPO through an action map (Schulman et al. 2017; ppo2's settings, which the paper ran: ``algo=ppo_paper``).

python -m nht.recipes.ppo env=wam_wipe map=nht seed=0
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.objectives.value import GAE

from nht.recipes.agents.norm import ReturnNorm
from nht.recipes.agents.ppo import PPO, GaussianPPOLoss, estimate_advantages, networks
from nht.recipes.agents.returns import charge_failure, reward_range
from nht.recipes.launch import launch
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.evaluation import evaluate
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.loop import Loop
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.record import Record

LEARNED_FROM = ("features", "sample", "sample_log_prob", "state_value", "advantage", "value_target")


def main(config: PPO) -> None:
    """Train, evaluate on the way, and say at the end what happened."""
    algo = config.algo
    ranks = Ranks(config.device, seed=config.seed, threads=config.torch_threads)
    folder = RunFolder(config, ranks)
    if folder.whole:
        return folder.show()
    envs = RunEnvs(folder.config, folder.map, ranks)
    record = Record(folder, ranks, envs, losses=GaussianPPOLoss.reports)

    features, actor, critic = networks(envs.train, algo)
    policy = TensorDictSequential(features, actor)
    possible = reward_range(envs.train)
    rewards = ReturnNorm(envs.copies, algo.gamma, algo.reward_clip).to(ranks.device)
    gae = GAE(gamma=algo.gamma, lmbda=algo.lmbda, value_network=None)
    loss = GaussianPPOLoss(
        actor,
        critic,
        clip=algo.clip,
        clip_value=algo.clip_value,
        critic_coeff=algo.critic_coeff,
        entropy_coeff=algo.entropy_coeff,
        add=ranks.sum if ranks.size > 1 else None,
    )
    minibatch = ranks.share("steps of a minibatch", algo.frames_per_batch // algo.minibatches)
    optimiser = torch.optim.Adam(loss.parameters(), lr=algo.learning_rate, eps=1e-5, fused=True)
    parts = {"optimiser": optimiser, "features": features, "rewards": rewards}
    loop = Loop(folder, ranks, envs, record, policy, loss, **parts)

    with loop.batches() as batches:
        for data in batches:  # (copies, steps)
            if algo.decay_learning_rate:
                for group in optimiser.param_groups:
                    group["lr"] = algo.learning_rate * (1 - record.frames / algo.total_frames)
            record.count_steps(data)
            charge_failure(data, algo.gamma, possible, steps=envs.train.base_env.task.max_episode_steps)
            rewards(data, loop.batch_copies, ranks.sum)
            estimate_advantages(data, features, critic, gae)
            steps = data.select(*LEARNED_FROM).reshape(-1)

            for _ in range(algo.epochs):
                shuffled = steps[torch.randperm(len(steps), device=steps.device)]
                for batch in shuffled.split(minibatch):
                    record.count_update(descend(batch, loss, optimiser, algo.max_grad_norm, ranks))
            # Seen by the next batch: one normalisation a batch.
            features.module.update(data["observation"], ranks.sum)

            if record.evaluation_due:
                record.log(evaluate(envs.test, policy))
    loop.finish(policy)


def descend(
    batch: TensorDictBase,
    loss: GaussianPPOLoss,
    optimiser: torch.optim.Optimizer,
    max_grad_norm: float,
    ranks: Ranks,
) -> TensorDictBase:
    """One gradient step, on the minibatches ``(B,)`` of all ranks as if they were one; the losses."""
    losses = loss(batch)
    losses["loss"].backward()
    parameters = optimiser.param_groups[0]["params"]
    ranks.average_gradients(parameters)
    nn.utils.clip_grad_norm_(parameters, max_grad_norm)
    optimiser.step()
    optimiser.zero_grad()
    return losses


if __name__ == "__main__":
    launch(main, PPO, "ppo")
