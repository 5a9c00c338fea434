"""Finished runs side by side, as a table and learning curves; or a whole search, as figures and a page.

python -m nht.recipes.report runs/demo
python -m nht.recipes.report runs/search-wam_wipe
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no display is needed

import matplotlib.pyplot as plt
import numpy as np
import pandas

from nht.recipes.config import Report
from nht.recipes.launch import launch
from nht.recipes.run.folder import read_config
from nht.recipes.run.metrics_file import metrics_table
from nht.recipes.study.report import to_markdown, write_report
from nht.recipes.study.scores import interquartile_mean, interval


def main(config: Report) -> None:
    """Report a search if there is one in the folder, else the runs in and below it."""
    folder = Path(config.folder)
    if config.folder and (rows := folder / "rows.csv").exists():
        report_search(rows, Path(config.out or folder / "report"), config.title)
    else:
        report_runs(config)


def report_search(rows: Path, out: Path, title: str) -> None:
    """Write the figures of a search and the page around them, and print its table."""
    print(write_report(rows, out, title).to_string(index=False))
    print(f"\n{out}: " + ", ".join(sorted(path.name for path in out.iterdir())))


def report_runs(config: Report) -> None:
    """Read the runs, write ``curves.csv``, ``table.md`` and the curves of ``metric``, and print the table.

    Raises:
        ValueError: if no folder is named.
    """
    folders = [*config.runs, *([config.folder] if config.folder else [])]
    if not folders:
        raise ValueError("name a folder of runs or of a search: report DIR, or report runs=[DIR, DIR].")
    out = Path(config.out or Path(folders[0]) / "report")
    out.mkdir(parents=True, exist_ok=True)
    curves = read_runs([Path(folder) for folder in folders], config.allow)
    curves.to_csv(out / "curves.csv", index=False)
    table = summarise(curves, config.metric)
    (out / "table.md").write_text(to_markdown(table))
    plot(curves, config.metric, config.title, out / f"{config.metric}.png")
    print(table.to_string(index=False))
    print(f"\n{out}: curves.csv, table.md, {config.metric}.png")


def read_runs(folders: list[Path], allow: Sequence[str] = ()) -> pandas.DataFrame:
    """The evaluations of all runs in or below ``folders``, a row each, with the run's interface and seed.

    Args:
        folders: of runs.
        allow: packages whose code their configurations may name.

    Raises:
        FileNotFoundError: if there is no run with an evaluation.
        ValueError: if a run's files cannot be read.
    """
    metrics = sorted({path for folder in folders for path in folder.rglob("metrics.csv")})
    if not metrics:
        raise FileNotFoundError(f"no metrics.csv in or below {[str(folder) for folder in folders]}.")
    return pandas.concat([_read_run(path, allow) for path in metrics], ignore_index=True)


def _read_run(metrics: Path, allow: Sequence[str]) -> pandas.DataFrame:
    config = read_config(metrics.parent, allow)
    rows = metrics_table(metrics)
    interface = "raw" if config.map.kind == "none" else config.map.kind
    rows.insert(0, "interface", interface)
    rows.insert(1, "seed", config.seed)
    rows["algorithm"] = type(config).__name__
    return rows


def summarise(curves: pandas.DataFrame, metric: str = "success") -> pandas.DataFrame:
    """Per interface: seeds, steps, and the mean and interquartile mean over seeds of the last evaluation of all.

    For success also the failures, and the median of the steps to a success of 0.9.
    """
    rows = []
    shown = "{:.3f}" if metric == "success" else "{:,.0f}"
    for interface, group in curves.groupby("interface", sort=False):
        together = reached_by_all(group)
        last = together[together["frames"] == together["frames"].max()]
        scores = last[f"eval_{metric}"].to_numpy()
        seeds = group["seed"].nunique()
        row = {
            "interface": interface,
            "seeds": seeds,
            "steps": int(together["frames"].max()),
            metric: shown.format(scores.mean()),
            "95 %": " .. ".join(map(shown.format, interval(scores))),
            "IQM": shown.format(interquartile_mean(scores)),
            "95 % of it": " .. ".join(map(shown.format, interval(scores, interquartile_mean))),
        }
        if metric == "success":
            reached = group[group["eval_success"] >= 0.9].groupby("seed")["frames"].min()
            row["failure"] = f"{last['eval_failure'].mean():.3f}"
            all_there = len(reached) == seeds
            row["steps to 0.9"] = (
                f"{int(reached.median()):,}" if all_there else f"{len(reached)} of {seeds} seeds"
            )
        rows.append(row | {"minutes": f"{last['seconds'].mean() / 60:.1f}"})
    return pandas.DataFrame(rows)


def reached_by_all(group: pandas.DataFrame) -> pandas.DataFrame:
    """The evaluations of one interface that every one of its seeds has made: some runs may have gone on for longer."""
    seeds = group.groupby("frames")["seed"].transform("nunique")
    return group[seeds == group["seed"].nunique()]


def plot(curves: pandas.DataFrame, metric: str, title: str, path: Path) -> None:
    """Mean over the seeds of every interface, with its interval, against environment steps."""
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for interface, group in curves.groupby("interface", sort=False):
        by_frames = reached_by_all(group).groupby("frames")[f"eval_{metric}"]
        frames = np.array(list(by_frames.groups))
        bands = np.array([interval(scores.to_numpy()) for _, scores in by_frames])
        seeds = group["seed"].nunique()
        label = f"{interface} ({seeds} seed{'s' if seeds > 1 else ''})"
        (line,) = axes.plot(frames, by_frames.mean(), label=label)
        axes.fill_between(frames, bands[:, 0], bands[:, 1], color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set(xlabel="environment steps", ylabel=f"{metric} of test episodes", title=title)
    if metric == "success":
        axes.set(ylim=(-0.03, 1.03))
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:.0f}k")
    axes.grid(alpha=0.3)
    axes.legend(loc="best")
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    launch(main, Report, "report", positional="folder")
