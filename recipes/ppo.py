"""PPO through an action map (Schulman et al. 2017; ppo2's settings, which the paper ran: ``algo=ppo_paper``).

python -m nht.recipes.ppo env=wam_wipe map=nht seed=0
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.objectives.value import GAE

from nht.recipes.agents.losses import GaussianPPOLoss, charge_failure, estimate_advantages, reward_range
from nht.recipes.agents.networks import ReturnNorm, ppo_networks
from nht.recipes.config import PPO
from nht.recipes.launch import launch
from nht.recipes.run.evaluation import evaluate
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.training import TrainingRun

LEARNED_FROM = ("features", "sample", "sample_log_prob", "state_value", "advantage", "value_target")


def main(config: PPO) -> None:
    """Train, evaluate on the way, and say at the end what happened."""
    algo = config.algo
    run = TrainingRun(config, losses=GaussianPPOLoss.reports)
    features, actor, critic = ppo_networks(run.env, algo)
    policy = TensorDictSequential(features, actor)
    possible = reward_range(run.env)
    rewards = ReturnNorm(run.copies, algo.gamma, algo.reward_clip).to(run.device)

    gae = GAE(gamma=algo.gamma, lmbda=algo.lmbda, value_network=None)
    loss = GaussianPPOLoss(
        actor,
        critic,
        clip=algo.clip,
        clip_value=algo.clip_value,
        critic_coeff=algo.critic_coeff,
        entropy_coeff=algo.entropy_coeff,
        add=run.ranks.sum if run.ranks.size > 1 else None,
    )
    minibatch = run.ranks.share("steps of a minibatch", algo.frames_per_batch // algo.minibatches)
    optimiser = torch.optim.Adam(loss.parameters(), lr=algo.learning_rate, eps=1e-5, fused=True)
    collector = run.collector(policy)

    with run.training(collector, loss, optimiser=optimiser, features=features, rewards=rewards) as batches:
        for data in batches:  # (copies, steps)
            if algo.decay_learning_rate:
                for group in optimiser.param_groups:
                    group["lr"] = algo.learning_rate * (1 - run.counters.frames / algo.total_frames)
            run.count_steps(data)
            charge_failure(data, algo.gamma, possible, steps=run.env.base_env.task.max_episode_steps)
            rewards(data, run.batch_copies, run.ranks.sum)
            estimate_advantages(data, features, critic, gae)
            steps = data.select(*LEARNED_FROM).reshape(-1)

            for _ in range(algo.epochs):
                shuffled = steps[torch.randperm(len(steps), device=steps.device)]
                for batch in shuffled.split(minibatch):
                    run.count_update(descend(batch, loss, optimiser, algo.max_grad_norm, run.ranks))
            features.module.update(
                data["observation"], run.ranks.sum
            )  # seen by the next batch: one normalisation a batch

            if run.evaluation_due:
                run.log(evaluate(run.tests, policy))
    run.finish(policy)


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
