"""What a run of the paper's DDPG costs, and how much of it is not arithmetic: searches are thousands of such runs.

- ``loop``: the recipe at the paper's settings through a 2-dimensional NHT on WAMWipe, two lengths, their difference.
- ``arithmetic``: the updates that it makes, written out in plain PyTorch (networks, losses, backward, fused Adam,
  target networks), and the physics of its steps by bare ``mujoco.rollout``.
- ``two at a time``: wall time of two processes beside each other over that of one.
- ``start``: seconds until a new process has imported everything and begins its first step.

CPU seconds decide where other programs share the cores. Prints the table and writes ``results/run_cost/run_cost.csv``.

    OMP_NUM_THREADS=1 python benchmarks/speed/run_cost.py [rounds]
"""

from __future__ import annotations

import copy
import csv
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch
from stepping import bare
from taking_turns import commit
from torch import nn
from torchrl.modules import MLP

import nht
from nht.recipes.config import DDPG
from nht.recipes.ddpg import main
from nht.recipes.launch import configure

SHORT, LONG = 1_000, 3_000
PAPER = ["env=wam_wipe", "map=nht", "algo=ddpg_paper", "algo.buffer_size=100000", "evaluation.episodes=1"]
PAPER += ["evaluation.video=false", "run.wandb=false", "run.checkpoint_every=1000000"]


def settings(folder: str, map_file: Path, frames: int) -> list[str]:
    """The recipe's command line, the first evaluation at its end."""
    lengths = [f"algo.total_frames={frames}", f"evaluation.every={frames}"]
    return [*PAPER, f"run.folder={folder}/run", f"map.file={map_file}", *lengths]


def recipe_seconds(map_file: Path, frames: int) -> float:
    """CPU seconds of the whole recipe."""
    with tempfile.TemporaryDirectory() as folder:
        start = time.process_time()
        main(configure(DDPG, "ddpg", settings(folder, map_file, frames)))
        return time.process_time() - start


def update_seconds(updates: int, observation: int, action: int = 2, batch: int = 256) -> float:
    """CPU seconds of the arithmetic of gradient steps: two networks of 3 x 256."""
    hidden = {"num_cells": [256] * 3, "activation_class": nn.ReLU}
    actor = nn.Sequential(MLP(observation, action, **hidden), nn.Tanh())
    critic = MLP(observation + action, 1, **hidden)
    target_actor, target_critic = copy.deepcopy(actor), copy.deepcopy(critic)
    followers = [*target_actor.parameters(), *target_critic.parameters()]
    parameters = [*actor.parameters(), *critic.parameters()]
    optimiser = torch.optim.Adam(parameters, lr=1e-3, fused=True)
    seen, done, later = (
        torch.randn(batch, observation),
        torch.rand(batch, action),
        torch.randn(batch, observation),
    )
    reward = -torch.ones(batch, 1)
    start = time.process_time()
    for update in range(updates):
        with torch.no_grad():
            target = reward + 0.995 * target_critic(later, target_actor(later))
        loss = (critic(seen, done) - target).square().mean()
        chosen = actor(seen)
        critic.requires_grad_(False)
        loss = loss + chosen.square().mean() - critic(seen, chosen).mean()
        critic.requires_grad_(True)
        loss.backward()
        optimiser.step()
        optimiser.zero_grad()
        if update % 40 == 39:
            with torch.no_grad():
                torch._foreach_lerp_(followers, parameters, 0.05)
    return time.process_time() - start


def physics_seconds(steps: int, copies: int = 10) -> float:
    """CPU seconds of bare ``mujoco.rollout``, all copies in one call."""
    stepping = bare("wam_wipe", copies, threads=1)
    next(stepping)
    start = time.process_time()
    for _ in range(steps // copies):
        next(stepping)
    return time.process_time() - start


def process_seconds(map_file: Path, at_a_time: int) -> tuple[float, float]:
    """Wall seconds of processes that run the recipe side by side, and until the first one made its first batch."""
    with tempfile.TemporaryDirectory() as scratch:
        start = time.perf_counter()
        running = [
            subprocess.Popen(
                [sys.executable, "-m", "nht.recipes.ddpg", *settings(f"{scratch}/{n}", map_file, LONG)],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            for n in range(at_a_time)
        ]
        map_copy = Path(scratch) / "0" / "run" / "map.safetensors"
        while not map_copy.exists():
            time.sleep(0.01)
        begun = time.perf_counter() - start
        for process in running:
            process.wait()
        return time.perf_counter() - start, begun


def benchmark(rounds: int) -> None:
    """All in turn, round after round."""
    torch.set_num_threads(1)
    map = nht.NHT(10, 7, 2)
    map.context_keys = ("tool_position", "joint_angle")
    names = ("loop", "updates", "physics", "loop / arithmetic", "two at a time / one", "start")
    measured: dict[str, list[float]] = {name: [] for name in names}
    with tempfile.TemporaryDirectory() as scratch:
        file = nht.save_map(map, Path(scratch) / "map.safetensors")
        for _ in range(rounds + 1):  # the first one warms up
            per_step = (recipe_seconds(file, LONG) - recipe_seconds(file, SHORT)) / (LONG - SHORT)
            updates = update_seconds(200, 16) / 200 * 40 / 200  # 40 of them every 200 steps
            physics = physics_seconds(2_000) / 2_000
            one, begun = process_seconds(file, 1)
            two, _ = process_seconds(file, 2)
            values = (per_step, updates, physics, per_step / (updates + physics), two / one, begun)
            for name, value in zip(names, values, strict=True):
                measured[name].append(value)
    report({name: values[1:] for name, values in measured.items()})


def report(measured: dict[str, list[float]]) -> None:
    """Print and save: seconds for a million steps, ratios as they are."""
    with (Path(__file__).parents[1] / "results" / "run_cost" / "run_cost.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["part", "median", "least", "most", "unit", "rounds", "load", "commit"])
        for name, values in measured.items():
            ratio, start = "/" in name, name == "start"
            scale, unit = (
                (1.0, "ratio") if ratio else (1.0, "s") if start else (1e6, "CPU s for 1,000,000 steps")
            )
            row = [f"{scale * value:.3g}" for value in (statistics.median(values), min(values), max(values))]
            writer.writerow([name, *row, unit, len(values), f"{os.getloadavg()[0]:.1f}", commit()])
            print(f"{name:>22}  {row[0]:>7}  ({row[1]} .. {row[2]}) {unit}")
    million = statistics.median(measured["loop"]) * 1e6
    runs = 128 * 5 * 6 * 2  # configurations, seeds, interfaces, tasks
    print(
        f"the paper's search, {runs} runs of 1,000,000 steps, on 64 cores: {million * runs / 64 / 3600:.0f} hours"
    )


if __name__ == "__main__":
    benchmark(int(sys.argv[1]) if len(sys.argv) > 1 else 5)
