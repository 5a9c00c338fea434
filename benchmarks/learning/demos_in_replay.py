"""DDPG on both arm tasks with and without demonstrations in its replay, through NHT and with raw joints, five seeds.

Each row of a task's table is one population of five seeds. A population that is finished is not repeated, one that was
interrupted goes on. Writes every evaluation, a table and a figure a task to ``results/demos_in_replay``.

    python -m nht.recipes.collect_demos env=wam_grasp demos.transitions=100_000 out=FOLDER/wam_grasp-demos
    data="env=wam_grasp demos.path=FOLDER/wam_grasp-demos"    # and the same for wam_wipe, with map.action_dim=2
    python -m nht.recipes.train_map $data map=nht map.action_dim=3 out=FOLDER/wam_grasp-nht.safetensors
    python benchmarks/learning/demos_in_replay.py FOLDER [TASK ...]
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas

from nht.recipes.figure_style import PAGE, label_ends, save_figure, style, thousands
from nht.recipes.run.metrics import FAILURE, FRAMES, SUCCESS, tested, trained
from nht.recipes.study.curves import read_runs, summarise
from nht.recipes.study.figures import colour as colour_of
from nht.recipes.study.report import to_markdown
from nht.recipes.study.scores import interval

OUT = Path(__file__).parents[1] / "results" / "demos_in_replay"
SEEDS, DEMOS = 5, 10_000
SHARED = ["algo.hidden=[128,128]", "algo.bfloat16=true", "evaluation.episodes=50", "evaluation.every=20_000"]
TASKS = {
    "wam_grasp": ["algo=ddpg_grasp", "map.action_scale=1", "algo.total_frames=200_000"],
    "wam_wipe": ["map.action_scale=1", "algo.total_frames=100_000"],
}
WAYS = {
    "none": [],
    "prefilled": [f"algo.demos.transitions={DEMOS}"],
    "a quarter": [f"algo.demos.transitions={DEMOS}", "algo.demos.share=0.25"],
}
"""How demonstrations take part: not at all, in the replay buffer, as a quarter of each minibatch."""
STYLES = {"none": ":", "prefilled": "--", "a quarter": "-"}


def main() -> None:
    """Train what is missing, and show what was learned."""
    folder = Path(sys.argv[1]).resolve()
    OUT.mkdir(parents=True, exist_ok=True)
    for task in sys.argv[2:] or TASKS:
        parts = []
        for interface in ("nht", "raw"):
            for way in WAYS:
                run = folder / f"{task}-{interface}-{way.replace(' ', '-')}"
                train(task, interface, way, folder, run)
                parts.append(read_runs([run]).assign(interface=f"{interface}, {way}"))
                show(task, pandas.concat(parts, ignore_index=True))


def train(task: str, interface: str, way: str, folder: Path, run: Path) -> None:
    """Train one population, or go on with it."""
    demos = folder / f"{task}-demos"
    driven = f"map.file={folder / task}-nht.safetensors" if interface == "nht" else "map=none"
    told = [f"env={task}", driven, f"demos.path={demos}", *TASKS[task], *SHARED, *WAYS[way]]
    quiet = ["evaluation.video=false", "run.wandb=false", "run.checkpoint_every=20_000"]
    command = [sys.executable, "-m", "nht.recipes.ddpg", *told, *quiet, f"seeds={SEEDS}"]
    env = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run([*command, f"run.folder={run}", "run.resume=auto"], check=True, env=env)


def show(task: str, curves: pandas.DataFrame) -> None:
    """Write rows, table and figure of a task."""
    columns = [
        "task",
        "interface",
        "seed",
        FRAMES,
        tested(SUCCESS),
        tested(FAILURE),
        trained(FAILURE),
        "seconds",
    ]
    curves[columns].to_csv(OUT / f"{task}.csv", index=False)
    table = summarise(curves)
    # Of all training episodes, from the first on: what a person with a real robot asks for.
    training = curves.groupby("interface", sort=False)[trained(FAILURE)].mean()
    table["failed while training"] = [f"{training[name]:.2f}" for name in table["interface"]]
    (OUT / f"{task}.md").write_text(to_markdown(table))
    plot(task, curves)
    print(table.to_string(index=False), flush=True)


@style()
def plot(task: str, curves: pandas.DataFrame) -> None:
    """Means over the seeds with their intervals: a colour for each interface, a line style for each way."""
    figure, axes = plt.subplots(figsize=(0.75 * PAGE, 0.42 * PAGE), layout="constrained")
    for name, group in curves.groupby("interface", sort=False):
        interface, way = str(name).split(", ")
        scores = group.groupby(FRAMES)[tested(SUCCESS)]
        bands = np.array([interval(values.to_numpy()) for _, values in scores])
        colour = colour_of(interface)
        axes.plot(scores.mean(), color=colour, linestyle=STYLES[way], marker="o", markersize=2, label=name)
        axes.fill_between(scores.mean().index, *bands.T, color=colour, alpha=0.12, linewidth=0)
    axes.set(xlabel="environment steps", ylabel="success of test episodes", ylim=(-0.03, 1.03), title=task)
    thousands(axes)
    label_ends(axes)
    save_figure(figure, OUT / f"{task}.png")


if __name__ == "__main__":
    main()
