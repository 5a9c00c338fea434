"""Writes, reads and checks ``metrics.csv`` of a run: a row for each evaluation, with growing numbers of steps."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path

import pandas

from nht.reading import read_text, shortened, shown
from nht.recipes.run.metrics import FRAMES, SECONDS


def read_metrics(file: Path) -> tuple[list[str], list[list[str]]]:
    """The heading and the rows as text; a row that a kill cut short is left out.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no table of metrics: it has another heading, or a value that is no number; says in which
            line.
    """
    try:
        lines = list(csv.reader(io.StringIO(read_text(file), newline=""), strict=True))
    except csv.Error as error:
        raise ValueError(f"{file} is no table of metrics: {shortened(error)}.") from None
    heading, rows = (lines[0], lines[1:]) if lines else ([], [])
    whole = [(number, row) for number, row in enumerate(rows, 2) if len(row) == len(heading)]
    short = [number for number, row in enumerate(rows, 2) if row and len(row) != len(heading)]
    if any(number <= len(rows) for number in short):  # only the last line can have been cut by a kill
        raise ValueError(f"{file}, line {short[0]}: it has another number of values than the heading.")
    if whole and (heading[0] != FRAMES or SECONDS not in heading or len(set(heading)) < len(heading)):
        raise ValueError(
            f"{file} has the columns {shown(heading)}, expected {FRAMES!r} first, and {SECONDS!r}."
        )
    before = -1
    for number, row in whole:
        _check_row(file, number, heading, row)
        if int(row[0]) <= before:
            raise ValueError(f"{file}, line {number}: {FRAMES} must grow, got {row[0]} after {before}.")
        before = int(row[0])
    return heading, [row for _, row in whole]


def metrics_table(file: Path) -> pandas.DataFrame:
    """The table of metrics as numbers, a column for each name of the heading."""
    heading, rows = read_metrics(file)
    table = pandas.DataFrame(rows, columns=heading or [FRAMES]).astype(float)
    return table.astype({FRAMES: int})


def append_row(file: Path, row: Mapping[str, float]) -> None:
    """Append a row of metrics. A file of an earlier version keeps its columns: others are left out, missing are NaN."""
    with file.open("a+", newline="") as opened:
        opened.seek(0)
        heading = next(csv.reader(opened), None)
        opened.seek(0, io.SEEK_END)
        writer = csv.DictWriter(opened, heading or list(row), restval="nan", extrasaction="ignore")
        if heading is None:
            writer.writeheader()
        writer.writerow(row)


def _check_row(file: Path, number: int, heading: list[str], row: list[str]) -> None:
    for name, value in zip(heading, row, strict=True):
        try:
            int(value) if name == FRAMES else float(value)
        except ValueError:
            kind = "a number of steps" if name == FRAMES else "a number"
            raise ValueError(
                f"{file}, line {number}: {name} must be {kind}, got {shortened(value, 60)!r}."
            ) from None
    if int(row[0]) < 0:
        raise ValueError(f"{file}, line {number}: {FRAMES} must not be negative, got {row[0]}.")
