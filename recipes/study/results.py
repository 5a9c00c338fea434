"""The results of a search, from its raw rows."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas
from scipy import stats

from nht.recipes.run.metrics import SUCCESS, tested
from nht.recipes.study.rows_file import COLUMNS, CORE_SECONDS, MAP_ERROR, read_rows
from nht.recipes.study.scores import Scores

OUR_INTERFACE = "nht"


@dataclass(frozen=True)
class SearchResults:
    """Rows of a search, and the final score of every run.

    Attributes:
        rows: one row per evaluation.
        runs: one row per run, with its ``score``: the last evaluation, or the worst of all if it did not reach its end.
        metric: ``success`` or ``return``.
    """

    rows: pandas.DataFrame
    runs: pandas.DataFrame
    metric: str

    @classmethod
    def of(cls, rows: pandas.DataFrame) -> SearchResults:
        """The results in rows that have been checked."""
        metric = str(rows["metric"].iloc[0])
        return cls(rows, final_scores(rows, metric), metric)

    @property
    def interfaces(self) -> list[str]:
        """The interfaces in the order of the rows, ours first."""
        found = list(dict.fromkeys(self.rows["interface"]))
        return sorted(found, key=lambda name: name != OUR_INTERFACE)

    @property
    def parameters(self) -> list[str]:
        """The hyperparameters that were drawn."""
        return [name for name in self.rows.columns if name not in (*COLUMNS, CORE_SECONDS, MAP_ERROR)]

    def stage(self, stage: str) -> pandas.DataFrame:
        """The runs of a stage."""
        return self.runs[self.runs["stage"] == stage]

    def table(self, interface: str) -> pandas.DataFrame:
        """Final scores of the search: a row per configuration that has all seeds, a column per seed."""
        runs = self.stage("search")
        own = runs[runs["interface"] == interface]
        return own.pivot(index="configuration", columns="seed", values="score").dropna()

    def scores(self, interface: str) -> Scores:
        """Final scores as an array ``(configurations, seeds)``."""
        return self.table(interface).to_numpy()

    def best(self, interface: str) -> tuple[int, pandas.DataFrame, bool]:
        """The configuration with the best mean, the evaluations of its runs, and whether these are on fresh seeds."""
        table = self.table(interface)
        number = int(table.index.to_numpy()[table.to_numpy().mean(1).argmax()])
        of_it = self.rows[(self.rows["interface"] == interface) & (self.rows["configuration"] == number)]
        fresh = of_it[of_it["stage"] == "best"]
        return number, (fresh if len(fresh) else of_it[of_it["stage"] == "search"]), bool(len(fresh))

    def configurations(self, interface: str) -> pandas.DataFrame:
        """A row per configuration of an interface: its hyperparameters, its maps' error if known, its mean score."""
        runs = self.stage("search")
        grouped = runs[runs["interface"] == interface].groupby("configuration")
        means = [name for name in (MAP_ERROR, "score") if name in runs.columns]
        return grouped[self.parameters].first().join(grouped[means].mean())

    def correlations(self) -> pandas.DataFrame:
        """Spearman's rank correlation of each numeric hyperparameter with the configurations' scores, by interface.

        Below them that of the maps' held-out error, if it is known.
        """
        table: dict[str, dict[str, float]] = {}
        for interface in self.interfaces:
            means = self.configurations(interface)
            causes = means.drop(columns="score")
            numeric = causes.select_dtypes("number").dropna(axis="columns", how="all")
            table[interface] = {
                str(name): float(stats.spearmanr(values, means["score"]).statistic)
                for name, values in numeric.items()
                if values.nunique() > 1 and means["score"].nunique() > 1
            }
        known = [*self.parameters, MAP_ERROR]
        drawn = [name for name in known if any(name in column for column in table.values())]
        return pandas.DataFrame(table).reindex(drawn)


def read_results(file: Path) -> SearchResults:
    """Read ``rows.csv``. Raises as ``read_rows`` does."""
    return SearchResults.of(read_rows(file))


def final_scores(rows: pandas.DataFrame, metric: str) -> pandas.DataFrame:
    """The last evaluation of every run as its ``score``; for a run that did not reach its end, the worst of all."""
    runs = rows.groupby(["stage", "interface", "configuration", "seed"], sort=False).tail(1).copy()
    score = runs[tested(metric)].astype(float)
    worst = 0.0 if metric == SUCCESS else score.min()
    return runs.assign(score=np.where((runs["status"] == "done") & score.notna(), score, worst))
