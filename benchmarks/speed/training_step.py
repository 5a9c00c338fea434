"""What DDPG's loop costs over its parts: one round of collect, store and 20 x (sample, loss, backward, step, targets).

The parts are timed alone, each many times in a row; the loop is the recipe itself: `nht.recipes.ddpg` is run for two
lengths and the difference is divided by the rounds between them, so that set-up and evaluation cancel. CPU seconds
are counted, for other programs may share the cores. Prints the table and writes ``results/training_step``.

    OMP_NUM_THREADS=1 python benchmarks/speed/training_step.py
"""

from __future__ import annotations

import csv
import os
import platform
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import nht
from nht.recipes.agents.ddpg import PaperDDPGLoss, networks
from nht.recipes.agents.off_policy import JointSoftUpdate, exploring
from nht.recipes.agents.replay import storable
from nht.recipes.agents.returns import n_step_returns
from nht.recipes.config import DDPG
from nht.recipes.ddpg import main
from nht.recipes.launch import configure
from nht.recipes.maps.kinds import task_context_keys
from nht.recipes.run.environments import mapped_env

ROUNDS = 4
SHORT, LONG = 2_000, 6_000  # frames


def parts(config: DDPG, map: nht.ActionMap) -> dict[str, Callable[[], object]]:
    """Every part of a round, ready to be called again and again."""
    algo = config.algo
    env = mapped_env(config.env, map, seed=0)
    features, actor, critic = networks(env, algo)
    loss = PaperDDPGLoss(actor, critic, gamma=algo.gamma, action_l2=algo.action_l2)
    target = JointSoftUpdate(loss, eps=algo.polyak)
    optimiser = torch.optim.Adam(loss.parameters(), lr=1e-6, fused=True)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(100_000), batch_size=algo.batch_size)
    collector = Collector(
        env,
        exploring(TensorDictSequential(features, actor), env, algo),
        frames_per_batch=algo.frames_per_batch,
        total_frames=-1,
        track_traj_ids=False,
        auto_register_policy_transforms=True,
    )
    batches = iter(collector)
    look_ahead = n_step_returns(algo.gamma, algo.n_steps)
    collected = next(batches).clone()

    def store() -> None:
        buffer.extend(storable(look_ahead(collected)))

    store()
    batch = buffer.sample()

    def normalise() -> None:
        with torch.no_grad():
            features(batch), features(batch["next"])

    def descend() -> None:
        losses = loss(batch)
        (losses["loss_actor"] + losses["loss_value"]).backward()

    normalise()
    return {
        "collect": lambda: next(batches),
        "store": store,
        "sample": lambda: list(
            buffer.sample(algo.updates_per_batch * algo.batch_size).split(algo.batch_size)
        ),
        "normalise": normalise,
        "loss and backward": descend,
        "optimiser": lambda: (optimiser.step(), optimiser.zero_grad(set_to_none=False)),
        "targets": target.step,
    }


def cpu_seconds(call: Callable[[], object], times: int) -> float:
    """CPU seconds of one call, on average."""
    start = time.process_time()
    for _ in range(times):
        call()
    return (time.process_time() - start) / times


def loop_seconds(map_file: Path, frames: int) -> float:
    """CPU seconds of the whole recipe."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = [
            f"map.file={map_file}",
            f"run.folder={folder}/run",
            "run.wandb=false",
            "evaluation.video=false",
            "evaluation.episodes=1",
            f"evaluation.every={frames}",
            f"algo.total_frames={frames}",
            "algo.warmup_frames=0",
            "algo.buffer_size=100000",
            "run.checkpoint_every=1000000",
        ]
        return cpu_seconds(lambda: main(configure(DDPG, "ddpg", overrides)), times=1)


def benchmark() -> None:
    """Rounds of parts and loop in turn; medians, and the spread of the ratio."""
    torch.set_num_threads(1)
    config = configure(DDPG, "ddpg")
    map = nht.NHT(10, 7, 2)
    map.context_keys = tuple(task_context_keys(config.env))
    updates = config.algo.updates_per_batch
    with tempfile.TemporaryDirectory() as scratch:
        map_file = nht.save_map(map, Path(scratch) / "map.safetensors")
        calls = parts(config, map)
        measured: dict[str, list[float]] = {name: [] for name in (*calls, "loop")}
        for _ in range(ROUNDS + 1):  # the first one warms up
            for name, call in calls.items():
                each = 1 if name in ("collect", "store", "sample") else updates
                measured[name].append(each * cpu_seconds(call, times=10 if each == 1 else 50))
            rounds = (LONG - SHORT) / config.algo.frames_per_batch
            measured["loop"].append((loop_seconds(map_file, LONG) - loop_seconds(map_file, SHORT)) / rounds)
    report({name: values[1:] for name, values in measured.items()})


def report(measured: dict[str, list[float]]) -> None:
    """Print and save milliseconds per round (200 frames, 20 updates)."""
    sums = [
        sum(values) for values in zip(*(measured[name] for name in measured if name != "loop"), strict=True)
    ]
    measured["sum of parts"] = sums
    measured["loop / sum of parts"] = [a / b for a, b in zip(measured["loop"], sums, strict=True)]
    commit = subprocess.run(
        ["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
    ).stdout
    with (Path(__file__).parents[1] / "results" / "training_step" / "training_step.csv").open(
        "w", newline=""
    ) as file:
        writer = csv.writer(file)
        writer.writerow(["part", "median", "least", "most", "unit", "commit", "cores", "torch"])
        for name, values in measured.items():
            scale, unit = (1.0, "ratio") if "/" in name else (1e3, "CPU ms per 200 frames")
            row = [f"{scale * value:.3f}" for value in (statistics.median(values), min(values), max(values))]
            writer.writerow([name, *row, unit, commit.strip(), os.cpu_count(), torch.__version__])
            print(f"{name:>20}  {row[0]:>9}  ({row[1]} .. {row[2]}) {unit}")
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, torch {torch.__version__}")


if __name__ == "__main__":
    benchmark()
