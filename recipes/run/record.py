"""What a run says of itself: counted steps, rows of metrics, a progress bar."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from tensordict import TensorDictBase
from tqdm import tqdm

from nht.recipes.progress_bar import progress_bar, show_beside
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.evaluation import Evaluation
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.metrics import RETURN, SUCCESS, UPDATES, tested
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.statistics import Counters, TrainingStatistics


class Record:
    """Counts what a run does, and writes a row of metrics at every evaluation.

    Args:
        folder: where the rows go.
        ranks: the processes whose counts are added up.
        envs: the run's environments.
        losses: what an update reports, by name; each becomes a column of ``metrics.csv``.

    Attributes:
        counters: environment steps and gradient steps so far, the steps of all processes.
        statistics: sums since the last row.
    """

    def __init__(self, folder: RunFolder, ranks: Ranks, envs: RunEnvs, losses: Sequence[str]) -> None:
        self._folder, self._ranks = folder, ranks
        self.counters = Counters()
        self.statistics = TrainingStatistics(envs.train.base_env.action_spec.space, losses)
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
        """Draw the bar, from where the run stands."""
        self._bar = progress_bar(
            self._total,
            self._folder.path.name,
            "step",
            unit_scale=True,
            initial=self.counters.frames,
            disable=not self._ranks.first,
        )

    def count_steps(self, data: TensorDictBase) -> None:
        """Take collected steps ``(*batch,)`` into counters and statistics."""
        steps = data.numel() * self._ranks.size
        self.counters.frames += steps
        self.statistics.add_steps(data.reshape(-1))
        if self._bar is not None:
            self._bar.update(steps)

    def count_update(self, losses: TensorDictBase) -> None:
        """Take a gradient step into counters and statistics."""
        self.counters.updates += 1
        self.statistics.add_losses(losses)

    def log(self, outcome: Evaluation) -> None:
        """Write a row of metrics: the training of all processes since the last one, and an evaluation."""
        row = self.statistics.take(self._ranks.sum) | outcome.metrics() | {UPDATES: self.counters.updates}
        self._folder.log(self.counters.frames, row)
        shown = {RETURN: row[tested(RETURN)]}
        if row[tested(SUCCESS)] > 0:  # never, where a task has no notion of success
            shown[SUCCESS] = row[tested(SUCCESS)]
        if self._bar is not None:
            show_beside(self._bar, **shown)

    def close(self) -> None:
        """Leave the bar as it is."""
        if self._bar is not None:
            self._bar.close()
