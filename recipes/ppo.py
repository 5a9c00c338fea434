"""PPO through an action map (Schulman et al. 2017; ppo2's settings, which the paper ran: ``algo=ppo_paper``).

python -m nht.recipes.ppo env=wam_wipe map=nht seed=0
python -m nht.recipes.ppo env=wam_wipe map=nht seeds=16
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential

from nht.recipes.agents.adam import LearnersAdam, clip_gradients
from nht.recipes.agents.norm import ReturnNorm
from nht.recipes.agents.ppo import PPO, GaussianPPOLoss, advantage_estimator, estimate_advantages, networks
from nht.recipes.agents.returns import charge_failure, reward_range
from nht.recipes.agents.settings import Setting
from nht.recipes.agents.start_from_demos import start_from_demos
from nht.recipes.launch import launch
from nht.recipes.run.demonstrations import demonstrated
from nht.recipes.run.draws import Draws
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.gradient_norms import GradientNorms
from nht.recipes.run.learners import Learners
from nht.recipes.run.loop import Loop
from nht.recipes.run.population import open_run
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.record import Record

LEARNED_FROM = ("features", "sample", "sample_log_prob", "state_value", "advantage", "value_target")


def main(*configs: PPO, together: str | None = None) -> None:
    """Train one learner, or several of one shape together; evaluate on the way, and print a summary at the end."""
    first = configs[0]
    ranks = Ranks(first.device, seed=first.seed, threads=first.torch_threads, tf32=first.tf32)
    folder = open_run(configs, ranks, together)
    if folder.whole:
        return folder.show()
    learners = Learners(folder.configs, ranks.device)
    algo = learners.algo
    envs = RunEnvs(folder.configs, folder.maps, ranks)
    record = Record(folder, ranks, envs, losses=GaussianPPOLoss.reports)

    features, actor, critic = learners.networks(partial(networks, envs.train))
    policy = TensorDictSequential(features, actor)
    shown = demonstrated(folder.configs, folder.maps)
    start_from_demos(shown, features, actor, folder.configs, algo.learning_rate, ranks)
    possible = reward_range(envs.train)
    rewards = ReturnNorm(envs.copies, algo.gamma, algo.reward_clip, learners=learners.count).to(ranks.device)
    gae = advantage_estimator(algo.gamma, algo.lmbda)
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
    optimiser = LearnersAdam([(loss.parameters(), algo.learning_rate)], eps=1e-5)
    record.gradient_norms = GradientNorms(optimiser, learners=learners.count)
    parts = {"optimiser": optimiser, "features": features, "rewards": rewards}
    loop = Loop(folder, ranks, envs, record, policy, loss, learners=learners, **parts)

    with loop.batches() as batches:
        for data in batches:  # (copies, steps), or (learners, copies, steps)
            if algo.decay_learning_rate:
                optimiser.decay(1 - record.frames / algo.total_frames)
            record.count_steps(data)
            charge_failure(data, algo.gamma, possible, steps=envs.train.base_env.task.max_episode_steps)
            rewards(data, loop.batch_copies, ranks.sum)
            estimate_advantages(data, features, critic, gae)

            for _ in range(algo.epochs):
                for batch in shuffled(data.select(*LEARNED_FROM), minibatch, learners.draws):
                    record.count_update(descend(batch, loss, optimiser, algo.max_grad_norm, ranks))
            # Seen by the next batch: one normalisation a batch.
            features.module.update(data["observation"], ranks.sum)

            if record.evaluation_due:
                record.evaluate(policy)
    loop.finish(policy)


def shuffled(data: TensorDictBase, size: int, draws: Draws | None) -> Iterator[TensorDictBase]:
    """All steps ``(copies, T)`` in minibatches ``(size,)``; of learners, ``(L, size)``, each in its own order."""
    if draws is None:
        steps = data.reshape(-1)
        yield from steps[torch.randperm(len(steps), device=steps.device)].split(size)
        return
    steps = data.flatten(1, 2)
    learners, count = steps.shape
    first = torch.arange(learners, device=steps.device).unsqueeze(-1) * count
    order = (first + draws.orders(count)).flatten()
    yield from steps.reshape(-1)[order].view(learners, count).split(size, dim=1)


def descend(
    batch: TensorDictBase,
    loss: GaussianPPOLoss,
    optimiser: LearnersAdam,
    max_grad_norm: Setting,
    ranks: Ranks,
) -> TensorDictBase:
    """One gradient step on the minibatches ``(B,)`` of all ranks as if they were one; returns the losses."""
    losses = loss(batch)
    losses["loss"].sum().backward()
    ranks.average_gradients(loss.parameters())
    clip_gradients(list(loss.parameters()), max_grad_norm, None if batch.ndim == 1 else len(batch))
    optimiser.step()
    optimiser.zero_grad()
    return losses


if __name__ == "__main__":
    launch(main, PPO, "ppo")
