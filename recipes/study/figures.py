"""The figures of a search's report, each as PNG and SVG."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no display is needed

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from nht.recipes.maps.kinds import KINDS
from nht.recipes.run.metrics import FRAMES, SUCCESS, tested
from nht.recipes.study.results import SearchResults
from nht.recipes.study.scores import Scores, best_of, interval, percentiles, performance_profile, resampled

OTHER_COLOURS = ("#A6761D", "#7570B3", "#E7298A")
"""Colours of interfaces whose kind of map has none of its own."""
REPEATABLE: Any = {"svg.hashsalt": "nht", "savefig.dpi": 150, "font.size": 10}
BAND_RESAMPLES = 500


@dataclass(frozen=True)
class Figure:
    """A figure of the report.

    Attributes:
        name: of its files, without the suffix.
        title: its heading.
        caption: what it shows.
    """

    name: str
    title: str
    caption: str


def draw_all(results: SearchResults, out: Path) -> list[Figure]:
    """Write every figure into ``out``; the one of correlations needs two different configurations."""
    drawings = [_violins, _curves, _profile, _budget]
    if len(results.correlations()):
        drawings.append(_correlations)
    with plt.rc_context(REPEATABLE):
        return [draw(results, out) for draw in drawings]


def colour(interface: str) -> str:
    """The colour of an interface in all figures: that of its kind of map, or else one derived from its name."""
    kind = "none" if interface == "raw" else interface
    known = KINDS[kind].colour if kind in list(KINDS) else None
    return known or OTHER_COLOURS[sum(interface.encode()) % len(OTHER_COLOURS)]


def _line(interface: str) -> dict[str, Any]:
    """The line style of an interface's curve: ours is wide, so that it shows beneath other curves."""
    return {"color": colour(interface), "linewidth": 3.0 if interface == "nht" else 1.5}


def _save(canvas: Canvas, out: Path, figure: Figure) -> Figure:
    canvas.savefig(out / f"{figure.name}.png", metadata={"Software": None})
    canvas.savefig(out / f"{figure.name}.svg", metadata={"Date": None, "Creator": None})
    plt.close(canvas)
    return figure


def _label(results: SearchResults) -> str:
    return f"final {results.metric} of test episodes"


def _bound(axes: Axes, results: SearchResults, axis: str = "y") -> None:
    if results.metric == SUCCESS:
        axes.set(**{f"{axis}lim": (-0.05, 1.05)})
    axes.grid(alpha=0.3, axis="both")
    axes.spines[["top", "right"]].set_visible(False)


def _violins(results: SearchResults, out: Path) -> Figure:
    names = results.interfaces
    canvas, pair = plt.subplots(
        1, 2, figsize=(max(8.0, 1.9 * len(names)), 4.2), sharey=True, layout="constrained"
    )
    by_name = [results.scores(name) for name in names]
    kinds = {"means over seeds": [s.mean(1) for s in by_name], "single runs": [s.ravel() for s in by_name]}
    rng = np.random.default_rng(0)
    for axes, (kind, values) in zip(pair, kinds.items(), strict=True):
        for place, (name, scores) in enumerate(zip(names, values, strict=True)):
            if np.ptp(scores) > 0:
                body = axes.violinplot(scores, [place], widths=0.85, showextrema=False)["bodies"][0]
                body.set(facecolor=colour(name), alpha=0.3, edgecolor="none")
            aside = rng.uniform(-0.12, 0.12, len(scores))
            axes.scatter(place + aside, scores, s=16, color=colour(name), alpha=0.8, linewidth=0, zorder=3)
            axes.hlines(np.median(scores), place - 0.3, place + 0.3, color=colour(name), linewidth=2.5)
        axes.set_xticks(range(len(names)), names)
        axes.set_title(f"configurations, {kind}" if "means" in kind else kind, fontsize=10)
        _bound(axes, results)
    pair[0].set_ylabel(_label(results))
    text = (
        "The final score over the configurations drawn, a dot for each (left, mean over its seeds) and for each run "
        "(right); the bar is the median. Wide at the top is robust to hyperparameters."
    )
    return _save(canvas, out, Figure("violins", "Over configurations", text))


def _curves(results: SearchResults, out: Path) -> Figure:
    canvas, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
    fresh = []
    for name in results.interfaces:
        number, rows, is_fresh = results.best(name)
        fresh.append(is_fresh)
        seeds = rows["seed"].nunique()
        reached = rows.groupby(FRAMES)[tested(results.metric)].apply(lambda scores: scores.to_numpy())
        reached = reached[reached.map(len) == seeds]
        steps = reached.index.to_numpy()
        bands = np.array([interval(scores) for scores in reached])
        label = f"{name} (number {number}, {seeds} seed{'s' if seeds > 1 else ''})"
        axes.plot(steps, [scores.mean() for scores in reached], label=label, **_line(name))
        axes.fill_between(steps, bands[:, 0], bands[:, 1], color=colour(name), alpha=0.18, linewidth=0)
    axes.set(xlabel="environment steps", ylabel=f"{results.metric} of test episodes")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:,.0f}k")
    _bound(axes, results)
    canvas.legend(loc="outside right upper", fontsize=9)
    seeds_said = (
        "fresh seeds, apart from those that it was chosen by"
        if all(fresh)
        else ("the very seeds that it was chosen by, so it looks better than it is")
    )
    text = f"Learning with each interface's best configuration, on {seeds_said}: mean and 95 % interval over seeds."
    return _save(canvas, out, Figure("curves", "The best configurations", text))


def _profile(results: SearchResults, out: Path) -> Figure:
    canvas, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
    every = np.concatenate([results.scores(name).ravel() for name in results.interfaces])
    levels = np.linspace(min(every.min(), 0.0), every.max(), 101)
    rng = np.random.default_rng(0)
    for name in results.interfaces:
        scores = results.scores(name)
        axes.plot(levels, performance_profile(scores, levels), label=name, **_line(name))
        again = performance_profile(resampled(scores, rng, BAND_RESAMPLES), levels)
        _band(axes, levels, again, name)
    axes.set(xlabel=f"score: {_label(results)}", ylabel="share of runs above the score", ylim=(-0.03, 1.03))
    _bound(axes, results, "x")
    canvas.legend(loc="outside right upper", fontsize=9)
    text = (
        "How many runs of all configurations end above each score; higher is better. Bands: hierarchical bootstrap, "
        "configurations first, then seeds within each."
    )
    return _save(canvas, out, Figure("profile", "Performance profile", text))


def _band(axes: Axes, places: Scores, again: Scores, name: str) -> None:
    low, high = percentiles(again)
    axes.fill_between(places, low, high, color=colour(name), alpha=0.15, linewidth=0)


def _budget(results: SearchResults, out: Path) -> Figure:
    canvas, axes = plt.subplots(figsize=(8, 4.2), layout="constrained")
    rng = np.random.default_rng(0)
    for name in results.interfaces:
        scores = results.scores(name)
        tried = np.arange(1.0, len(scores) + 1)
        axes.plot(tried, best_of(scores.mean(1)), "o-", markersize=4, label=name, **_line(name))
        _band(axes, tried, best_of(resampled(scores, rng, BAND_RESAMPLES).mean(-1)), name)
    axes.set(xlabel="configurations tried", ylabel=f"expected best: {_label(results)}")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _bound(axes, results)
    canvas.legend(loc="outside right upper", fontsize=9)
    text = (
        "What the best of n configurations, drawn at random, can be expected to reach (mean over its seeds): the "
        "price of tuning. Bands: hierarchical bootstrap; towards the right they know only the configurations drawn."
    )
    return _save(canvas, out, Figure("budget", "Best of n", text))


def _correlations(results: SearchResults, out: Path) -> Figure:
    table = results.correlations()
    canvas, axes = plt.subplots(
        figsize=(1.1 * len(table.columns) + 3.5, 0.42 * len(table) + 1.4), layout="constrained"
    )
    picture = axes.imshow(table, cmap="RdBu_r", vmin=-1, vmax=1, aspect="auto")
    axes.set_xticks(range(len(table.columns)), table.columns)
    axes.set_yticks(range(len(table)), table.index)
    for (row, column), value in np.ndenumerate(table.to_numpy()):
        if np.isfinite(value):
            axes.text(
                column,
                row,
                f"{value:.2f}",
                ha="center",
                va="center",
                color="white" if abs(value) > 0.6 else "black",
            )
    canvas.colorbar(picture, label="rank correlation with the score")
    text = (
        "Spearman's rank correlation of each hyperparameter with a configuration's score; its square is the share of "
        "variance in ranks that goes with it. Empty: not drawn, or every score is the same. With few configurations "
        "large values come by chance."
    )
    return _save(canvas, out, Figure("correlations", "What the score depends on", text))
