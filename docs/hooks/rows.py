"""Tables and numbers of the pages, made from the committed rows in ``benchmarks/results`` when the site is built.

A page whose front matter says ``rows: true`` is a Jinja template. What it can call is in ``FUNCTIONS``; a file is named
by its path below ``benchmarks/results``, and ``where`` is a condition as ``pandas.DataFrame.query`` takes it.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas
from jinja2 import Environment, StrictUndefined
from mkdocs.structure.pages import Page
from pandas import DataFrame, Series

RESULTS = Path(__file__).parents[2] / "benchmarks" / "results"
FIELD = re.compile(r"\{([^{}:]+):?([^{}]*)\}")
Rows = str | DataFrame


def on_page_markdown(markdown: str, page: Page, **_: object) -> str:
    """Fill in the tables and numbers of a page."""
    if not page.meta.get("rows"):
        return markdown
    jinja = Environment(undefined=StrictUndefined, keep_trailing_newline=True)
    return jinja.from_string(markdown).render(FUNCTIONS)


def rows(file: Rows, where: str = "") -> DataFrame:
    """The rows of a CSV file."""
    found = pandas.read_csv(RESULTS / file, comment="#") if isinstance(file, str) else file
    return found.query(where) if where else found


def table(file: Rows, columns: Mapping[str, str], where: str = "", sort: Sequence[str] = ()) -> str:
    """Rows as they are.

    Args:
        file: their file.
        columns: what is shown: the heading, and a format in which any column can stand, ``{error:.1e}``.
        where: which rows.
        sort: columns to sort by.
    """
    found = rows(file, where)
    if sort:
        found = found.sort_values(list(sort), kind="stable")
    lines = [[shown(show, row) for show in columns.values()] for row in found.to_dict("records")]
    return markdown_table(list(columns), lines)


def summary(
    file: Rows, by: Mapping[str, str], cells: Mapping[str, tuple[str, str, str]], order: Sequence[str] = ()
) -> str:
    """A line for each group of rows.

    Args:
        file: of the rows.
        by: columns that make the groups, and their headings.
        cells: by heading: a column, which of the group's rows, and a format of ``count``, ``mean``, ``median``,
            ``min``, ``max``, ``share``, which is that of the group's rows that were taken, and ``all``, the values.
        order: of the groups, by their first column; others come behind.
    """
    lines = []
    for group, part in _groups(rows(file), list(by), order):
        line = [as_text(value) for value in group]
        for column, where, show in cells.values():
            taken = part.query(where) if where else part
            line.append(shown(show, _figures(taken[column], len(part))))
        lines.append(line)
    return markdown_table([*by.values(), *cells], lines)


def grid(
    file: Rows,
    by: Mapping[str, str],
    across: str,
    value: str,
    show: str = "{mean}",
    where: str = "",
    heading: str = "{}",
    order: Sequence[str] = (),
    across_order: Sequence[Any] = (),
) -> str:
    """A line for each group of rows, a column for each value of ``across``; arguments else as of ``summary``."""
    found = rows(file, where)
    columns = list(across_order) or sorted(found[across].dropna().unique().tolist())
    lines = []
    for group, part in _groups(found, list(by), order):
        cells = [part[part[across] == column][value].dropna() for column in columns]
        figures = [shown(show, _figures(cell, len(cell))) for cell in cells]
        lines.append([as_text(entry) for entry in group] + figures)
    return markdown_table([*by.values(), *(heading.format(column) for column in columns)], lines)


def number(file: Rows, column: str, where: str = "", show: str = "{mean}") -> str:
    """A number in the text; ``show`` as in ``summary``."""
    found = rows(file)
    taken = found.query(where) if where else found
    if not len(taken):
        raise ValueError(f"{file} has no row where {where}.")
    return shown(show, _figures(taken[column], len(found)))


def entry(file: str, *keys: str) -> Any:
    """An entry of a JSON file."""
    found = json.loads((RESULTS / file).read_text())
    for key in keys:
        found = found[key]
    return found


def committed(file: str, heading: str | None = None) -> str:
    """The first table of a Markdown file, or the first one below a heading of it."""
    text = (RESULTS / file).read_text()
    if heading is not None:
        text = text.split(f"# {heading}\n", 1)[1]
    found = re.search(r"(?:^\|.*\n)+", text + "\n", re.MULTILINE)
    if found is None:
        raise ValueError(f"{file} has no table below {heading!r}.")
    return found.group()


def markdown_table(headings: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; a first cell that repeats the one above is left empty."""
    if not lines:
        raise ValueError(f"the table {list(headings)} has no rows.")
    body, above = [], None
    for first, *others in lines:
        body.append(["" if others and first == above else first, *others])
        above = first
    return (
        "\n".join("| " + " | ".join(line) + " |" for line in [headings, ["---"] * len(headings), *body])
        + "\n"
    )


def shown(show: str, values: Mapping[str, Any]) -> str:
    """Values in a format, ``{name}`` or ``{name:.2f}``, whatever a name is made of; nothing where one is missing."""
    if any(values[name] is None or values[name] != values[name] for name, _ in FIELD.findall(show)):
        return ""
    return FIELD.sub(lambda found: format(values[found.group(1)], found.group(2)), show)


def as_text(value: Any) -> str:
    """A value of a group: whole numbers with separators, others short, yes for true; nothing for false or missing."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else ""
    if isinstance(value, float) and (value != value or value != round(value) or abs(value) < 10):
        return "" if value != value else f"{value:.4g}"
    return f"{value:,.0f}" if isinstance(value, int | float) else str(value)


class _Values(list[float]):
    """Several numbers, each in the same format."""

    def __format__(self, spec: str) -> str:
        return ", ".join(format(value, spec) for value in self)


def _groups(found: DataFrame, by: list[str], order: Sequence[str]) -> list[tuple[tuple[Any, ...], DataFrame]]:
    groups = list(found.groupby(by, sort=False, dropna=False))
    place = {name: index for index, name in enumerate(order)}
    return sorted(groups, key=lambda group: place.get(group[0][0], len(place)))


def _figures(values: Series, whole: int) -> dict[str, Any]:
    numbers = values if pandas.api.types.is_numeric_dtype(values) else pandas.Series(dtype=float)
    return {
        "count": len(values),
        "share": len(values) / whole if whole else 0.0,
        "mean": numbers.mean(),
        "median": numbers.median(),
        "min": numbers.min(),
        "max": numbers.max(),
        "sum": numbers.sum() if len(values) else None,
        "all": _Values(numbers) if len(values) else None,
        "first": values.iloc[0] if len(values) else None,
        "last": values.iloc[-1] if len(values) else None,
    }


FUNCTIONS = {
    "committed": committed,
    "entry": entry,
    "grid": grid,
    "number": number,
    "rows": rows,
    "summary": summary,
    "table": table,
}
