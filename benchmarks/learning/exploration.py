"""How random exploration does: the share of episodes with a success, by interface, action scale and noise memory.

Actions are a clipped Ornstein-Uhlenbeck process of standard deviation ``DEVIATION`` in [-1, 1]^k; a memory of 1 step
is white noise. Failures end an episode, as in training. Every interface is fitted to the same demonstrations. Prints
a Markdown table and writes ``benchmarks/results/exploration/exploration.csv``.

    python benchmarks/learning/exploration.py [TASK ...]
"""

from __future__ import annotations

import csv
import math
import sys
import tempfile
from pathlib import Path

import numpy as np
import torch
from omegaconf import OmegaConf

import nht
from nht.envs import make_task
from nht.recipes.data.recording import record_expert
from nht.recipes.maps.kinds import make_map, task_context_keys
from nht.recipes.sections import DemosConfig, EnvConfig, MapConfig

ACTION_DIMS = {"wam_grasp": 3, "wam_wipe": 2}
SCALES = (0.5, 1.0, 2.0)  # actuation [rad/s] per unit of action
MEMORIES = (1, 10, 30)  # steps
DEVIATION = 0.5
EPISODES = 2_000
OUT = Path(__file__).parents[1] / "results" / "exploration" / "exploration.csv"


def main() -> None:
    torch.set_num_threads(1)
    with OUT.open("w", newline="") as file:
        writer = None
        for task in sys.argv[1:] or sorted(ACTION_DIMS):
            env = EnvConfig(**OmegaConf.to_container(OmegaConf.load(f"configs/env/{task}.yaml")))
            for kind, map in fitted_maps(env).items():
                for scale in SCALES:
                    for memory in MEMORIES:
                        row = {"task": task, "map": kind, "scale [rad/s]": scale, "memory [steps]": memory}
                        row |= explore(env, map, scale, memory)
                        if writer is None:
                            writer = csv.DictWriter(file, fieldnames=list(row))
                            writer.writeheader()
                            print("| " + " | ".join(row) + " |\n|" + "---|" * len(row))
                        writer.writerow(row)
                        print("| " + " | ".join(str(value) for value in row.values()) + " |", flush=True)


def fitted_maps(env: EnvConfig) -> dict[str, nht.ActionMap]:
    """NHT and SVD trained on the expert's demonstrations, and raw actuation."""
    with tempfile.TemporaryDirectory() as scratch:
        demos = record_expert(env, DemosConfig(transitions=40_000), seed=0, path=Path(scratch) / "demos")
        width = demos.context(task_context_keys(env)).shape[-1]
        maps = {}
        for kind in ("nht", "svd"):
            map = make_map(MapConfig(kind=kind, action_dim=ACTION_DIMS[env.name]), width, 7, seed=0)
            maps[kind] = nht.train_map(demos, map, context_keys=task_context_keys(env), max_steps=6_000).map
    return maps | {"none": make_map(MapConfig(kind="none"), width, 7, seed=0)}


@torch.no_grad()
def explore(env: EnvConfig, map: nht.ActionMap, scale: float, memory: float) -> dict[str, float]:
    """One episode of noise in each of ``EPISODES`` copies: how many met a success, how long they were there, failed."""
    task = make_task(env.name, num_envs=EPISODES, seed=1, **env.options)
    rng, rate = np.random.default_rng(2), 1.0 / memory
    noise = DEVIATION * rng.normal(size=(EPISODES, map.action_dim))
    running, met, failed = np.ones((3, EPISODES), dtype=bool) & [[True], [False], [False]]
    steps = at_goal = 0
    for _ in range(task.max_episode_steps):
        observation = task.observe()
        context = torch.cat(
            [torch.from_numpy(observation[key]) for key in task_context_keys(env)], dim=-1
        ).float()
        action = torch.from_numpy(noise.clip(-1.0, 1.0)).float()
        outcome = task.step(map(scale * action, context).numpy())
        steps, at_goal = steps + running.sum(), at_goal + (running & outcome.success).sum()
        met |= running & outcome.success
        failed |= running & outcome.failure
        running &= ~outcome.terminated
        spread = DEVIATION * math.sqrt(rate * (2.0 - rate))
        noise = (1.0 - rate) * noise + spread * rng.normal(size=noise.shape)
    task.close()
    return {
        "episodes with success": round(float(met.mean()), 4),
        "successful steps per 10,000": round(1e4 * float(at_goal / steps), 1),
        "episodes with failure": round(float(failed.mean()), 4),
        "steps per episode": round(float(steps / EPISODES), 1),
    }


if __name__ == "__main__":
    main()
