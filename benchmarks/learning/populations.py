"""Trains variants of a run, several seeds each as one population, and shows them: rows, a table, a figure.

A population that is finished is not repeated, one that was interrupted goes on.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas
from matplotlib.axes import Axes

from nht.recipes.agents.table import find_algorithm
from nht.recipes.figure_style import PAGE, save_figure, style, thousands
from nht.recipes.launch import configure
from nht.recipes.run.metrics import FAILURE, FRAMES, SUCCESS, tested, trained
from nht.recipes.study.curves import read_runs, summarise
from nht.recipes.study.report import to_markdown
from nht.recipes.study.scores import interval

ARMS = [
    "algo.hidden=[128,128]",
    "algo.bfloat16=true",
    "evaluation.episodes=50",
    "evaluation.every=20_000",
    "run.checkpoint_every=20_000",
]
"""Settings of the studies on the arm's tasks."""
QUIET = ["evaluation.video=false", "run.wandb=false"]
TOGETHER = ("ddpg", "ppo")
"""Algorithms whose learners can share every call; the seeds of others are trained one after the other."""
COLUMNS = ["task", "interface", "seed", FRAMES, tested(SUCCESS), tested(FAILURE), trained(FAILURE), "seconds"]


def made(file: Path, recipe: str, told: Sequence[str]) -> Path:
    """What a recipe writes to ``file``: demonstrations or a map. Not made again if it is there."""
    if not file.exists():
        _run(recipe, [*told, f"out={file}"])
    return file


def trained_runs(
    run: Path, told: Sequence[str], seeds: Sequence[int] = range(5), algorithm: str = "ddpg"
) -> pandas.DataFrame:
    """The evaluations of several seeds, trained first if need be: as one population where the algorithm has them."""
    told = [*told, *QUIET, "run.resume=auto"]
    if algorithm in TOGETHER:
        _run(algorithm, [*told, f"seed={seeds[0]}", f"seeds={len(seeds)}", f"run.folder={run}"])
    else:
        for seed in seeds:
            _run(algorithm, [*told, f"seed={seed}", f"run.folder={run / f'seed-{seed}'}"])
    return read_runs([run])


def trained_together(
    folder: Path, learners: Mapping[str, Sequence[str]], algorithm: str
) -> dict[str, pandas.DataFrame]:
    """The evaluations of learners that differ, by their names, trained first as one population if need be."""
    found = find_algorithm(algorithm)
    configs = [
        configure(found.schema, algorithm, [*told, *QUIET, "run.resume=auto", f"run.folder={folder / name}"])
        for name, told in learners.items()
    ]
    found.train(*configs, together=str(folder))
    return {name: read_runs([folder / name]) for name in learners}


def _run(recipe: str, told: Sequence[str]) -> None:
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run([sys.executable, "-m", f"nht.recipes.{recipe}", *told], check=True, env=environment)


def save(curves: pandas.DataFrame, out: Path, name: str) -> None:
    """Write rows and table of variants, told apart by their ``interface``, of a task in which episodes succeed."""
    out.mkdir(parents=True, exist_ok=True)
    curves[COLUMNS].to_csv(out / f"{name}.csv", index=False)
    table = summarise(curves)
    # Of all training episodes, from the first on: what a person with a real robot asks for.
    training = curves.groupby("interface", sort=False)[trained(FAILURE)].mean()
    table["failed while training"] = [f"{training[name]:.2f}" for name in table["interface"]]
    (out / f"{name}.md").write_text(to_markdown(table))
    print(table.to_string(index=False), flush=True)


@style()
def plot(curves: pandas.DataFrame, file: Path, looks: Mapping[str, tuple[str, str]]) -> None:
    """Means over the seeds with their intervals; ``looks`` has the colour and line style of each variant."""
    figure, axes = plt.subplots(figsize=(0.75 * PAGE, 0.42 * PAGE), layout="constrained")
    for name, group in curves.groupby("interface", sort=False):
        colour, line = looks[str(name)]
        _draw(axes, group, str(name), colour, line)
    task = curves["task"].iloc[0]
    axes.set(xlabel="environment steps", ylabel="success of test episodes", ylim=(-0.03, 1.03), title=task)
    thousands(axes)
    # Names at the ends of curves would not say which line is dashed.
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), handlelength=3)
    save_figure(figure, file)


def _draw(axes: Axes, runs: pandas.DataFrame, name: str, colour: str, line: str) -> None:
    scores = runs.groupby(FRAMES)[tested(SUCCESS)]
    bands = np.array([interval(values.to_numpy()) for _, values in scores])
    axes.plot(scores.mean(), color=colour, linestyle=line, marker="o", markersize=2, label=name)
    axes.fill_between(scores.mean().index, *bands.T, color=colour, alpha=0.12, linewidth=0)
