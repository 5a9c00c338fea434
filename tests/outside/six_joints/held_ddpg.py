"""An algorithm of one's own: DDPG that explores by actions held for a while.

python -m six_joints.held_ddpg env=six_reach map=two_sided
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from tensordict.nn import TensorDictSequential

from nht.recipes.agents.ddpg import DDPGConfig, PaperDDPGLoss, networks, policy
from nht.recipes.agents.off_policy import JointSoftUpdate, descend, exploring
from nht.recipes.agents.replay import minibatches, replay_buffer, storable
from nht.recipes.agents.returns import n_step_returns
from nht.recipes.agents.table import Algorithm
from nht.recipes.launch import launch
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.loop import Loop
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.record import Record
from nht.recipes.sections import Training


@dataclass
class HeldDDPGConfig(DDPGConfig):
    """DDPG's settings, with noise that lasts."""

    noise_memory: float = 30.0
    learning_rate: float = 1e-3  # of both networks


@dataclass
class HeldDDPG(Training):
    """``python -m six_joints.held_ddpg``."""

    algo: HeldDDPGConfig = field(default_factory=HeldDDPGConfig)


def main(config: HeldDDPG) -> None:
    """Train, evaluate on the way, and say at the end what happened."""
    algo = config.algo
    ranks = Ranks(config.device, seed=config.seed, threads=config.torch_threads)
    folder = RunFolder(config, ranks)
    if folder.whole:
        return folder.show()
    envs = RunEnvs(folder.config, folder.map, ranks)
    record = Record(folder, ranks, envs, losses=["loss_value"])
    features, actor, critic = networks(envs.train, algo)
    acting = TensorDictSequential(features, actor)
    loss = PaperDDPGLoss(actor, critic, gamma=algo.gamma, action_l2=algo.action_l2)
    target = JointSoftUpdate(loss, eps=algo.polyak)
    optimiser = torch.optim.Adam(loss.parameters(), lr=algo.learning_rate)
    buffer = replay_buffer(algo.buffer_size, ranks.device)
    loop = Loop(
        folder,
        ranks,
        envs,
        record,
        exploring(acting, envs.train, algo),
        loss,
        optimiser=optimiser,
        features=features,
        buffer=buffer,
    )
    look_ahead = n_step_returns(algo.gamma, algo.n_steps)
    with loop.batches() as batches:
        for data in batches:
            record.count_steps(data)
            features.module.update(data["observation"])
            buffer.extend(storable(look_ahead(data)))
            for batch in minibatches(buffer, algo.updates_per_batch, algo.batch_size, features, ranks.device):
                losses = loss(batch)
                descend([losses["loss_actor"], losses["loss_value"]], optimiser, ranks)
                target.step()
                record.count_update(losses)
            if record.evaluation_due:
                record.evaluate(acting)
    loop.finish(acting)


ALGORITHM = Algorithm(main="six_joints.held_ddpg:main", schema=HeldDDPG, policy=policy)

if __name__ == "__main__":
    launch(main, HeldDDPG, "held_ddpg")
