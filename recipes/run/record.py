"""The record of a run: counted steps, rows of metrics, and a progress bar."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import pandas
from tensordict import TensorDictBase
from tqdm import tqdm

from nht.recipes.progress_bar import progress_bar, show_beside
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.evaluation import Policy, evaluate
from nht.recipes.run.filming import Filming
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.metrics import (
    FRAMES_PER_SECOND,
    RETURN,
    SUCCESS,
    UPDATES,
    UPDATES_PER_SECOND,
    tested,
)
from nht.recipes.run.population import PopulationFolder
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.statistics import Counters, TrainingStatistics


class Record:
    """Counts a run's steps and updates, and writes a row of metrics at every evaluation; W&B gets rows in between, too.

    Args:
        folder: where the rows go.
        ranks: the processes whose counts are added up.
        envs: the run's environments.
        losses: names of the values that an update reports; each becomes a column of ``metrics.csv``.

    Attributes:
        counters: environment steps (of all processes) and gradient steps so far, of each learner.
        statistics: sums since the last row.
        gradient_norms: gives more columns of every learner; none, unless a recipe sets it.
        copies: the copies of this process that the latest batch comes from.
    """

    def __init__(
        self, folder: RunFolder | PopulationFolder, ranks: Ranks, envs: RunEnvs, losses: Sequence[str]
    ) -> None:
        self._folder, self._ranks, self._envs = folder, ranks, envs
        self.counters = Counters()
        bounds = envs.train.base_env.action_spec.space
        self.statistics = TrainingStatistics(bounds, losses, envs.learners, envs.copies)
        self.gradient_norms: Callable[[], Sequence[dict[str, float]]] = lambda: [{}] * (envs.learners or 1)
        self.copies = slice(None)
        self._total, self._every = folder.config.algo.total_frames, folder.config.evaluation.every
        self._charted_every = folder.config.charted_every
        self._charted = ranks.any(folder.charted)  # in all processes, as they add up together
        self._filming = Filming(folder, ranks, envs)
        self._clock = Clock(self.counters)
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
        self._clock = Clock(self.counters)
        self._bar = progress_bar(
            self._total,
            self._folder.path.name,
            "step",
            unit_scale=True,
            initial=self.counters.frames,
            disable=not self._ranks.first,
        )

    def count_steps(self, data: TensorDictBase) -> None:
        """Count collected steps ``(copies, T)``, or ``(learners, copies, T)``; chart what came before if it is time."""
        frames, learners = self.counters.frames, self._envs.learners
        if self._charted and frames and frames % self._charted_every == 0 and not self.evaluation_due:
            self._folder.chart_each(frames, self._latest())
        steps = data.numel() // (learners or 1) * self._ranks.size
        self.counters.frames += steps
        self.statistics.add_steps(data.reshape(-1) if learners is None else data.flatten(1, 2))
        self.statistics.add_returns(data, self.copies)
        if self._bar is not None:
            self._bar.update(steps)

    def count_update(self, losses: TensorDictBase) -> None:
        """Count a gradient step and add up its losses."""
        self.counters.updates += 1
        self.statistics.add_losses(losses)

    def _latest(self) -> list[dict[str, float]]:
        """What W&B gets of training since the last time, for every learner; nothing of one that diverged."""
        rates = self._clock.rates()
        found = zip(self.statistics.latest(self._ranks.sum), self.gradient_norms(), strict=True)
        return [
            {}
            if isinstance(row, FloatingPointError)
            else row | norms | rates | {UPDATES: self.counters.updates}
            for row, norms in found
        ]

    def evaluate(self, policy: Policy) -> None:
        """Test the policy, and write a row of metrics: the training of all processes since the last one, and the test.

        Raises:
            FloatingPointError: if training has diverged, that of all learners.
        """
        latest = self._latest() if self._charted else []
        outcomes = evaluate(self._envs.final_test if self.finished else self._envs.test, policy).each()
        trained = self.statistics.take(self._ranks.sum)
        rows = [
            found
            if isinstance(found, FloatingPointError)
            else found | norms | outcome.metrics() | {UPDATES: self.counters.updates}
            for found, norms, outcome in zip(trained, self.gradient_norms(), outcomes, strict=True)
        ]
        self._folder.log_each(self.counters.frames, rows, latest)
        self._filming.on_the_way(policy, self.counters.frames)
        self._clock.start()
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


class Clock:
    """How fast training goes on, tests left out.

    Args:
        counters: of the run.
    """

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self.start()

    def start(self) -> None:
        """Count from now on."""
        self._since = time.perf_counter()
        self._frames, self._updates = self._counters.frames, self._counters.updates

    def rates(self) -> dict[str, float]:
        """Environment steps and gradient steps a second since the last time."""
        seconds = max(time.perf_counter() - self._since, 1e-9)
        rates = {
            FRAMES_PER_SECOND: (self._counters.frames - self._frames) / seconds,
            UPDATES_PER_SECOND: (self._counters.updates - self._updates) / seconds,
        }
        self.start()
        return rates
