"""One look for all figures: sizes of a paper's columns, colours for everybody, vector files beside pictures.

The colours are those of Okabe and Ito (2008), which the colour-blind can tell apart.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # no display is needed

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

COLUMN, PAGE = 3.4, 7.0
"""Widths of a paper with two columns [inch]: of a column, and of both."""
PANEL_SHAPE = 0.62
"""Height of a panel, as a share of its width."""
BLUE, ORANGE, GREEN, RED, SKY, PURPLE = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7")
PALETTE = (BLUE, ORANGE, GREEN, RED, SKY, PURPLE, "#000000")
"""Without their yellow, which is too light for a line on white."""
DASHES = ("-", "--", ":")
GREY = "0.55"
LOOK: Any = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.titlelocation": "left",
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": f"cycler('color', {list(PALETTE)})",
    "grid.alpha": 0.3,
    "grid.linewidth": 0.5,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "lines.linewidth": 1.2,
    "lines.markersize": 3,
    "pdf.fonttype": 42,  # text that can be searched and edited
    "savefig.dpi": 300,
    "svg.hashsalt": "nht",  # the same figure is the same file
}
SAME: dict[str, dict[str, Any]] = {
    ".png": {"Software": None},
    ".svg": {"Date": None, "Creator": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
}
"""What would differ between two files of the same figure, left out."""


@contextmanager
def style() -> Iterator[None]:
    """Within, figures have this look."""
    with plt.rc_context(LOOK):
        yield


def save_figure(figure: Canvas, path: str | Path, *more: str) -> None:
    """Write a figure as PNG, as PDF beside it, and with ``more`` suffixes such as ``".svg"``; then close it.

    The same figure gives the same files, byte for byte.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with style():
        for suffix in dict.fromkeys([path.suffix, ".pdf", *more]):
            figure.savefig(path.with_suffix(suffix), metadata=SAME.get(suffix))
            figure.set_layout_engine("none")  # what was placed for the first file stays there in the others
    plt.close(figure)


def looks(count: int) -> list[dict[str, Any]]:
    """Colour and dashes of ``count`` lines that can be told apart: each colour once, then dashed, then dotted."""
    pairs = ((colour, dash) for dash in cycle(DASHES) for colour in PALETTE)
    return [{"color": colour, "linestyle": dash} for colour, dash in islice(pairs, count)]


def thousands(axes: Axes) -> None:
    """Environment steps from 0 on: 50k, 2M."""
    axes.set_xlim(left=0)
    axes.xaxis.set_major_formatter(lambda value, _: short(value))


def short(steps: float) -> str:
    """A number of steps: 200, 50k, 2.5M."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(steps) >= size:
            return f"{steps / size:.3g}{letter}"
    return f"{steps:.3g}"


def label_ends(axes: Axes, gap: float = 8.5) -> None:
    """Write each line's label at its right end, in its colour: no legend hides a line.

    Args:
        axes: whose lines have labels; their limits are final.
        gap: least distance between two labels [points].
    """
    lines = [line for line in axes.lines if not str(line.get_label()).startswith("_")]
    lines = [line for line in lines if np.isfinite(np.asarray(line.get_ydata(), dtype=float)).any()]
    if not lines:
        return
    axes.figure.canvas.draw()  # places the axes
    height = axes.get_window_extent().height / axes.figure.dpi * 72
    ends = [_last(np.asarray(line.get_ydata(), dtype=float)) for line in lines]
    places = axes.transAxes.inverted().transform(axes.transData.transform([(0, end) for end in ends]))[:, 1]
    for line, place in zip(lines, spread(places.tolist(), gap / height), strict=True):
        axes.text(
            1.02,
            place,
            str(line.get_label()),
            color=line.get_color(),
            transform=axes.transAxes,
            va="center",
            fontsize=7,
        )


def spread(places: Sequence[float], gap: float) -> NDArray[np.float64]:
    """Places (N,) moved as little as needed, in their order, so that none is nearer to another than ``gap``.

    Groups that would overlap are laid out around their mean (the pool of adjacent violators, Barlow et al. 1972).
    """
    order = np.argsort(places, kind="stable")
    wanted = np.asarray(places, dtype=float)[order] - gap * np.arange(len(order))
    pools: list[tuple[float, int]] = []
    for value in wanted:
        pools.append((float(value), 1))
        while len(pools) > 1 and pools[-2][0] > pools[-1][0]:
            (one, few), (other, more) = pools[-2:]
            pools[-2:] = [((one * few + other * more) / (few + more), few + more)]
    moved = np.repeat([mean for mean, _ in pools], [count for _, count in pools]) + gap * np.arange(
        len(order)
    )
    result = np.empty(len(order))
    result[order] = moved
    return result


def _last(values: NDArray[np.float64]) -> float:
    return float(values[np.isfinite(values)][-1])
