"""How long a checkpoint stops training: that of DDPG on WAMWipe with a full buffer of 1,000,000 transitions.

Prints the seconds of every save and writes ``results/checkpoint_stall/checkpoint_stall.csv``.

    OMP_NUM_THREADS=1 python benchmarks/speed/checkpoint_stall.py [saves]
"""

from __future__ import annotations

import csv
import os
import sys
import tempfile
import time
from pathlib import Path

import torch
from taking_turns import commit
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from nht.recipes.agents.ddpg import PaperDDPGLoss, networks
from nht.recipes.config import DDPG
from nht.recipes.launch import configure
from nht.recipes.run.checkpoints import Checkpoints
from nht.recipes.run.environments import base_env

TRANSITIONS, PARTS = 1_000_000, 10


def benchmark(saves: int) -> None:
    """Fill the buffer, then save again and again."""
    config = configure(DDPG, "ddpg")
    env = base_env(config.env, seed=0, num_envs=1)
    features, actor, critic = networks(env, config.algo)
    loss = PaperDDPGLoss(actor, critic, gamma=0.98, action_l2=0.05)
    optimiser = torch.optim.Adam(loss.parameters())
    for parameter in loss.parameters():
        parameter.grad = torch.randn_like(parameter)
    optimiser.step()  # its state exists from here on
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(TRANSITIONS))
    for _ in range(PARTS):
        buffer.extend(transitions(TRANSITIONS // PARTS, env.observation_spec["observation"].shape[-1]))
    rows = []
    with tempfile.TemporaryDirectory(dir=".") as folder:  # where runs are, not in memory
        checkpoints = Checkpoints(
            Path(folder), loss=loss, optimiser=optimiser, features=features, buffer=buffer
        )
        for number in range(saves):
            wall, cpu = time.perf_counter(), time.process_time()
            checkpoints.save(number)
            seconds = time.perf_counter() - wall
            size = max(path.stat().st_size for path in Path(folder).iterdir())
            rows.append([number, f"{seconds:.2f}", f"{time.process_time() - cpu:.2f}", f"{size / 1e6:.0f}"])
            print(f"save {number}: {seconds:.2f} s, {size / 1e6:.0f} MB", flush=True)
    out = Path(__file__).parents[1] / "results" / "checkpoint_stall" / "checkpoint_stall.csv"
    with out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["save", "seconds", "CPU seconds", "MB", "load", "commit"])
        writer.writerows([*row, f"{os.getloadavg()[0]:.1f}", commit()] for row in rows)


def transitions(number: int, observation: int) -> TensorDict:
    """As DDPG stores them, of random numbers, which do not compress."""
    flag = torch.zeros(number, 1, dtype=torch.bool)
    outcome = {"observation": torch.randn(number, observation), "reward": torch.randn(number, 1)}
    entries = {
        "observation": torch.randn(number, observation),
        "action": torch.randn(number, 2),
        "steps_to_next_obs": torch.ones(number, dtype=torch.int64),
        "next": {**outcome, "done": flag, "terminated": flag.clone()},
    }
    return TensorDict(entries, [number])


if __name__ == "__main__":
    benchmark(int(sys.argv[1]) if len(sys.argv) > 1 else 7)
