"""Where a context pays: SVD and NHT on WAMWipe as the swivel range grows and the height tolerance shrinks.

For every swivel range, demonstrations are collected from random starts and both maps are trained on them (k = 2).
Then, without any learning, the expert's actuations are projected through each map, u -> Q Q^T u, and executed, for
every height tolerance. Prints a Markdown table and writes ``benchmarks/results/context_pays.csv``.

    python benchmarks/context_pays.py
"""

from __future__ import annotations

import csv
import tempfile
from pathlib import Path

import numpy as np
import torch

import nht
from nht.envs import make_expert, make_task
from nht.recipes.config import DemosConfig, EnvConfig, MapConfig
from nht.recipes.recording import record_expert
from nht.recipes.train_map import make_map

SWIVELS = (0.0, 0.5, 1.0)  # [rad]
HEIGHT_TOLERANCES = (0.015, 0.005, 0.002)  # [m]
CONTEXT = ["tool_position", "joint_angle"]
EPISODES = 1_000


def main() -> None:
    torch.set_num_threads(1)
    rows = [row for swivel in SWIVELS for row in compare(swivel)]
    out = Path("benchmarks/results/context_pays.csv")
    with out.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(f"{v:.2g}" if isinstance(v, float) else str(v) for v in row.values()) + " |")


def compare(swivel: float) -> list[dict[str, float | str]]:
    """A row per map and height tolerance, for one swivel range."""
    env = EnvConfig(context_keys=CONTEXT, options={"start": "random", "swivel_range": swivel})
    with tempfile.TemporaryDirectory() as scratch:
        demos = record_expert(env, DemosConfig(), seed=0, path=Path(scratch) / "demos")
        width = demos.context(CONTEXT).shape[-1]
        rows = []
        for kind in ("svd", "nht"):
            map = make_map(MapConfig(kind=kind), width, demos.actuation.shape[-1], seed=0)
            trained = nht.train_map(demos, map, context_keys=CONTEXT, max_steps=6_000)
            for tolerance in HEIGHT_TOLERANCES:
                success, failure = projected_expert(trained.map, swivel, tolerance)
                rows.append(
                    {
                        "swivel [rad]": swivel,
                        "height tolerance [mm]": tolerance * 1000,
                        "map": kind,
                        "projection error": trained.metrics["validation_error"],
                        "success": success,
                        "failure": failure,
                    }
                )
    return rows


@torch.no_grad()
def projected_expert(map: nht.ActionMap, swivel: float, tolerance: float) -> tuple[float, float]:
    """Success and failure at the last step when the expert acts through the map."""
    task = make_task(
        "wam_wipe", num_envs=EPISODES, seed=1, start="random", swivel_range=swivel, height_tolerance=tolerance
    )
    expert = make_expert("wam_wipe")
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
