"""NHT's start, SVD's plane or random: the held-out error on the paper's three tasks, by Lipschitz limit.

20,000 transitions of the expert (HalfCheetah: the 1,000 in ``benchmarks/demos``), networks of 2 x 128, 3,000 steps, one
thread. What is in ``results/start_plane`` already is not repeated; a table of means is printed.

    python benchmarks/maps/start_plane.py
"""

from __future__ import annotations

import csv
import logging
import tempfile
from collections.abc import Iterator
from itertools import product
from pathlib import Path

import torch
from omegaconf import OmegaConf

import nht
from nht.recipes.data.recording import record_expert
from nht.recipes.maps.kinds import task_context_keys
from nht.recipes.sections import DemosConfig, EnvConfig

ACTION_DIMS = {"wam_wipe": 2, "wam_grasp": 3, "half_cheetah": 2}
LIMITS = (None, 1.0, 0.3, 0.1)  # on the whole map
STARTS = ("svd", "random")
SEEDS = range(5)
HERE = Path(__file__).parents[1]
OUT = HERE / "results" / "start_plane" / "start_plane.csv"
FIELDS = ("task", "lipschitz", "start", "seed", "validation_error", "best_step", "svd_error", "seconds")


def main() -> None:
    torch.set_num_threads(1)
    logging.disable(logging.INFO)
    done = set()
    if OUT.exists():
        with OUT.open() as file:
            done = {tuple(row[key] for key in FIELDS[:4]) for row in csv.DictReader(file)}
    else:
        with OUT.open("w", newline="") as file:
            csv.writer(file).writerow(FIELDS)
    with tempfile.TemporaryDirectory() as scratch:
        demos = {task: demonstrations(task, Path(scratch)) for task in ACTION_DIMS}
        for seed, limit, task, start in product(SEEDS, LIMITS, ACTION_DIMS, STARTS):
            if (task, str(limit or ""), start, str(seed)) not in done:
                with OUT.open("a", newline="") as file:
                    csv.writer(file).writerow(fit(task, *demos[task], limit, start, seed))
    for line in table():
        print(line)


def demonstrations(task: str, scratch: Path) -> tuple[nht.Demos, list[str]]:
    env = EnvConfig(**OmegaConf.to_container(OmegaConf.load(HERE.parent / f"configs/env/{task}.yaml")))
    if task == "half_cheetah":
        return nht.load_demos(HERE / "demos" / task), task_context_keys(env)
    return record_expert(
        env, DemosConfig(transitions=20_000), seed=0, path=scratch / task
    ), task_context_keys(env)


def fit(
    task: str, demos: nht.Demos, keys: list[str], limit: float | None, start: str, seed: int
) -> list[object]:
    """A row: one map, and SVD on the same split of the episodes."""
    width, n, k = demos.context(keys).shape[-1], demos.actuation.shape[-1], ACTION_DIMS[task]
    map = nht.NHT(width, n, k, (128, 128), lipschitz=limit, start=start, seed=seed)
    found = nht.train_map(demos, map, context_keys=keys, max_steps=3_000, seed=seed).metrics
    flat = nht.train_map(demos, nht.SVD(n, k, width), context_keys=keys, seed=seed).metrics
    values = [
        found["validation_error"],
        found["best_step"],
        flat["validation_error"],
        round(found["seconds"], 1),
    ]
    return [task, limit, start, seed, *values]


def table() -> Iterator[str]:
    """Mean and worst of the seeds, in Markdown."""
    with OUT.open() as file:
        rows = list(csv.DictReader(file))
    yield "| task | limit | SVD | from SVD's plane: mean (worst) | random start: mean (worst) | better in |"
    yield "|---|---|---|---|---|---|"
    for task, limit in product(ACTION_DIMS, LIMITS):
        those = [row for row in rows if row["task"] == task and row["lipschitz"] in (str(limit), limit or "")]
        by_start = {
            start: {row["seed"]: float(row["validation_error"]) for row in those if row["start"] == start}
            for start in STARTS
        }
        seeds = sorted(set(by_start["svd"]) & set(by_start["random"]))
        if not seeds:
            continue
        flat = sum(float(row["svd_error"]) for row in those) / len(those)
        cells = [
            f"{sum(errors[seed] for seed in seeds) / len(seeds):.2e} ({max(errors[seed] for seed in seeds):.2e})"
            for errors in by_start.values()
        ]
        better = sum(by_start["svd"][seed] <= by_start["random"][seed] for seed in seeds)
        yield f"| {task} | {limit} | {flat:.2e} | {cells[0]} | {cells[1]} | {better} of {len(seeds)} |"


if __name__ == "__main__":
    main()
