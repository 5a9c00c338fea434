"""Where a context pays: SVD and NHT on the arm's tasks, as starts get wider and tolerances tighter.

For every setting of starts, demonstrations are collected and both maps are trained on them (k = 2 on WAMWipe, 3 on
WAMGrasp). Then, without any learning, the expert's actuations are projected through each map, u -> Q Q^T u, and
executed, for every tolerance. Prints a Markdown table and writes ``benchmarks/results/context_pays/context_pays.csv``.

    python benchmarks/maps/context_pays.py [TASK ...]
"""

from __future__ import annotations

import csv
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch

import nht
from nht.envs import make_expert, make_task
from nht.recipes.data.recording import record_expert
from nht.recipes.maps.kinds import make_map
from nht.recipes.sections import DemosConfig, EnvConfig, MapConfig

CONTEXT = ["tool_position", "joint_angle"]
EPISODES = 1_000
Options = dict[str, Any]

# By task: k, transitions, and by their names the settings of starts and the tolerances.
SETTINGS: dict[str, tuple[int, int, dict[str, Options], dict[str, Options]]] = {
    "wam_grasp": (
        3,
        100_000,
        {"noise 0.2 rad": {"start_noise": 0.2}},
        {f"tilt pi/{part}": {"tilt_tolerance": math.pi / part} for part in (8, 16, 32)},
    ),
    "wam_wipe": (
        2,
        20_000,
        {f"swivel {swivel} rad": {"start": "random", "swivel_range": swivel} for swivel in (0.0, 0.5, 1.0)},
        {f"height {height} mm": {"height_tolerance": height / 1000} for height in (15, 5, 2)},
    ),
}


def main() -> None:
    torch.set_num_threads(1)
    rows = []
    for task in sys.argv[1:] or sorted(SETTINGS):
        action_dim, transitions, starts, tolerances = SETTINGS[task]
        for start, options in starts.items():
            for kind, (map, error) in fitted_maps(task, action_dim, transitions, options).items():
                for tolerance, limits in tolerances.items():
                    success, failure = projected_expert(map, task, options | limits)
                    row = {"task": task, "start": start, "map": kind, "projection error": error}
                    rows.append(row | {"tolerance": tolerance, "success": success, "failure": failure})
    out = Path("benchmarks/results/context_pays/context_pays.csv")
    with out.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(f"{v:.2g}" if isinstance(v, float) else str(v) for v in row.values()) + " |")


def fitted_maps(
    task: str, action_dim: int, transitions: int, options: Options
) -> dict[str, tuple[nht.ActionMap, float]]:
    """NHT and SVD trained on the expert's demonstrations from these starts, each with its held-out error."""
    env = EnvConfig(name=task, context_keys=CONTEXT, options=options)
    with tempfile.TemporaryDirectory() as scratch:
        demos = record_expert(env, DemosConfig(transitions=transitions), seed=0, path=Path(scratch) / "demos")
        width = demos.context(CONTEXT).shape[-1]
        maps = {}
        for kind in ("svd", "nht"):
            map = make_map(
                MapConfig(kind=kind, action_dim=action_dim), width, demos.actuation.shape[-1], seed=0
            )
            trained = nht.train_map(demos, map, context_keys=CONTEXT, max_steps=6_000)
            maps[kind] = trained.map, trained.metrics["validation_error"]
    return maps


@torch.no_grad()
def projected_expert(map: nht.ActionMap, name: str, options: Options) -> tuple[float, float]:
    """Success and failure at the last step when the expert acts through the map."""
    task = make_task(name, num_envs=EPISODES, seed=1, **options)
    expert = make_expert(name)
    success = failure = np.zeros(EPISODES, dtype=bool)
    for _ in range(task.max_episode_steps):
        observation = task.observe()
        context = torch.cat([torch.from_numpy(observation[key]) for key in CONTEXT], dim=-1).float()
        wanted = torch.from_numpy(expert(observation)).float()
        outcome = task.step(map(map.project(wanted, context), context).numpy())
        success, failure = outcome.success, outcome.failure
    task.close()
    return float(success.mean()), float(failure.mean())


if __name__ == "__main__":
    main()
