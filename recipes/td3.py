"""TD3 through an action map (Fujimoto et al. 2018).

python -m nht.recipes.td3 env=half_cheetah map=none seed=0
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential

from nht.recipes.agents.cloning import cloning_of
from nht.recipes.agents.off_policy import JointSoftUpdate, descend, exploring
from nht.recipes.agents.replay import minibatches, replay_buffer, storable
from nht.recipes.agents.replayed_demos import replay_demos
from nht.recipes.agents.returns import charge_failure, n_step_returns, reward_range
from nht.recipes.agents.start_from_demos import start_from_demos
from nht.recipes.agents.td3 import TD3, DirectTD3Loss, networks
from nht.recipes.launch import launch
from nht.recipes.run.demonstrations import demonstrated
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.gradient_norms import GradientNorms
from nht.recipes.run.loop import Loop
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.record import Record


def main(config: TD3) -> None:
    """Train, evaluate on the way, and print a summary at the end."""
    algo = config.algo
    ranks = Ranks(config.device, seed=config.seed, threads=config.torch_threads, tf32=config.tf32)
    folder = RunFolder(config, ranks)
    if folder.whole:
        return folder.show()
    envs = RunEnvs(folder.config, folder.map, ranks)
    record = Record(folder, ranks, envs, losses=DirectTD3Loss.reports)

    features, actor, critic = networks(envs.train, algo)
    policy = TensorDictSequential(features, actor)
    shown = demonstrated(folder.configs, folder.maps)
    start_from_demos(shown, features, actor, folder.configs, algo.actor_learning_rate, ranks)

    rewards = reward_range(envs.train)
    cloning = cloning_of(algo.demos, ranks.device)
    loss = DirectTD3Loss(
        actor,
        critic,
        gamma=algo.gamma,
        policy_noise=algo.policy_noise,
        noise_clip=algo.noise_clip,
        reward_range=rewards,
        cloning=cloning,
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

    def rows(steps: TensorDictBase) -> TensorDictBase:
        return storable(look_ahead(charge_failure(steps, algo.gamma, rewards)))

    buffer = replay_buffer(ranks.share("algo.buffer_size", algo.buffer_size), ranks.device)
    demos = replay_demos(shown, algo.demos.share, ranks, buffer, rows)
    batch_size = ranks.share("algo.batch_size", algo.batch_size)
    parts = {"optimiser": optimiser, "features": features, "buffer": buffer}
    record.gradient_norms = GradientNorms(optimiser, "actor", "critic")
    explorer = exploring(policy, envs.train, algo)
    loop = Loop(folder, ranks, envs, record, explorer, loss, random_frames=algo.random_frames, **parts)

    with loop.batches() as batches:
        for data in batches:  # (copies, steps)
            record.count_steps(data)
            features.module.update(data["observation"], ranks.sum)
            buffer.extend(rows(data))
            if cloning is not None:
                cloning.fade(record.frames)

            if record.frames >= algo.warmup_frames:
                for batch in minibatches(
                    buffer, algo.updates_per_batch, batch_size, features, ranks.device, demos=demos
                ):
                    actor_too = (record.counters.updates + 1) % algo.policy_delay == 0
                    losses = loss(batch, actor=actor_too)
                    descend([losses["loss_actor"], losses["loss_qvalue"]], optimiser, ranks)
                    if actor_too:
                        target.step()
                        # 0 in between: its mean over all updates is that over the actor's own.
                        losses["loss_actor"] = algo.policy_delay * losses["loss_actor"].detach()
                    record.count_update(losses)

            if record.evaluation_due:
                record.evaluate(policy)
    loop.finish(policy)


if __name__ == "__main__":
    launch(main, TD3, "td3")
