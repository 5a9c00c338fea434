"""Compares the two kinds of saturation, ``scale`` and ``clip``: learning with either, through the same maps.

Three tasks, three seeds each; the action scales are large enough for policies to meet the limits. One process at a
time. A run that is finished is not repeated, one that was interrupted goes on. Every evaluation is a row of
``benchmarks/results/saturation/saturation.csv``.

    python benchmarks/learning/saturation.py FOLDER [TASK ...]
"""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import nht

OUT = Path(__file__).parents[1] / "results" / "saturation" / "saturation.csv"
SEEDS = (0, 1, 2)
KINDS = ("scale", "clip")
COLUMNS = ("eval_success", "eval_failure", "eval_return", "seconds")
HALF_CHEETAH = str(Path(__file__).parents[1] / "demos" / "half_cheetah")

DDPG = ["algo.hidden=[128,128]", "evaluation.episodes=50"]
TASKS: dict[str, dict[str, list[str]]] = {
    "wam_wipe": {
        "map": ["env=wam_wipe", "map=nht", "map.action_dim=2"],
        "run": ["ddpg", "map.action_scale=4", "algo.total_frames=100_000", "evaluation.every=20_000", *DDPG],
    },
    "wam_grasp": {
        "map": ["env=wam_grasp", "map=nht", "map.action_dim=3", "demos.transitions=100_000"],
        "run": [
            "ddpg",
            "algo=ddpg_grasp",
            "map.action_scale=6",
            "algo.total_frames=200_000",
            "evaluation.every=40_000",
            *DDPG,
        ],
    },
    "half_cheetah": {
        "map": ["env=half_cheetah", "map=nht", "map.action_dim=2", f"demos.path={HALF_CHEETAH}"],
        "run": [
            "ppo",
            "map.action_scale=3.5",
            "algo.total_frames=1_003_520",
            "evaluation.every=102_400",
            "evaluation.episodes=10",
        ],
    },
}


def main() -> None:
    folder = Path(sys.argv[1])
    for task in sys.argv[2:] or TASKS:
        for seed in SEEDS:
            files = saved_maps(folder, task, seed)
            for kind in KINDS:
                learn(folder / f"{task}-{kind}-seed{seed}", task, seed, files[kind])
                write(folder)


def saved_maps(folder: Path, task: str, seed: int) -> dict[str, Path]:
    """One map, trained once, in a file for each kind of saturation."""
    trained = folder / f"{task}-seed{seed}.safetensors"
    if not trained.exists():
        call("train_map", *TASKS[task]["map"], f"seed={seed}", f"out={trained}")
    files = {}
    for kind in KINDS:
        map = nht.load_map(trained)
        map.saturation = kind
        files[kind] = nht.save_map(map, trained.with_suffix(f".{kind}.safetensors"))
    return files


def learn(run: Path, task: str, seed: int, map_file: Path) -> None:
    """One run of the task's recipe, unless it is done."""
    if (run / "finished").exists():
        return
    recipe, *settings = TASKS[task]["run"]
    quiet = ["evaluation.video=false", "run.wandb=false", "run.checkpoint_every=102_400", "run.resume=auto"]
    if recipe == "ddpg":
        quiet[2] = "run.checkpoint_every=20_000"
    call(
        recipe,
        *TASKS[task]["map"],
        *settings,
        *quiet,
        f"map.file={map_file}",
        f"run.folder={run}",
        f"seed={seed}",
    )
    (run / "finished").touch()


def call(recipe: str, *settings: str) -> None:
    """A recipe, in a process of its own with one thread."""
    command = [sys.executable, "-m", f"nht.recipes.{recipe}", *settings]
    subprocess.run(command, check=True, env=os.environ | {"OMP_NUM_THREADS": "1"})


def write(folder: Path) -> None:
    """All evaluations of all finished runs."""
    with OUT.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["task", "saturation", "seed", "frames", *COLUMNS])
        for task in TASKS:
            for kind in KINDS:
                for seed in SEEDS:
                    run = folder / f"{task}-{kind}-seed{seed}"
                    if (run / "finished").exists():
                        with (run / "metrics.csv").open() as metrics:
                            for row in csv.DictReader(metrics):
                                writer.writerow(
                                    [task, kind, seed, row["frames"], *(row[key] for key in COLUMNS)]
                                )


if __name__ == "__main__":
    main()
