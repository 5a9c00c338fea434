"""Progress bars: redrawn on a terminal, one line per minute in a log file."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm

TERMINAL, LOG = 0.1, 60.0
"""Least time between two drawings of a bar [s]."""


def progress_bar(total: int, desc: str, unit: str, **more: Any) -> tqdm[Any]:
    """A bar over ``total`` units of work.

    Args:
        total: number of units.
        desc: what is done.
        unit: what is counted, e.g. ``"step"``.
        more: further arguments of ``tqdm``.
    """
    watched = sys.stderr.isatty()
    return tqdm(
        total=total,
        desc=desc,
        unit=unit,
        mininterval=TERMINAL if watched else LOG,
        maxinterval=10.0 if watched else LOG,
        file=sys.stderr,
        **more,
    )


def show_beside(bar: tqdm[Any], **values: Any) -> None:
    """Show ``values`` beside a bar: at once on a terminal, with the next line in a log file."""
    if not bar.disable:
        bar.set_postfix(values, refresh=bar.mininterval < LOG)
