"""PPO through an action map (Schulman et al. 2017; ppo2's settings, which the paper ran: ``algo=ppo_paper``).

python -m nht.recipes.ppo env=wam_wipe map=nht seed=0
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.objectives.value import GAE

from nht.recipes.config import PPO
from nht.recipes.evaluation import evaluate
from nht.recipes.launch import launch
from nht.recipes.losses import GaussianPPOLoss, charge_failure, estimate_advantages, reward_range
from nht.recipes.networks import ReturnNorm, ppo_networks
from nht.recipes.training import TrainingRun

LEARNED_FROM = ("features", "sample", "sample_log_prob", "state_value", "advantage", "value_target")


def main(config: PPO) -> None:
    """Train, evaluate on the way, and say at the end what happened."""
    algo = config.algo
    run = TrainingRun(config, losses=GaussianPPOLoss.reports)
    features, actor, critic = ppo_networks(run.env, algo)
    policy = TensorDictSequential(features, actor)
    possible = reward_range(run.env)
    rewards = ReturnNorm(config.env.num_envs, algo.gamma, algo.reward_clip).to(config.device)

    gae = GAE(gamma=algo.gamma, lmbda=algo.lmbda, value_network=None)
    loss = GaussianPPOLoss(
        actor,
        critic,
        clip=algo.clip,
        clip_value=algo.clip_value,
        critic_coeff=algo.critic_coeff,
        entropy_coeff=algo.entropy_coeff,
    )
    parameters = list(loss.parameters())
    optimiser = torch.optim.Adam(parameters, lr=algo.learning_rate, eps=1e-5, fused=True)
    collector = Collector(
        run.env,
        policy,
        frames_per_batch=algo.frames_per_batch,
        total_frames=-1,
        track_traj_ids=False,
        device=config.device,  # said aloud, it saves a cast in every step
        auto_register_policy_transforms=False,
    )
    run.start(collector, loss=loss, optimiser=optimiser, features=features, rewards=rewards)

    for data in collector:  # (copies, steps)
        if algo.decay_learning_rate:
            for group in optimiser.param_groups:
                group["lr"] = algo.learning_rate * (1 - run.counters.frames / algo.total_frames)
        run.count_steps(data)
        rewards(charge_failure(data, algo.gamma, possible, steps=run.env.base_env.task.max_episode_steps))
        estimate_advantages(data, features, critic, gae)
        steps = data.select(*LEARNED_FROM).reshape(-1)

        for _ in range(algo.epochs):
            shuffled = steps[torch.randperm(len(steps), device=steps.device)]
            for batch in shuffled.split(len(steps) // algo.minibatches):
                losses = loss(batch)
                losses["loss"].backward()
                nn.utils.clip_grad_norm_(parameters, algo.max_grad_norm)
                optimiser.step()
                optimiser.zero_grad()
                run.count_update(losses)
        features.module.update(data["observation"])  # seen by the next batch: one batch, one normalisation

        if run.evaluation_due:
            run.log(evaluate(run.tests, policy))
        run.save_if_due()
        if run.finished:
            break
    run.finish(policy)


if __name__ == "__main__":
    launch(main, PPO, "ppo")
