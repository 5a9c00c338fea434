"""One update of DDPG, TD3 and SAC on HalfCheetah: batch 256, networks of 2 x 256, one thread.

For each algorithm: our loss, the same in bfloat16, and TorchRL's own loss on the same networks; Adam and the move of
the target networks included, the drawing of the batch left out. Contestants take turns; CPU time decides. Prints the
table and writes ``results/update_speed/update_speed.csv``.

    OMP_NUM_THREADS=1 python benchmarks/speed/update_speed.py [rounds]
"""

from __future__ import annotations

import csv
import sys
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import torch
from tensordict import TensorDict
from torchrl.envs import EnvBase
from torchrl.objectives import DDPGLoss, LossModule, SACLoss, TD3Loss, ValueEstimators

from nht.envs import make_env
from nht.recipes.agents.ddpg import DDPGConfig, PaperDDPGLoss
from nht.recipes.agents.ddpg import networks as ddpg_networks
from nht.recipes.agents.off_policy import JointSoftUpdate, descend
from nht.recipes.agents.sac import DirectSACLoss, SACConfig
from nht.recipes.agents.sac import networks as sac_networks
from nht.recipes.agents.td3 import DirectTD3Loss, TD3Config
from nht.recipes.agents.td3 import networks as td3_networks
from nht.recipes.run.ranks import Ranks

BATCH, GAMMA, UPDATES = 256, 0.99, 50
FREE = (-float("inf"), float("inf"))


def ddpg_loss(env: EnvBase, direct: bool, bfloat16: bool) -> LossModule:
    _, actor, critic = ddpg_networks(env, DDPGConfig(bfloat16=bfloat16))
    if direct:
        return PaperDDPGLoss(actor, critic, gamma=GAMMA, action_l2=0.0, reward_range=FREE)
    return DDPGLoss(actor, critic, delay_actor=True, delay_value=True)


def td3_loss(env: EnvBase, direct: bool, bfloat16: bool) -> LossModule:
    _, actor, critic = td3_networks(env, TD3Config(bfloat16=bfloat16))
    if direct:
        return DirectTD3Loss(actor, critic, gamma=GAMMA)
    return TD3Loss(actor, critic, bounds=(-1.0, 1.0), loss_function="l2")


def sac_loss(env: EnvBase, direct: bool, bfloat16: bool) -> LossModule:
    _, actor, critic = sac_networks(env, SACConfig(bfloat16=bfloat16))
    if direct:
        return DirectSACLoss(actor, critic, gamma=GAMMA, target_entropy=-6.0)
    return SACLoss(actor, critic, loss_function="l2", target_entropy=-6.0)


LOSSES = {"ddpg": ddpg_loss, "td3": td3_loss, "sac": sac_loss}


def updates(algorithm: str, direct: bool, bfloat16: bool) -> Callable[[], None]:
    """``UPDATES`` updates; of TD3 every second one is of the actor, too."""
    env = make_env("half_cheetah")
    loss = LOSSES[algorithm](env, direct, bfloat16)
    if not direct:
        loss.make_value_estimator(ValueEstimators.TD0, gamma=GAMMA)
    target = JointSoftUpdate(loss, eps=0.995)
    optimiser = torch.optim.Adam(loss.parameters(), lr=3e-4, fused=True)
    ranks = Ranks()
    flag = torch.zeros(BATCH, 1, dtype=torch.bool)
    outcome = {"features": torch.randn(BATCH, 17), "reward": torch.randn(BATCH, 1)}
    outcome |= {"terminated": flag, "done": flag.clone()}
    columns = {"features": torch.randn(BATCH, 17), "action": torch.rand(BATCH, 6) - 0.5}
    steps = torch.ones(BATCH, dtype=torch.long)
    batch = TensorDict({**columns, "steps_to_next_obs": steps, "next": outcome}, [BATCH])

    def run() -> None:
        for update in range(UPDATES):
            moves = algorithm != "td3" or update % 2 == 1
            if algorithm == "td3" and not direct:
                losses = {"loss_qvalue": loss.value_loss(batch)[0]}
                losses |= {"loss_actor": loss.actor_loss(batch)[0]} if moves else {}
            else:
                losses = loss(batch, actor=moves) if algorithm == "td3" else loss(batch)
            descend([value for name, value in losses.items() if name.startswith("loss")], optimiser, ranks)
            if moves:
                target.step()

    return run


def main(rounds: int) -> None:
    """All contestants in turn, round after round."""
    torch.set_num_threads(1)
    ways = {"direct": (True, False), "bfloat16": (True, True), "torchrl": (False, False)}
    contestants = {(name, way): updates(name, *ways[way]) for name in LOSSES for way in ways}
    measured: dict[tuple[str, str], list[float]] = {key: [] for key in contestants}
    for _ in range(rounds + 1):  # the first one warms up
        for key, run in contestants.items():
            start = time.process_time()
            run()
            measured[key].append(1e3 * (time.process_time() - start) / UPDATES)
    with Path(__file__).parents[1] / "results".joinpath("update_speed.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["algorithm", "loss", "median_cpu_ms", "least_cpu_ms", "most_cpu_ms", "rounds"])
        for (name, way), values in measured.items():
            row = [f"{value:.3f}" for value in (median(values[1:]), min(values[1:]), max(values[1:]))]
            writer.writerow([name, way, *row, rounds])
            print(f"{name:5s} {way:9s} {row[0]} ms of CPU ({row[1]} .. {row[2]})")


if __name__ == "__main__":
    main(int([*sys.argv, "5"][1]))
