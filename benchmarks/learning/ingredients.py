"""Ingredients of off-policy learning, one at a time and together: what each does for DDPG, and TD3 and SAC beside it.

HalfCheetah, raw torques, 150,000 steps with minibatches of 128; WAMGrasp, through an NHT of three dimensions, 200,000
steps; networks of 2 x 128; three seeds, which start alike in all variants. Writes rows, a table and a figure of final
scores for each task, to ``results/ingredients``.

    python benchmarks/learning/ingredients.py FOLDER [TASK]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import pandas

from nht.recipes.figure_style import BLUE, GREY, PAGE, save_figure, style
from nht.recipes.run.metrics import FRAMES, RETURN, SECONDS, SUCCESS, tested
from nht.recipes.study.report import to_markdown
from nht.recipes.study.scores import interval
from populations import ARMS, TOGETHER, made, trained_runs

OUT = Path(__file__).parents[1] / "results" / "ingredients"
SEEDS = range(3)


class Task(NamedTuple):
    """What is learned, how long, and how well.

    Attributes:
        metric: that counts.
        told: settings that all variants share.
        plain: those of DDPG before anything is added.
        others: those that take TD3 and SAC, whose defaults are for locomotion, to what DDPG has here.
        noise: those of their exploration; SAC has its own.
    """

    metric: str
    told: Sequence[str]
    plain: Sequence[str]
    others: Sequence[str]
    noise: Sequence[str]


TASKS = {
    "half_cheetah": Task(
        RETURN,
        [
            "env=half_cheetah",
            "map=none",
            "algo.hidden=[128,128]",
            "algo.batch_size=128",
            "algo.bfloat16=true",
            "algo.total_frames=150_000",
            "evaluation.every=10_000",
            "evaluation.episodes=10",
            "run.checkpoint_every=50_000",
        ],
        ["algo=ddpg_locomotion"],
        [],
        [],
    ),
    "wam_grasp": Task(
        SUCCESS,
        ["env=wam_grasp", *ARMS, "map.action_scale=1", "algo.total_frames=200_000"],
        ["algo=ddpg_grasp"],
        [
            "algo.frames_per_batch=200",
            "algo.updates_per_batch=20",
            "algo.warmup_frames=2_000",
            "algo.random_frames=0",
            "algo.gamma=0.97",
            "algo.n_steps=4",
            "algo.polyak=0.96",
            "algo.pessimism=1.0",
            "algo.actor_learning_rate=1e-3",
            "algo.critic_learning_rate=1e-3",
        ],
        ["algo.exploration_noise=0.5", "algo.noise_memory=10", "algo.random_action=0.1"],
    ),
}


def variants(task: str) -> dict[str, tuple[str, list[str]]]:
    """The algorithm and settings of each variant, beside those that all have."""
    _, _, plain, others, noise = TASKS[task]
    ahead, memory, updates, rate = (3, 10, 200, 1e-3) if task == "half_cheetah" else (1, 1, 40, 3e-4)
    rates = [f"algo.actor_learning_rate={rate}", f"algo.critic_learning_rate={rate}"]
    distributed = ["algo.layer_norm=critic", "algo.quantiles=25"]
    added = {
        "DDPG": [],
        "observations as they are": ["algo.observation_norm=false"],
        "as they are, layer norm, critic": ["algo.observation_norm=false", "algo.layer_norm=critic"],
        "layer norm, critic": ["algo.layer_norm=critic"],
        "layer norm, both": ["algo.layer_norm=all"],
        "25 quantiles": ["algo.quantiles=25"],
        "25 quantiles, 2 left out": ["algo.quantiles=25", "algo.dropped_quantiles=2"],
        "batches of 512": ["algo.batch_size=512"],
        "twice the updates": [f"algo.updates_per_batch={updates}"],
        f"n-step targets, n = {ahead}": [f"algo.n_steps={ahead}"],
        f"noise, memory {memory}": [f"algo.noise_memory={memory}"],
        f"learning rates of {rate}": rates,
        "layer norm, 25 quantiles": distributed,
        f"the same, learning rates of {rate}": [*distributed, *rates],
        f"the same, n = {ahead}": [*distributed, f"algo.n_steps={ahead}"],
    }
    beside = {
        "TD3: two critics, smoothed targets": ("td3", [*others, *noise]),
        "TD3, targets not smoothed": ("td3", [*others, *noise, "algo.policy_noise=0"]),
        "TD3, layer norm, critics": ("td3", [*others, *noise, "algo.layer_norm=critic"]),
        "SAC": ("sac", others),
        "SAC, layer norm, critics": ("sac", [*others, "algo.layer_norm=critic"]),
    }
    return {name: ("ddpg", [*plain, *more]) for name, more in added.items()} | {
        name: (algorithm, list(more)) for name, (algorithm, more) in beside.items()
    }


def main() -> None:
    """Train what is missing, and show what was learned."""
    folder = Path(sys.argv[1]).resolve()
    for name in sys.argv[2:] or TASKS:
        task, parts = TASKS[name], []
        driven = interface(folder) if name == "wam_grasp" else []
        for variant, (algorithm, told) in variants(name).items():
            run = folder / name / "".join(letter if letter.isalnum() else "-" for letter in variant)
            runs = trained_runs(run, [*told, *task.told, *driven], SEEDS, algorithm)
            parts.append(runs.assign(interface=variant, together=algorithm in TOGETHER))
            curves = pandas.concat(parts, ignore_index=True)
            save(curves, task.metric, OUT / f"{name}.csv")
        plot(curves, task.metric, OUT / f"{name}.png")


def interface(folder: Path) -> list[str]:
    """The settings of WAMGrasp's map, trained first if need be."""
    told = ["env=wam_grasp", "demos.transitions=100_000", "map=nht", "map.action_dim=3"]
    return [f"map.file={made(folder / 'grasp.safetensors', 'train_map', told)}"]


def save(curves: pandas.DataFrame, metric: str, file: Path) -> None:
    """Write the rows; print and write the table of what the variants reach, and what they cost."""
    file.parent.mkdir(parents=True, exist_ok=True)
    columns = ["task", "algorithm", "interface", "seed", FRAMES, tested(metric), SECONDS, "together"]
    curves[columns].rename(columns={"interface": "variant"}).to_csv(file, index=False)
    shown, lines = ("{:.2f}" if metric == SUCCESS else "{:,.0f}"), []
    for variant, runs in curves.groupby("interface", sort=False):
        scores = final(runs, metric)
        # A population's seconds are those of all its learners.
        seconds = runs.groupby("seed")[SECONDS].max()
        each = float(seconds.mean()) / (len(seconds) if runs["together"].iloc[0] else 1)
        lines.append(
            {
                "variant": variant,
                metric: shown.format(scores.mean()),
                "every seed": ", ".join(map(shown.format, scores)),
                "seconds a learner": f"{each:,.0f}",
            }
        )
    table = pandas.DataFrame(lines)
    file.with_suffix(".md").write_text(to_markdown(table))
    print(table.to_string(index=False), flush=True)


def final(runs: pandas.DataFrame, metric: str) -> pandas.Series:
    """The mean of each seed's last three evaluations: a single one says little of a policy that still moves."""
    return (
        runs.sort_values(FRAMES).groupby("seed")[tested(metric)].apply(lambda scores: scores.tail(3).mean())
    )


@style()
def plot(curves: pandas.DataFrame, metric: str, file: Path) -> None:
    """What each variant reaches: its mean with its interval, every seed as a dot, plain DDPG as a line."""
    names = list(curves["interface"].unique())
    figure, axes = plt.subplots(figsize=(0.75 * PAGE, 0.2 * len(names) + 0.7), layout="constrained")
    for place, name in enumerate(names):
        scores = final(curves[curves["interface"] == name], metric).to_numpy()
        low, high = interval(scores)
        axes.plot([low, high], [place, place], color=BLUE, linewidth=3, alpha=0.4, solid_capstyle="butt")
        axes.plot(scores, [place] * len(scores), "o", color=BLUE, markersize=2.5)
        axes.plot(scores.mean(), place, "|", color="black", markersize=8)
        if place == 0:
            axes.axvline(scores.mean(), color=GREY, linewidth=0.8, zorder=0)
    axes.set_yticks(range(len(names)), names)
    axes.invert_yaxis()
    axes.set(xlabel=f"{metric} of test episodes, last three evaluations", title=curves["task"].iloc[0])
    save_figure(figure, file)


if __name__ == "__main__":
    main()
