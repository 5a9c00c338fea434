"""The figure of demonstrations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure, SubFigure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from nht.recipes.data.files import Episodes, episode_returns
from nht.recipes.data.summary import energy, lengths_of
from nht.recipes.figure_style import BLUE, GREY, PAGE, PALETTE, save_figure, style

BINS = 30
TRACES = 3  # episodes whose actuation is drawn
TRACE_STEPS = 200  # of each, at most
VIOLIN_ROWS = 5_000  # about as many transitions make the outlines


@style()
def draw_figure(episodes: Episodes, directions: int) -> Figure:
    """Draw lengths, returns, energy of the global directions, actuation per motor, and that of some episodes."""
    data, lengths = episodes.data, lengths_of(episodes.data)
    actuation = data["actuation"]
    colours = _colours(actuation.shape[-1])
    figure = plt.figure(figsize=(1.25 * PAGE, 0.75 * PAGE), layout="constrained")
    top, bottom = figure.subfigures(2, 1, squeeze=False, height_ratios=[1, 1.15])[:, 0]
    axes = top.subplots(1, 3)
    _histogram(axes[0], lengths.astype(float), "length of the episode [steps]")
    if "reward" in data:
        _histogram(axes[1], np.asarray(episode_returns(data)), "return of the episode")
    else:
        axes[1].text(0.5, 0.5, "no rewards", ha="center", va="center", color=GREY)
        axes[1].set_axis_off()
    _draw_energy(axes[2], energy(actuation)[:directions])
    motors, traces = bottom.subfigures(1, 2, squeeze=False, width_ratios=[1, 2])[0]
    _draw_motors(motors.subplots(), actuation, colours)
    _draw_traces(traces, actuation, lengths, colours)
    figure.suptitle(
        f"{episodes.env}: {len(data):,} transitions in {len(lengths):,} episodes by {episodes.expert}"
    )
    return figure


def _colours(count: int) -> NDArray[np.float64]:
    """A colour for each motor, ``(count, 4)``: distinct ones where there are enough."""
    if count <= len(PALETTE):
        return np.array([to_rgba(colour) for colour in PALETTE[:count]])
    return np.asarray(plt.get_cmap("turbo")(np.linspace(0.05, 0.95, count)))


def _histogram(axes: Axes, values: NDArray[np.float64], label: str) -> None:
    bins = int(np.clip(np.sqrt(len(values)), 5, BINS))
    axes.hist(values, bins=bins, color=BLUE, alpha=0.8, edgecolor="white")
    axes.axvline(float(np.median(values)), color="0.2", linestyle="--")
    axes.set_title(f"median {np.median(values):.4g}")
    axes.set(xlabel=label, ylabel="episodes")
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    _clean(axes)


def _draw_energy(axes: Axes, shares: NDArray[np.float64]) -> None:
    ks = np.arange(1, len(shares) + 1)
    axes.bar(ks, shares, color=BLUE, alpha=0.8)
    axes.axhline(1.0, color=GREY, linestyle="--")
    for k, share in zip(ks, shares, strict=True):
        text = f"{100 * share:.1f}" if share < 0.9995 else f"{100 * share:.2f}" if share < 0.99995 else "100"
        axes.annotate(
            text, (k, share), (0, 2), textcoords="offset points", ha="center", va="bottom", fontsize=6.5
        )
    axes.set(xlabel="first k global directions", ylabel="energy [%]", ylim=(0, 1.12))
    axes.set_title("actuation energy in the directions of SVD")
    axes.set_xticks(ks)
    axes.yaxis.set_major_formatter(lambda value, _: f"{100 * value:.0f}" if value <= 1 else "")
    _clean(axes)


def _draw_motors(axes: Axes, actuation: torch.Tensor, colours: NDArray[np.float64]) -> None:
    rows = actuation[actuation.isfinite().all(dim=1)]
    motors = np.arange(1, rows.shape[1] + 1)
    parts = axes.violinplot(
        rows[:: 1 + len(rows) // VIOLIN_ROWS].numpy(), motors, widths=0.85, showextrema=False
    )
    bodies: Any = parts["bodies"]  # a list, whatever its stub says
    for body, colour in zip(bodies, colours, strict=True):
        body.set(facecolor=colour, alpha=0.7)
    low, middle, high = np.quantile(rows.numpy(), [0.05, 0.5, 0.95], axis=0)
    axes.vlines(motors, rows.amin(0), rows.amax(0), color=GREY, linewidth=0.8)
    axes.vlines(motors, low, high, color="0.2", linewidth=2.5)
    axes.scatter(motors, middle, color="white", edgecolor="0.2", s=10, zorder=3)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    axes.set_title("dot: median, bar: 5 to 95 %")
    axes.set(xlabel="motor", ylabel="actuation")
    axes.set_xticks(motors if len(motors) <= 12 else motors[::5])
    _clean(axes)


def _draw_traces(
    figure: SubFigure,
    actuation: torch.Tensor,
    lengths: NDArray[np.int64],
    colours: NDArray[np.float64],
) -> None:
    """A short, a middling and a long episode."""
    order = np.argsort(lengths, kind="stable")
    shares = np.linspace(0.1, 0.9, TRACES) if len(lengths) >= TRACES else np.linspace(0, 1, len(lengths))
    chosen = order[np.round(shares * (len(order) - 1)).astype(int)]
    starts = lengths.cumsum() - lengths
    panels = figure.subplots(1, len(chosen), sharey=True, squeeze=False)[0]
    for axes, episode in zip(panels, chosen, strict=True):
        shown = min(int(lengths[episode]), TRACE_STEPS)
        rows = actuation[starts[episode] : starts[episode] + shown]
        for motor, colour in enumerate(colours):
            axes.plot(rows[:, motor], color=colour, linewidth=1.0)
        axes.axhline(0.0, color=GREY, linewidth=0.6)
        steps = f"{shown}" if shown == lengths[episode] else f"first {shown} of {lengths[episode]}"
        axes.set_title(f"episode {episode}, {steps} steps")
        axes.set(xlabel="step")
        _clean(axes)
    panels[0].set_ylabel("actuation, by motor")


def _clean(axes: Axes) -> None:
    axes.grid(visible=False, axis="x")


def save(figure: Figure, path: Path) -> None:
    """Write a figure to a file, with a PDF beside it, and close it."""
    save_figure(figure, path)
