"""DDPG through an action map (Lillicrap et al. 2016; the paper's own settings: ``algo=ddpg_paper``).

python -m nht.recipes.ddpg env=wam_wipe map=nht seed=0
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from nht.recipes.agents.ddpg import DDPG, PaperDDPGLoss, networks
from nht.recipes.agents.off_policy import STORED, JointSoftUpdate, exploring
from nht.recipes.agents.returns import charge_failure, n_step_returns, reward_range
from nht.recipes.launch import launch
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.evaluation import evaluate
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.loop import Loop
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.record import Record


def main(config: DDPG) -> None:
    """Train, evaluate on the way, and say at the end what happened."""
    algo = config.algo
    ranks = Ranks(config.device, seed=config.seed, threads=config.torch_threads)
    folder = RunFolder(config, ranks)
    if folder.whole:
        return folder.show()
    envs = RunEnvs(folder.config, folder.map, ranks)
    record = Record(folder, ranks, envs, losses=["loss_actor", "loss_value"])

    features, actor, critic = networks(envs.train, algo)
    policy = TensorDictSequential(features, actor)
    rewards = reward_range(envs.train)
    loss = PaperDDPGLoss(actor, critic, gamma=algo.gamma, action_l2=algo.action_l2, reward_range=rewards)
    target = JointSoftUpdate(loss, eps=algo.polyak)
    look_ahead = n_step_returns(algo.gamma, algo.n_steps)
    optimiser = torch.optim.Adam(
        [
            {"params": list(loss.actor_network_params.values(True, True)), "lr": algo.actor_learning_rate},
            {"params": list(loss.value_network_params.values(True, True)), "lr": algo.critic_learning_rate},
        ],
        fused=True,
    )
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(ranks.share("algo.buffer_size", algo.buffer_size), device=ranks.device),
    )
    batch_size = ranks.share("algo.batch_size", algo.batch_size)
    parts = {"optimiser": optimiser, "features": features, "buffer": buffer}
    explorer = exploring(policy, envs.train, algo)
    loop = Loop(folder, ranks, envs, record, explorer, loss, random_frames=algo.random_frames, **parts)

    with loop.batches() as batches:
        for data in batches:  # (copies, steps)
            record.count_steps(data)
            features.module.update(data["observation"], ranks.sum)
            data = look_ahead(charge_failure(data, algo.gamma, rewards)).reshape(-1)
            buffer.extend(data[data["action"].isfinite().all(-1)].select(*STORED))

            if record.frames >= algo.warmup_frames and algo.updates_per_batch:
                replay = buffer.sample(algo.updates_per_batch * batch_size).to(ranks.device)
                with torch.no_grad():
                    features(replay), features(replay["next"])
                for batch in replay.split(batch_size):
                    record.count_update(descend(batch, loss, optimiser, ranks))
                    if record.counters.updates % algo.target_update_every == 0:
                        target.step()

            if record.evaluation_due:
                record.log(evaluate(envs.test, policy))
    loop.finish(policy)


def descend(
    batch: TensorDictBase,
    loss: PaperDDPGLoss,
    optimiser: torch.optim.Optimizer,
    ranks: Ranks,
) -> TensorDictBase:
    """One gradient step of actor and critic, on the batches ``(B,)`` of all ranks as if they were one; the losses."""
    losses = loss(batch)
    (losses["loss_actor"] + losses["loss_value"]).backward()
    ranks.average_gradients(loss.parameters())
    optimiser.step()
    optimiser.zero_grad()
    return losses


if __name__ == "__main__":
    launch(main, DDPG, "ddpg")
