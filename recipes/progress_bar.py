"""Progress bars: redrawn on a terminal, one plain line per minute in a log file."""

from __future__ import annotations

import re
import sys
from typing import Any, TextIO

from tqdm import tqdm

TERMINAL, LOG = 0.1, 60.0
"""Least time between two drawings of a bar [s]."""
LOG_LINE = "{desc}: {percentage:3.0f} %, {n_fmt} of {total_fmt} [{elapsed}<{remaining}, {rate_fmt}{postfix}]"
"""A line in a log file."""
CONTROLS = re.compile(r"\x1b\[[0-9;]*[A-Za-z]|[\r\n]")
"""What moves a terminal's cursor."""


class Lines:
    """A log file for bars: each drawing is one line, without what moves the cursor of a terminal.

    Args:
        stream: of the log.
    """

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> None:
        """Write a drawing; what would only move the cursor is left out."""
        if line := CONTROLS.sub("", text).rstrip():
            self._stream.write(line + "\n")

    def flush(self) -> None:
        """Bring it to the file."""
        self._stream.flush()


def progress_bar(total: int, desc: str, unit: str, **more: Any) -> tqdm[Any]:
    """A bar over ``total`` units of work.

    Args:
        total: number of units.
        desc: what is done.
        unit: what is counted, e.g. ``"step"``.
        more: further arguments of ``tqdm``.
    """
    if sys.stderr.isatty():
        look: dict[str, Any] = {"mininterval": TERMINAL, "maxinterval": 10.0, "file": sys.stderr}
    else:
        look = {"mininterval": LOG, "maxinterval": LOG, "file": Lines(sys.stderr), "bar_format": LOG_LINE}
    return tqdm(total=total, desc=desc, unit=unit, **look, **more)


def show_beside(bar: tqdm[Any], **values: Any) -> None:
    """Show ``values`` beside a bar: at once on a terminal, with the next line in a log file."""
    if not bar.disable:
        bar.set_postfix(values, refresh=bar.mininterval < LOG)
