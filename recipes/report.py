"""Finished runs side by side: a table and learning curves.

python -m nht.recipes.report runs=[runs/demo] out=runs/demo
"""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")  # no display is needed

import matplotlib.pyplot as plt
import numpy as np
import pandas
from numpy.typing import NDArray
from scipy import stats

from nht.recipes.config import Report
from nht.recipes.launch import launch
from nht.recipes.run_folder import read_config

RESAMPLES = 2_000
CONFIDENCE = 0.95


def main(config: Report) -> None:
    """Read the runs, then write ``curves.csv``, ``table.md`` and ``success.png``, and print the table."""
    out = Path(config.out)
    out.mkdir(parents=True, exist_ok=True)
    curves = read_runs([Path(folder) for folder in config.runs])
    curves.to_csv(out / "curves.csv", index=False)
    table = summarise(curves)
    (out / "table.md").write_text(to_markdown(table))
    plot(curves, config.title, out / "success.png")
    print(table.to_string(index=False))
    print(f"\n{out}: curves.csv, table.md, success.png")


def read_runs(folders: list[Path]) -> pandas.DataFrame:
    """The evaluations of all runs in or below ``folders``, a row each, with the run's interface and seed.

    Raises:
        FileNotFoundError: if there is no run with an evaluation.
    """
    metrics = sorted({path for folder in folders for path in folder.rglob("metrics.csv")})
    if not metrics:
        raise FileNotFoundError(f"no metrics.csv in or below {[str(folder) for folder in folders]}.")
    return pandas.concat([_read_run(path) for path in metrics], ignore_index=True)


def _read_run(metrics: Path) -> pandas.DataFrame:
    config = read_config(metrics.parent)
    rows = pandas.read_csv(metrics)
    interface = "raw" if config.map.kind == "none" else config.map.kind
    rows.insert(0, "interface", interface)
    rows.insert(1, "seed", config.seed)
    return rows


def summarise(curves: pandas.DataFrame) -> pandas.DataFrame:
    """Per interface: seeds, steps, final success with its interval, and steps to a success of 0.9 (median)."""
    rows = []
    for interface, group in curves.groupby("interface", sort=False):
        last = group[group["frames"] == group["frames"].max()]
        low, high = interval(last["eval_success"].to_numpy())
        reached = group[group["eval_success"] >= 0.9].groupby("seed")["frames"].min()
        every = len(reached) == group["seed"].nunique()
        rows.append(
            {
                "interface": interface,
                "seeds": group["seed"].nunique(),
                "steps": int(group["frames"].max()),
                "success": f"{last['eval_success'].mean():.3f}",
                "95 %": f"{low:.3f} .. {high:.3f}",
                "failure": f"{last['eval_failure'].mean():.3f}",
                "steps to 0.9": f"{int(reached.median()):,}" if every else f"{len(reached)} seeds got there",
                "minutes": f"{last['seconds'].mean() / 60:.1f}",
            }
        )
    return pandas.DataFrame(rows)


def interval(values: NDArray[np.float64]) -> tuple[float, float]:
    """Bootstrap interval of the mean over seeds (percentiles, with a generator of its own); a point for one seed."""
    if len(values) < 2 or np.ptp(values) == 0:
        return float(values.mean()), float(values.mean())
    found = stats.bootstrap(
        (values,),
        np.mean,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=np.random.default_rng(0),
    )
    return float(found.confidence_interval.low), float(found.confidence_interval.high)


def to_markdown(table: pandas.DataFrame) -> str:
    """The table in Markdown."""
    lines = ["| " + " | ".join(table.columns) + " |", "|" + "---|" * len(table.columns)]
    lines += ["| " + " | ".join(map(str, row)) + " |" for row in table.to_numpy()]
    return "\n".join(lines) + "\n"


def plot(curves: pandas.DataFrame, title: str, path: Path) -> None:
    """Mean success over the seeds of every interface, with its interval, against environment steps."""
    figure, axes = plt.subplots(figsize=(7, 4.2), layout="constrained")
    for interface, group in curves.groupby("interface", sort=False):
        by_frames = group.groupby("frames")["eval_success"]
        frames = np.array(list(by_frames.groups))
        bands = np.array([interval(scores.to_numpy()) for _, scores in by_frames])
        seeds = group["seed"].nunique()
        label = f"{interface} ({seeds} seed{'s' if seeds > 1 else ''})"
        (line,) = axes.plot(frames, by_frames.mean(), label=label)
        axes.fill_between(frames, bands[:, 0], bands[:, 1], color=line.get_color(), alpha=0.2, linewidth=0)
    axes.set(xlabel="environment steps", ylabel="success of test episodes", ylim=(-0.03, 1.03), title=title)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:.0f}k")
    axes.grid(alpha=0.3)
    axes.legend(loc="center right")
    figure.savefig(path, dpi=150)
    plt.close(figure)


if __name__ == "__main__":
    launch(main, Report, "report")
