"""The figures of a search's report, each as PNG, PDF and SVG."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.ticker import MaxNLocator

from nht.recipes.figure_style import (
    BLUE,
    COLUMN,
    GREEN,
    ORANGE,
    PAGE,
    PANEL_SHAPE,
    RED,
    label_ends,
    save_figure,
    style,
    thousands,
)
from nht.recipes.maps.kinds import KINDS
from nht.recipes.run.metrics import FRAMES, SUCCESS, tested
from nht.recipes.study.results import SearchResults
from nht.recipes.study.scores import Scores, best_of, interval, percentiles, performance_profile, resampled

ALGORITHM_COLOURS = {"ddpg": BLUE, "td3": ORANGE, "sac": GREEN, "ppo": RED}
"""Colours of algorithms, where these are compared."""
OTHER_COLOURS = ("#A6761D", "#7570B3", "#E7298A")
"""Colours of interfaces whose kind of map has none of its own."""
BAND_RESAMPLES = 500
ENOUGH = 40
"""Scores from which on the outline of a density says something: through eight points it is invented."""


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
    with style():
        return [draw(results, out) for draw in drawings]


def colour(interface: str) -> str:
    """The colour of an interface in all figures: that of its kind of map, or else one derived from its name.

    Algorithms have theirs, too.
    """
    kind = "none" if interface == "raw" else interface
    known = KINDS[kind].colour if kind in list(KINDS) else None
    return (
        known
        or ALGORITHM_COLOURS.get(interface)
        or OTHER_COLOURS[sum(interface.encode()) % len(OTHER_COLOURS)]
    )


def _line(interface: str) -> dict[str, Any]:
    """The line style of an interface's curve: ours is wide, so that it shows beneath other curves."""
    return {"color": colour(interface), "linewidth": 2.4 if interface == "nht" else 1.2}


def _save(canvas: Canvas, out: Path, figure: Figure) -> Figure:
    save_figure(canvas, out / f"{figure.name}.png", ".svg")
    return figure


def _label(results: SearchResults) -> str:
    return f"final {results.metric} of test episodes"


def _bound(axes: Axes, results: SearchResults, axis: str = "y") -> None:
    if results.metric == SUCCESS:
        axes.set(**{f"{axis}lim": (-0.05, 1.05)})


def _violins(results: SearchResults, out: Path) -> Figure:
    names = results.interfaces
    canvas, pair = plt.subplots(1, 2, figsize=(PAGE, 0.36 * PAGE), sharey=True, layout="constrained")
    by_name = [results.scores(name) for name in names]
    kinds = {
        "configurations (means over seeds)": [s.mean(1) for s in by_name],
        "single runs": [s.ravel() for s in by_name],
    }
    rng = np.random.default_rng(0)
    for axes, (kind, values) in zip(pair, kinds.items(), strict=True):
        for place, (name, scores) in enumerate(zip(names, values, strict=True)):
            _spread(axes, place, scores, colour(name), rng)
        axes.set_xticks(range(len(names)), names)
        axes.set_xlabel(kind)
        axes.grid(visible=False, axis="x")
        _bound(axes, results)
    pair[0].set_ylabel(_label(results))
    text = (
        "The final score over the configurations drawn, a dot for each (left, mean over its seeds) and for each run "
        "(right); the bar is the median, the line beside it goes from the lower to the upper quartile. High and close "
        "together is robust to hyperparameters."
    )
    return _save(canvas, out, Figure("violins", "Over configurations", text))


def _spread(axes: Axes, place: float, scores: Scores, colour: str, rng: np.random.Generator) -> None:
    """A dot for each score, beside them median and quartiles; from ``ENOUGH`` scores on an outline of their density."""
    if len(scores) >= ENOUGH and np.ptp(scores) > 0:
        body: Any = axes.violinplot(scores, [place], widths=0.8, showextrema=False)["bodies"]
        body[0].set(facecolor=colour, alpha=0.2, edgecolor="none")
    aside = rng.uniform(-0.1, 0.16, len(scores))
    axes.scatter(place + aside, scores, s=9, color=colour, alpha=0.75, linewidth=0, zorder=3)
    low, middle, high = np.quantile(scores, [0.25, 0.5, 0.75])
    axes.vlines(place - 0.25, low, high, color=colour, linewidth=1.5)
    axes.hlines(middle, place - 0.38, place - 0.12, color=colour, linewidth=2.5)


def _curves(results: SearchResults, out: Path) -> Figure:
    canvas, axes = plt.subplots(figsize=(0.8 * PAGE, 0.8 * PAGE * PANEL_SHAPE / 1.2), layout="constrained")
    fresh = []
    for name in results.interfaces:
        number, rows, is_fresh = results.best(name)
        fresh.append(is_fresh)
        seeds = rows["seed"].nunique()
        reached = rows.groupby(FRAMES)[tested(results.metric)].apply(lambda scores: scores.to_numpy())
        reached = reached[reached.map(len) == seeds]
        steps = reached.index.to_numpy()
        bands = np.array([interval(scores) for scores in reached])
        label = f"{name} (no. {number}, {seeds} seed{'s' if seeds > 1 else ''})"
        axes.plot(steps, [scores.mean() for scores in reached], label=label, **_line(name))
        axes.fill_between(steps, bands[:, 0], bands[:, 1], color=colour(name), alpha=0.18, linewidth=0)
    axes.set(xlabel="environment steps", ylabel=f"{results.metric} of test episodes", title=_task(results))
    thousands(axes)
    _bound(axes, results)
    label_ends(axes)
    seeds_said = (
        "fresh seeds, apart from those that it was chosen by"
        if all(fresh)
        else ("the very seeds that it was chosen by, so it looks better than it is")
    )
    text = f"Learning with each interface's best configuration, on {seeds_said}: mean and 95 % interval over seeds."
    return _save(canvas, out, Figure("curves", "The best configurations", text))


def _task(results: SearchResults) -> str:
    return ", ".join(map(str, results.rows["env"].unique()))


def _profile(results: SearchResults, out: Path) -> Figure:
    canvas, axes = plt.subplots(figsize=(1.35 * COLUMN, COLUMN * PANEL_SHAPE * 1.2), layout="constrained")
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
    canvas.legend(loc="outside right upper")  # at their ends all lines meet
    text = (
        "How many runs of all configurations end above each score; higher is better. Bands: hierarchical bootstrap, "
        "configurations first, then seeds within each."
    )
    return _save(canvas, out, Figure("profile", "Performance profile", text))


def _band(axes: Axes, places: Scores, again: Scores, name: str) -> None:
    low, high = percentiles(again)
    axes.fill_between(places, low, high, color=colour(name), alpha=0.15, linewidth=0)


def _budget(results: SearchResults, out: Path) -> Figure:
    canvas, axes = plt.subplots(figsize=(1.35 * COLUMN, COLUMN * PANEL_SHAPE * 1.2), layout="constrained")
    rng = np.random.default_rng(0)
    for name in results.interfaces:
        scores = results.scores(name)
        tried = np.arange(1.0, len(scores) + 1)
        axes.plot(tried, best_of(scores.mean(1)), "o-", label=name, **_line(name))
        _band(axes, tried, best_of(resampled(scores, rng, BAND_RESAMPLES).mean(-1)), name)
    axes.set(xlabel="configurations tried", ylabel=f"expected best {results.metric}")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    _bound(axes, results)
    label_ends(axes)
    text = (
        "What the best of n configurations, drawn at random, can be expected to reach (mean over its seeds): the "
        "price of tuning. Bands: hierarchical bootstrap; towards the right they know only the configurations drawn."
    )
    return _save(canvas, out, Figure("budget", "Best of n", text))


def _correlations(results: SearchResults, out: Path) -> Figure:
    table = results.correlations()
    canvas, axes = plt.subplots(
        figsize=(0.62 * len(table.columns) + 2.4, 0.22 * len(table) + 0.7), layout="constrained"
    )
    axes.grid(visible=False)
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
                fontsize=6.5,
                color="white" if abs(value) > 0.6 else "black",
            )
    canvas.colorbar(picture, label="rank correlation with the score")
    text = (
        "Spearman's rank correlation of each hyperparameter, and of its map's error where that was recorded, with a "
        "configuration's score; its square is the share of variance in ranks that goes with it. Empty: not drawn, or "
        "every score is the same. With few configurations large values come by chance."
    )
    return _save(canvas, out, Figure("correlations", "What the score depends on", text))
