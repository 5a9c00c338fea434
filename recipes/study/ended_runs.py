"""The rows of a search's runs that have ended, and ``rows.csv``, which holds them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import cast

import pandas

from nht.recipes.run.metrics import FRAMES
from nht.recipes.study.jobs import job_name
from nht.recipes.study.results import read_results
from nht.recipes.study.rows_file import COLUMNS
from nht.writing import replacing

EndedRuns = dict[str, pandas.DataFrame]
"""The rows of runs that have ended, by the job's name."""


def known_rows(folder: Path, retry_failed: bool) -> EndedRuns:
    """The rows in ``rows.csv``: with the manifest they are all that another machine needs to continue the search.

    With ``retry_failed``, runs that failed or diverged are dropped.
    """
    if not (folder / "rows.csv").exists():
        return {}
    found = read_results(folder / "rows.csv").rows
    known = {}
    for place, rows in found.groupby(["stage", "interface", "configuration", "seed"], sort=False):
        stage, interface, configuration, seed = cast(tuple[str, str, int, int], place)
        name = job_name(stage, interface, configuration, seed)
        if retry_failed and rows["status"].iloc[0] != "done":
            shutil.rmtree(folder / name, ignore_errors=True)
        else:
            known[name] = rows.dropna(axis="columns", how="all")
    return known


def together(ended: EndedRuns) -> pandas.DataFrame:
    """All rows, in the order of stages, configurations and seeds, whichever ended first."""
    rows = pandas.concat(list(ended.values()), ignore_index=True)
    rows = rows.reindex(columns=[*COLUMNS, *sorted(set(rows.columns) - set(COLUMNS))])
    late = rows["stage"].eq("best").rename("late")
    order = rows.assign(late=late).sort_values(["late", "configuration", "seed", "interface", FRAMES]).index
    return rows.loc[order].reset_index(drop=True)


def write_rows(folder: Path, ended: EndedRuns) -> None:
    """Replace ``rows.csv``, whole or not at all."""
    with replacing(folder / "rows.csv") as scratch:
        together(ended).to_csv(scratch, index=False)
