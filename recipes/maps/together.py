"""The maps of several runs: those of one kind on the same demonstrations are trained together."""

from __future__ import annotations

from collections.abc import Hashable, Sequence

import nht
from nht.recipes.maps.interface import run_map, trained_maps
from nht.recipes.maps.kinds import find_kind, map_context_keys
from nht.recipes.sections import Training
from nht.train_together import SHARING


class MapsOfRuns:
    """Gives each run what ``run_map`` gives it; the first that asks has the maps of all others like it trained, too.

    Args:
        runs: whose maps are yet to be made.
    """

    def __init__(self, runs: Sequence[Training]) -> None:
        self._alike: dict[Hashable, list[Training]] = {}
        for run in runs:
            if (kind := _likeness(run)) is not None:
                self._alike.setdefault(kind, []).append(run)
        self._trained: dict[str, nht.MapTraining | FloatingPointError] = {}

    def __call__(self, run: Training, motors: int) -> nht.MapTraining:
        """The map of a run, and what its training gave.

        Args:
            run: one of the runs.
            motors: n, of the task.

        Raises:
            FloatingPointError: if the training of this very map diverged.
            FileNotFoundError, ValueError: as ``run_map``.
        """
        together = self._alike.pop(_likeness(run), [])
        if len(together) > 1:
            found = trained_maps(
                [each.map for each in together], run.env, run.demos, [each.seed for each in together]
            )
            self._trained |= {each.run.folder: map for each, map in zip(together, found, strict=True)}
        if run.run.folder not in self._trained:
            return run_map(run, motors)
        trained = self._trained.pop(run.run.folder)
        if isinstance(trained, FloatingPointError):
            raise trained
        return trained


def _likeness(run: Training) -> Hashable:
    """The same for runs whose maps can be trained together; None for a map that is trained alone, or not at all."""
    map = run.map
    if map.file is not None or run.demos.path is None or find_kind(map.kind).map_class not in SHARING:
        return None
    seen = tuple(map_context_keys(map, run.env))
    return map.kind, map.action_dim, map.offset, run.env.name, seen, run.demos.path
