"""The record of a run: counted steps, rows of metrics, and a progress bar."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pandas
from tensordict import TensorDictBase
from tqdm import tqdm

from nht.recipes.progress_bar import progress_bar, show_beside
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.evaluation import Policy, evaluate
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.metrics import RETURN, SUCCESS, UPDATES, tested
from nht.recipes.run.population import PopulationFolder
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.statistics import Counters, TrainingStatistics


class Record:
    """Counts a run's steps and updates, and writes a row of metrics at every evaluation.

    Args:
        folder: where the rows go.
        ranks: the processes whose counts are added up.
        envs: the run's environments.
        losses: names of the values that an update reports; each becomes a column of ``metrics.csv``.

    Attributes:
        counters: environment steps (of all processes) and gradient steps so far, of each learner.
        statistics: sums since the last row.
    """

    def __init__(
        self, folder: RunFolder | PopulationFolder, ranks: Ranks, envs: RunEnvs, losses: Sequence[str]
    ) -> None:
        self._folder, self._ranks, self._envs = folder, ranks, envs
        self.counters = Counters()
        bounds = envs.train.base_env.action_spec.space
        self.statistics = TrainingStatistics(bounds, losses, envs.learners)
        self._total, self._every = folder.config.algo.total_frames, folder.config.evaluation.every
        self._bar: tqdm[Any] | None = None

    @property
    def frames(self) -> int:
        """Environment steps so far."""
        return self.counters.frames

    @property
    def finished(self) -> bool:
        """Whether all steps are made."""
        return self.counters.frames >= self._total

    @property
    def evaluation_due(self) -> bool:
        """Whether it is time to test the policy."""
        return self.counters.frames % self._every == 0

    def show_progress(self) -> None:
        """Show the progress bar, starting from the current step."""
        self._bar = progress_bar(
            self._total,
            self._folder.path.name,
            "step",
            unit_scale=True,
            initial=self.counters.frames,
            disable=not self._ranks.first,
        )

    def count_steps(self, data: TensorDictBase) -> None:
        """Count collected steps ``(copies, T)``, or ``(learners, copies, T)``."""
        learners = self._envs.learners
        steps = data.numel() // (learners or 1) * self._ranks.size
        self.counters.frames += steps
        self.statistics.add_steps(data.reshape(-1) if learners is None else data.flatten(1, 2))
        if self._bar is not None:
            self._bar.update(steps)

    def count_update(self, losses: TensorDictBase) -> None:
        """Count a gradient step and add up its losses."""
        self.counters.updates += 1
        self.statistics.add_losses(losses)

    def evaluate(self, policy: Policy) -> None:
        """Test the policy, and write a row of metrics: the training of all processes since the last one, and the test.

        Raises:
            FloatingPointError: if training has diverged, that of all learners.
        """
        outcomes = evaluate(self._envs.final_test if self.finished else self._envs.test, policy).each()
        trained = self.statistics.take(self._ranks.sum)
        rows = [
            found
            if isinstance(found, FloatingPointError)
            else found | outcome.metrics() | {UPDATES: self.counters.updates}
            for found, outcome in zip(trained, outcomes, strict=True)
        ]
        self._folder.log_each(self.counters.frames, rows)
        if self._bar is not None:
            means = pandas.DataFrame([row for row in rows if isinstance(row, dict)]).mean()
            shown = {RETURN: means[tested(RETURN)]}
            if means[tested(SUCCESS)] > 0:  # never, where a task has no notion of success
                shown[SUCCESS] = means[tested(SUCCESS)]
            show_beside(self._bar, **shown)

    def close(self) -> None:
        """Close the progress bar."""
        if self._bar is not None:
            self._bar.close()
