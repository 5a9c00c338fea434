"""Reads and checks ``rows.csv`` of a search: a row for each evaluation of each run."""

from __future__ import annotations

import csv
import io
from pathlib import Path

import numpy as np
import pandas

from nht.reading import read_text, shortened, shown
from nht.recipes.run.metrics import EVERY_RUN, FRAMES, RETURN, SUCCESS

COLUMNS = (
    "version",
    "metric",
    "stage",
    "env",
    "interface",
    "configuration",
    "seed",
    "status",
    "reason",
    *EVERY_RUN,
)
"""Columns of ``rows.csv``; further columns are costs, where they were recorded, and hyperparameters."""

CORE_SECONDS, MAP_ERROR = "core_seconds", "map_error"
"""A run's share of the processor time of the process that ended it [s], and held-out error of the map that it trained;
the same in all its rows."""

CHOICES = {
    "metric": (SUCCESS, RETURN),
    "stage": ("search", "best"),
    "status": ("done", "failed", "diverged"),
}
TEXTS = ("version", "reason", "env", "interface")
COUNTS = ("configuration", "seed")
NUMBERS = EVERY_RUN
"""Columns that are empty where a run failed before its first evaluation."""


def read_rows(file: Path) -> pandas.DataFrame:
    """The rows, with the right types.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no such table: not CSV, without rows, without one of the columns, with values of other
            types, with an evaluation twice, or of several versions.
    """
    text = read_text(file)
    _check_widths(file, text)
    try:
        rows = pandas.read_csv(io.StringIO(text), dtype=dict.fromkeys(TEXTS, str), index_col=False)
    except (ValueError, OverflowError) as error:  # pandas' own are ValueErrors
        raise ValueError(f"{file} is no table of a search: {shortened(error)}.") from error
    if missing := [name for name in COLUMNS if name not in rows.columns]:
        raise ValueError(f"{file} lacks the columns {missing}: it is not what a search writes.")
    if rows.empty:
        raise ValueError(f"{file} has no rows: the search has not finished a run yet.")
    rows = rows.assign(reason=rows["reason"].fillna(""))
    _check_values(file, rows)
    for name in ("version", "metric"):
        if len(found := sorted(rows[name].unique())) > 1:
            raise ValueError(f"{file} mixes rows of the {name}s {shown(found)}, which do not go together.")
    return rows


def _check_widths(file: Path, text: str) -> None:
    """Check that each line has as many values as there are columns; pandas would shift or fill them."""
    try:
        lines = csv.reader(io.StringIO(text, newline=""), strict=True)
        heading = next(lines, [])
        if len(set(heading)) < len(heading):
            raise ValueError(f"{file} has a column twice: {shown(heading, 40)}.")
        for line in lines:
            if line and len(line) != len(heading):
                raise ValueError(
                    f"{file}, line {lines.line_num}: {len(line)} values for {len(heading)} columns, it was cut short."
                )
    except csv.Error as error:
        raise ValueError(f"{file} is no table of a search: {shortened(error)}.") from None


def _check_values(file: Path, rows: pandas.DataFrame) -> None:
    for name, allowed in CHOICES.items():
        if unknown := sorted(set(rows[name].astype(str)) - set(allowed)):
            raise ValueError(f"{file}: {name} must be one of {list(allowed)}, got {shown(unknown)}.")
    for name in ("version", "env", "interface"):
        if rows[name].isna().any():
            raise ValueError(f"{file}: {name} is missing in {int(rows[name].isna().sum())} rows.")
    for name in COUNTS:
        if not pandas.api.types.is_integer_dtype(rows[name]) or (rows[name] < 0).any():
            raise ValueError(f"{file}: {name} must be a count in every row.")
    for name in rows.columns.intersection([*NUMBERS, MAP_ERROR]):
        if not pandas.api.types.is_numeric_dtype(rows[name]) or np.isinf(rows[name].astype(float)).any():
            raise ValueError(f"{file}: {name} must be a finite number, or missing, in every row.")
    if (rows[FRAMES] % 1 > 0).any() or (rows[FRAMES] < 0).any():
        raise ValueError(f"{file}: frames must be counts.")
    evaluation = ["stage", "interface", "configuration", "seed", FRAMES]
    if (twice := rows.duplicated(evaluation)).any():
        raise ValueError(f"{file} has {int(twice.sum())} evaluations twice.")
