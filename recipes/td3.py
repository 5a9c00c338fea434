"""TD3 through an action map (Fujimoto et al. 2018).

python -m nht.recipes.td3 env=half_cheetah map=none seed=0
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential

from nht.recipes.agents.off_policy import descend, minibatches, replay_buffer, storable
from nht.recipes.agents.td3 import TD3, DirectTD3Loss, td3_networks
from nht.recipes.evaluation import evaluate
from nht.recipes.launch import launch
from nht.recipes.losses import JointSoftUpdate, charge_failure, n_step_returns, reward_range
from nht.recipes.networks import exploring
from nht.recipes.training import TrainingRun


def main(config: TD3) -> None:
    """Train, evaluate on the way, and say at the end what happened."""
    algo = config.algo
    run = TrainingRun(config, losses=DirectTD3Loss.reports)
    features, actor, critic = td3_networks(run.env, algo)
    policy = TensorDictSequential(features, actor)

    rewards = reward_range(run.env)
    loss = DirectTD3Loss(
        actor,
        critic,
        gamma=algo.gamma,
        policy_noise=algo.policy_noise,
        noise_clip=algo.noise_clip,
        reward_range=rewards,
    )
    target = JointSoftUpdate(loss, eps=algo.polyak)
    look_ahead = n_step_returns(algo.gamma, algo.n_steps)
    optimiser = torch.optim.Adam(
        [
            {"params": list(loss.actor_network_params.values(True, True)), "lr": algo.actor_learning_rate},
            {"params": list(loss.qvalue_network_params.values(True, True)), "lr": algo.critic_learning_rate},
        ],
        fused=True,
    )
    buffer = replay_buffer(run.ranks.share("algo.buffer_size", algo.buffer_size), run.device)
    batch_size = run.ranks.share("algo.batch_size", algo.batch_size)
    collector = run.collector(exploring(policy, run.env, algo), random_frames=algo.random_frames)

    with run.training(collector, loss, optimiser=optimiser, features=features, buffer=buffer) as batches:
        for data in batches:
            run.count_steps(data)
            features.module.update(data["observation"], run.ranks.sum)
            buffer.extend(storable(look_ahead(charge_failure(data, algo.gamma, rewards))))

            if run.counters.frames >= algo.warmup_frames:
                for batch in minibatches(buffer, algo.updates_per_batch, batch_size, features, run.device):
                    actor_too = (run.counters.updates + 1) % algo.policy_delay == 0
                    losses = loss(batch, actor=actor_too)
                    descend([losses["loss_actor"], losses["loss_qvalue"]], optimiser, run.ranks)
                    if actor_too:
                        target.step()
                        # 0 in between: its mean over all updates is that over the actor's own.
                        losses["loss_actor"] = algo.policy_delay * losses["loss_actor"].detach()
                    run.count_update(losses)

            if run.evaluation_due:
                run.log(evaluate(run.tests, policy))
    run.finish(policy)


if __name__ == "__main__":
    launch(main, TD3, "td3")
