"""Which collector pays when: steps per second of random-weight policies, collecting only, on this machine's cores.

Every contestant steps the same copies with the same actor of 2 x 256; workers share the copies. They
take turns. Wall time, for the point of workers is to use more cores. Prints the table and writes
``results/collectors/collectors.csv``.

    OMP_NUM_THREADS=1 python benchmarks/speed/collectors.py [rounds]
"""

from __future__ import annotations

import csv
import os
import statistics
import sys
import time
from functools import partial
from pathlib import Path

import torch
from taking_turns import commit
from tensordict.nn import TensorDictSequential
from torchrl.collectors import BaseCollector

import nht
from nht.recipes.agents.ppo import networks
from nht.recipes.config import PPO
from nht.recipes.launch import configure
from nht.recipes.run.collecting import make_collector
from nht.recipes.run.environments import base_env, mapped_env
from nht.recipes.sections import CollectorConfig

TASKS = {
    "half_cheetah": ["env=half_cheetah", "env.num_envs=64"],
    "ant": ["env=ant", "env.num_envs=64"],
    "walker-walk": ["env=dm_control", "env.name=walker-walk", "env.num_envs=8"],
}
CONTESTANTS = {
    "single": ("single", 1),
    "2 workers, sync": ("multi_sync", 2),
    "2 workers, async": ("multi_async", 2),
}
STEPS = 32  # of every copy in a batch
WARM_UP, BATCHES = 4, 12


def benchmark(rounds: int) -> None:
    """All tasks, all collectors in turn."""
    torch.set_num_threads(1)
    rows = []
    for task, settings in TASKS.items():
        config = configure(PPO, "ppo", [*settings, "map=none", f"algo.frames_per_batch={64 * STEPS}"])
        base = base_env(config.env, seed=0, num_envs=1)
        map = nht.Identity(base.action_spec.shape[-1])
        base.close()
        rates: dict[str, list[float]] = {name: [] for name in CONTESTANTS}
        for _ in range(rounds):
            for name, way in CONTESTANTS.items():
                rates[name].append(rate(collector(config, map, *way)))
        for name, values in rates.items():
            ratios = [ours / single for ours, single in zip(values, rates["single"], strict=True)]
            rows.append([task, config.env.num_envs, name, f"{statistics.median(values):.0f}"])
            rows[-1] += [f"{statistics.median(ratios):.2f}", f"{min(ratios):.2f}", f"{max(ratios):.2f}"]
            print(*rows[-1], sep="  ", flush=True)
    with (Path(__file__).parents[1] / "results" / "collectors" / "collectors.csv").open(
        "w", newline=""
    ) as file:
        writer = csv.writer(file)
        names = [
            "task",
            "copies",
            "collector",
            "steps per second",
            "over single",
            "least tenth",
            "most tenth",
        ]
        writer.writerow([*names, "rounds", "cores", "load", "commit"])
        writer.writerows(
            [*row, rounds, os.cpu_count(), f"{os.getloadavg()[0]:.1f}", commit()] for row in rows
        )


def rate(collector: BaseCollector) -> float:
    """Steps per second, after a warm-up; nothing else collects meanwhile."""
    batches = iter(collector)
    for _ in range(WARM_UP):
        next(batches)
    start = time.perf_counter()
    steps = sum(next(batches).numel() for _ in range(BATCHES))
    seconds = time.perf_counter() - start
    collector.shutdown()
    return steps / seconds


def collector(config: PPO, map: nht.ActionMap, kind: str, workers: int) -> BaseCollector:
    """A collector of the recipe, as the recipe makes it."""
    make_env = partial(mapped_env, config.env, map, 1.0, num_envs=config.env.num_envs // workers)
    env = make_env(seed=0)
    features, actor, _ = networks(env, config.algo)
    # A batch that is ready first is of one worker: half as many steps.
    share = workers if kind == "multi_async" else 1
    return make_collector(
        CollectorConfig(kind, workers),
        env,
        make_env,
        TensorDictSequential(features, actor),
        frames_per_batch=config.env.num_envs * STEPS // share,
        seed=0,
    )


if __name__ == "__main__":
    benchmark(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
