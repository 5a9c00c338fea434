"""DDPG through an action map (Lillicrap et al. 2016; the paper's own settings: ``algo=ddpg_paper``).

python -m nht.recipes.ddpg env=wam_wipe map=nht seed=0
python -m nht.recipes.ddpg env=wam_wipe map=nht seeds=16
"""

from __future__ import annotations

from functools import partial

from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential

from nht.recipes.agents.adam import LearnersAdam
from nht.recipes.agents.cloning import cloning_of
from nht.recipes.agents.ddpg import DDPG, PaperDDPGLoss, networks
from nht.recipes.agents.off_policy import JointSoftUpdate, descend, exploring
from nht.recipes.agents.replay import minibatches, replay_buffer, storable
from nht.recipes.agents.replayed_demos import replay_demos
from nht.recipes.agents.returns import charge_failure, n_step_returns, reward_range
from nht.recipes.agents.start_from_demos import start_from_demos
from nht.recipes.launch import launch
from nht.recipes.run.demonstrations import demonstrated
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.gradient_norms import GradientNorms
from nht.recipes.run.graphs import graphed
from nht.recipes.run.learners import Learners
from nht.recipes.run.loop import Loop
from nht.recipes.run.population import open_run
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.record import Record


def main(*configs: DDPG, together: str | None = None) -> None:
    """Train one learner, or several of one shape together; evaluate on the way, and print a summary at the end."""
    first = configs[0]
    ranks = Ranks(first.device, seed=first.seed, threads=first.torch_threads, tf32=first.tf32)
    folder = open_run(configs, ranks, together)
    if folder.whole:
        return folder.show()
    learners = Learners(folder.configs, ranks.device)
    algo = learners.algo
    envs = RunEnvs(folder.configs, folder.maps, ranks)
    record = Record(folder, ranks, envs, losses=["loss_actor", "loss_value"])

    features, actor, critic = learners.networks(partial(networks, envs.train))
    policy = TensorDictSequential(features, actor)
    shown = demonstrated(folder.configs, folder.maps)
    start_from_demos(shown, features, actor, folder.configs, algo.actor_learning_rate, ranks)
    rewards = reward_range(envs.train)
    cloning = cloning_of(algo.demos, ranks.device)
    loss = PaperDDPGLoss(
        actor,
        critic,
        gamma=algo.gamma,
        action_l2=algo.action_l2,
        reward_range=rewards,
        cloning=cloning,
        dropped=algo.dropped_quantiles,
    )
    target = JointSoftUpdate(loss, eps=algo.polyak)
    look_ahead = n_step_returns(algo.gamma, algo.n_steps)
    optimiser = LearnersAdam(
        [
            (loss.actor_network_params.values(True, True), algo.actor_learning_rate),
            (loss.value_network_params.values(True, True), algo.critic_learning_rate),
        ]
    )

    def rows(steps: TensorDictBase) -> TensorDictBase:
        return storable(look_ahead(charge_failure(steps, algo.gamma, rewards)))

    buffer = replay_buffer(ranks.share("algo.buffer_size", algo.buffer_size), ranks.device)
    demos = replay_demos(shown, algo.demos.share, ranks, buffer, rows)

    @graphed(ranks)
    def update(batch: TensorDictBase) -> TensorDictBase:
        losses = loss(batch)
        descend([losses["loss_actor"], losses["loss_value"]], optimiser, ranks)
        return losses.detach()

    batch_size = learners.each(ranks.share("algo.batch_size", algo.batch_size))
    parts = {"optimiser": optimiser, "features": features, "buffer": buffer}
    record.gradient_norms = GradientNorms(optimiser, "actor", "critic", learners=learners.count)
    explorer = exploring(policy, envs.train, algo)
    loop = Loop(
        folder,
        ranks,
        envs,
        record,
        explorer,
        loss,
        learners=learners,
        random_frames=algo.random_frames,
        **parts,
    )

    with loop.batches() as batches:
        for data in batches:  # (copies, steps), or (learners, copies, steps)
            record.count_steps(data)
            features.module.update(data["observation"], ranks.sum)
            buffer.extend(rows(data))
            if cloning is not None:
                cloning.fade(record.frames)

            if record.frames >= algo.warmup_frames:
                for batch in minibatches(
                    buffer, algo.updates_per_batch, batch_size, features, ranks.device, learners.draws, demos
                ):
                    record.count_update(update(batch))
                    if record.counters.updates % algo.target_update_every == 0:
                        target.step()

            if record.evaluation_due:
                record.evaluate(policy)
    loop.finish(policy)


if __name__ == "__main__":
    launch(main, DDPG, "ddpg")
