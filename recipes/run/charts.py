"""What a training run shows on its dashboard, and what it takes from other runs and hands on."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas

import nht
from nht.reading import read_json
from nht.recipes.agents.policy import POLICY_FILE
from nht.recipes.run.artifacts import demos_files, map_files, policy_files
from nht.recipes.run.dashboard import Dashboard
from nht.recipes.run.demonstrations import demos_path
from nht.recipes.run.metrics import BEST, FRAMES, tested
from nht.recipes.sections import Training


class RunCharts:
    """The charts of a training run, and its artifacts.

    Args:
        dashboard: of the run.
        folder: of the run.
        config: of the run.
    """

    def __init__(self, dashboard: Dashboard, folder: Path, config: Training) -> None:
        self._dashboard, self._folder, self._config = dashboard, folder, config

    def show_origin(self, kept: Path, map: nht.ActionMap, metrics: Path) -> None:
        """Say what the run is made from: a map of another run, or demonstrations and a map of its own.

        Args:
            kept: the run's file of its map.
            map: what is in it.
            metrics: file with the metrics of its training, if the run trained it.
        """
        demos, given = demos_path(self._config), self._config.map.file
        if given is not None:
            own = nht.load_map(given, allow=[*self._config.map.allow, type(map).__module__])
            self._dashboard.take(map_files(Path(given), own))
        if (demos / "manifest.json").exists() and (given is None or _learns_from_demos(self._config)):
            hand = self._dashboard.add if self._config.demos.path is None else self._dashboard.take
            hand(demos_files(demos))
        if given is None:
            self._dashboard.add(map_files(kept, map, read_json(metrics) if metrics.exists() else None))

    def row(self, frames: int, row: Mapping[str, float], latest: Mapping[str, float] | None = None) -> None:
        """Chart a row of metrics; of training, what has been since the last row that was charted, if that is given."""
        self._dashboard.log(frames, {**row, **(latest or {})})

    def film(self, frames: int, video: Path) -> None:
        """Show a film."""
        if video.exists():
            self._dashboard.film(frames, video)

    def finish(self, frames: int, rows: pandas.DataFrame) -> None:
        """Say how the run ended, hand on its policy, and close it.

        Args:
            frames: environment steps.
            rows: of ``metrics.csv``.
        """
        self._dashboard.summarise(best_values(rows) | {f"final/{name}": v for name, v in last(rows).items()})
        if (policy := self._folder / POLICY_FILE).exists():
            best = last_is_best(rows)
            self._dashboard.add(
                policy_files(policy, self._dashboard.id, {FRAMES: frames} | last(rows), best=best)
            )
        self._dashboard.finish()

    def leave(self) -> None:
        """Close a run that stopped before its end."""
        self._dashboard.leave()


def best_values(rows: pandas.DataFrame) -> dict[str, float]:
    """The best of all tests by each outcome, and after how many environment steps it was."""
    found: dict[str, float] = {}
    for outcome, side in BEST.items():
        values = rows[tested(outcome)]
        if values.notna().any():
            place: Any = values.idxmax() if side == "max" else values.idxmin()
            found |= {f"best/{outcome}": float(values[place])}
            found |= {f"best/{outcome}_at": int(rows[FRAMES][place])}
    return found


def last(rows: pandas.DataFrame) -> dict[str, float]:
    """The outcomes of the last test."""
    return {outcome: float(rows[tested(outcome)].iloc[-1]) for outcome in BEST}


def last_is_best(rows: pandas.DataFrame) -> bool:
    """Whether no test was better than the last one: by successes, and among equals by return."""
    scores: list[Any] = [tuple(row) for row in rows[[tested("success"), tested("return")]].to_numpy()]
    return bool(scores[-1] >= max(scores))


def _learns_from_demos(config: Training) -> bool:
    demos = getattr(config.algo, "demos", None)
    return bool(demos is not None and demos.transitions)
