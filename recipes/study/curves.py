"""Learning curves of runs: read from their folders, grouped, and shown in tables and figures."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas

from nht.recipes.figure_style import PAGE, PANEL_SHAPE, label_ends, save_figure, style, thousands
from nht.recipes.run.config_file import read_settings
from nht.recipes.run.folder import METRICS_FILE
from nht.recipes.run.metrics import FAILURE, FRAMES, SECONDS, SUCCESS, tested
from nht.recipes.run.metrics_file import metrics_table
from nht.recipes.run.saved_run import CONFIG_FILE, OLDEST_ALGORITHM
from nht.recipes.study.figures import colour
from nht.recipes.study.scores import interquartile_mean, interval

MARKED = 40
"""Evaluations up to which each has a dot."""
LABELS = ("task", "algorithm", "interface", "seed")
"""Columns that identify the run of an evaluation."""


def read_runs(folders: list[Path]) -> pandas.DataFrame:
    """The evaluations of all runs in or below ``folders``, a row each, with ``LABELS`` and the ``run``.

    That is its number among ``run_folders``.
    An interface's name includes its number of actions if there are runs with several. Nothing that a run's
    configuration names is imported.

    Raises:
        FileNotFoundError: if there is no run with an evaluation.
        ValueError: if a run's files cannot be read.
    """
    runs = run_folders(folders)
    if not runs:
        raise FileNotFoundError(f"no {METRICS_FILE} in or below {[str(folder) for folder in folders]}.")
    curves = pandas.concat(
        [_read_run(folder / METRICS_FILE).assign(run=number) for number, folder in enumerate(runs)],
        ignore_index=True,
    )
    if curves.empty or tested(SUCCESS) not in curves:
        raise FileNotFoundError(
            f"no run in or below {[str(folder) for folder in folders]} has an evaluation yet."
        )
    widths = curves.groupby(["task", "interface"])["action_dim"].transform("nunique")
    named = curves["interface"] + " (k = " + curves["action_dim"].astype(str) + ")"
    return curves.assign(interface=curves["interface"].where(widths == 1, named)).drop(columns="action_dim")


def run_folders(folders: list[Path]) -> list[Path]:
    """The folders of all runs in or below ``folders``."""
    return sorted({path.parent for folder in folders for path in folder.rglob(METRICS_FILE)})


def _read_run(metrics: Path) -> pandas.DataFrame:
    settings = read_settings(metrics.with_name(CONFIG_FILE))
    env, map = settings.get("env", {}), settings.get("map", {})
    rows = metrics_table(metrics)
    kind = map.get("kind", "nht")
    labels = {
        "task": env.get("name", "unknown"),
        "algorithm": str(settings.get("recipe", OLDEST_ALGORITHM)).lower(),
        "interface": "raw" if kind == "none" else kind,
        "seed": settings.get("seed", 0),
        "action_dim": map.get("action_dim", 0),
    }
    for place, (name, value) in enumerate(labels.items()):
        rows.insert(place, name, value)
    return rows


def groups(curves: pandas.DataFrame, lines: str) -> Iterator[tuple[str, pandas.DataFrame]]:
    """The groups that share a table and a figure, each with a name for its files: one task and algorithm, or interface.

    Args:
        curves: as ``read_runs`` gives them.
        lines: what is compared within a group, ``"interface"`` or ``"algorithm"``.
    """
    other = "algorithm" if lines == "interface" else "interface"
    for (task, same), group in curves.groupby(["task", other], sort=False):
        yield f"{task}-{same}", group


def summarise(curves: pandas.DataFrame, metric: str = SUCCESS, lines: str = "interface") -> pandas.DataFrame:
    """Per interface or algorithm: seeds, steps, mean and interquartile mean over seeds of the last common evaluation.

    For success, also the failures and the median number of steps to a success of 0.9.
    """
    rows = []
    shown = "{:.3f}" if metric == SUCCESS else "{:,.0f}"
    for name, group in curves.groupby(lines, sort=False):
        together = reached_by_all(group)
        last = together[together[FRAMES] == together[FRAMES].max()]
        scores = last[tested(metric)].to_numpy()
        seeds = group["seed"].nunique()
        row = {
            lines: name,
            "seeds": seeds,
            "steps": int(together[FRAMES].max()),
            metric: shown.format(scores.mean()),
            "95 %": " .. ".join(map(shown.format, interval(scores))),
            "IQM": shown.format(interquartile_mean(scores)),
            "95 % of it": " .. ".join(map(shown.format, interval(scores, interquartile_mean))),
        }
        if metric == SUCCESS:
            reached = group[group[tested(SUCCESS)] >= 0.9].groupby("seed")[FRAMES].min()
            row["failure"] = f"{last[tested(FAILURE)].mean():.3f}"
            all_there = len(reached) == seeds
            row["steps to 0.9"] = (
                f"{int(reached.median()):,}" if all_there else f"{len(reached)} of {seeds} seeds"
            )
        rows.append(row | {"minutes": f"{last[SECONDS].mean() / 60:.1f}"})
    return pandas.DataFrame(rows)


def reached_by_all(group: pandas.DataFrame) -> pandas.DataFrame:
    """The evaluations of one interface that all its seeds have reached: some runs may have gone on for longer."""
    seeds = group.groupby(FRAMES)["seed"].transform("nunique")
    return group[seeds == group["seed"].nunique()]


def plot(curves: pandas.DataFrame, metric: str, title: str, path: Path, lines: str = "interface") -> None:
    """Plot the mean over seeds of every interface or algorithm, with its interval, against environment steps.

    The axis begins at 0, a dot is an evaluation, and each line has its name at its end. A PDF lies beside the PNG.
    """
    with style():
        width = 0.75 * PAGE
        figure, axes = plt.subplots(figsize=(width, width * PANEL_SHAPE / 1.2), layout="constrained")
        for name, group in curves.groupby(lines, sort=False):
            by_frames = reached_by_all(group).groupby(FRAMES)[tested(metric)]
            frames = np.array(list(by_frames.groups))
            bands = np.array([interval(scores.to_numpy()) for _, scores in by_frames])
            seeds = group["seed"].nunique()
            label = f"{name} ({seeds} seed{'s' if seeds > 1 else ''})"
            marker = "o" if len(frames) <= MARKED else ""
            shade = colour(str(name).partition(" (")[0])
            axes.plot(frames, by_frames.mean(), marker=marker, markersize=2, label=label, color=shade)
            axes.fill_between(frames, bands[:, 0], bands[:, 1], color=shade, alpha=0.2, linewidth=0)
        axes.set(xlabel="environment steps", ylabel=f"{metric} of test episodes", title=title)
        if metric == SUCCESS:
            axes.set(ylim=(-0.03, 1.03))
        thousands(axes)
        label_ends(axes)
        save_figure(figure, path)
