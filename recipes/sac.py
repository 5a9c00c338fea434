"""SAC through an action map (Haarnoja et al. 2018, with a learned temperature).

python -m nht.recipes.sac env=half_cheetah map=none seed=0
"""

from __future__ import annotations

import torch
from tensordict.nn import TensorDictSequential

from nht.recipes.agents.off_policy import descend, minibatches, replay_buffer, storable
from nht.recipes.agents.sac import SAC, DirectSACLoss, sac_networks
from nht.recipes.evaluation import evaluate
from nht.recipes.launch import launch
from nht.recipes.losses import JointSoftUpdate, charge_failure, n_step_returns, reward_range
from nht.recipes.training import TrainingRun


def main(config: SAC) -> None:
    """Train, evaluate on the way, and say at the end what happened."""
    algo = config.algo
    run = TrainingRun(config, losses=DirectSACLoss.reports)
    features, actor, critic = sac_networks(run.env, algo)
    policy = TensorDictSequential(features, actor)

    rewards = reward_range(run.env)
    action_dim = run.env.action_spec.shape[-1]
    loss = DirectSACLoss(
        actor,
        critic,
        gamma=algo.gamma,
        target_entropy=-action_dim if algo.target_entropy is None else algo.target_entropy,
        initial_temperature=algo.initial_temperature,
    )
    target = JointSoftUpdate(loss, eps=algo.polyak)
    look_ahead = n_step_returns(algo.gamma, algo.n_steps)
    optimiser = torch.optim.Adam(
        [
            {"params": list(loss.actor_network_params.values(True, True)), "lr": algo.actor_learning_rate},
            {"params": list(loss.qvalue_network_params.values(True, True)), "lr": algo.critic_learning_rate},
            {"params": [loss.log_alpha], "lr": algo.temperature_learning_rate},
        ],
        fused=True,
    )
    buffer = replay_buffer(run.ranks.share("algo.buffer_size", algo.buffer_size), run.device)
    batch_size = run.ranks.share("algo.batch_size", algo.batch_size)
    collector = run.collector(policy, random_frames=algo.random_frames)

    with run.training(collector, loss, optimiser=optimiser, features=features, buffer=buffer) as batches:
        for data in batches:
            run.count_steps(data)
            features.module.update(data["observation"], run.ranks.sum)
            buffer.extend(storable(look_ahead(charge_failure(data, algo.gamma, rewards))))

            if run.counters.frames >= algo.warmup_frames:
                for batch in minibatches(buffer, algo.updates_per_batch, batch_size, features, run.device):
                    losses = loss(batch)
                    descend(
                        [losses["loss_actor"], losses["loss_qvalue"], losses["loss_alpha"]],
                        optimiser,
                        run.ranks,
                    )
                    target.step()
                    run.count_update(losses)

            if run.evaluation_due:
                run.log(evaluate(run.tests, policy))
    run.finish(policy)


if __name__ == "__main__":
    launch(main, SAC, "sac")
