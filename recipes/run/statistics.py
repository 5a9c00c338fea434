"""Counts and means of training between two evaluations."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torchrl.data.tensor_specs import ContinuousBox

from nht.recipes.run.episode_sums import EpisodeSums
from nht.recipes.run.metrics import CLIPPED, DIVERGED, FAILURE, LENGTH, RETURN, SUCCESS, VALUE, trained

SAMPLED = 10
"""Updates between two looks at the value: a mean over a minibatch each time would show in the cost of an update."""

TARGET = "target_value"
"""What the critics learn to predict, ``(B,)``, among the values that an update reports."""

Totals = dict[str, torch.Tensor | float]
Means = dict[str, float]


@dataclass
class Counters:
    """Numbers of environment steps and gradient steps so far; part of checkpoints."""

    frames: int = 0
    updates: int = 0

    def state_dict(self) -> dict[str, int]:
        """The counters by name."""
        return asdict(self)

    def load_state_dict(self, saved: dict[str, int]) -> None:
        """Go on counting from ``saved``."""
        self.frames, self.updates = saved["frames"], saved["updates"]


def _value(losses: TensorDictBase) -> torch.Tensor | None:
    """The mean of what the critics learn to predict: a loss gives it where minibatches of learners differ in size."""
    value: torch.Tensor | None = losses.get(VALUE, None)
    target: torch.Tensor | None = losses.get(TARGET, None) if value is None else None
    return value if target is None else target.mean(-1)


class TrainingStatistics:
    """Means since the last evaluation: losses, outcomes of ended episodes, and shares of clipped and diverged steps.

    Args:
        bounds: the actuation's space in the environment, which clips at its ``low`` and ``high``, ``(*batch, n)``.
        losses: names of the losses that an update reports.
        learners: number of learners with separate means, if several: steps are ``(learners, T)``, losses
            ``(learners,)``.
        copies: number of copies of the task, of each learner; None leaves out returns and lengths of episodes.
    """

    def __init__(
        self,
        bounds: ContinuousBox,
        losses: Sequence[str] = (),
        learners: int | None = None,
        copies: int | None = None,
    ) -> None:
        self._losses = tuple(losses)
        self._low, self._high = (bound.reshape(-1, bound.shape[-1])[0] for bound in (bounds.low, bounds.high))
        self._learners = learners
        shape = [size for size in (learners, copies) if size is not None]
        self._episode_sums = None if copies is None else EpisodeSums(shape)
        self._clear()

    def _clear(self) -> None:
        self._sums: Totals = defaultdict(float)
        self._updates = self._steps = 0
        self._episodes: torch.Tensor | int = 0
        self._shown: Totals = {}

    def add_losses(self, losses: TensorDictBase) -> None:
        """Count one update; the sums stay tensors, so that nothing waits for the device."""
        looks = self._updates % SAMPLED == 0  # at the first update already: a row then has a value
        self._updates += 1
        for name in self._losses:
            self._sums[name] = self._sums[name] + losses[name].detach().double()
        if looks and (value := _value(losses)) is not None:
            self._sums[VALUE] = self._sums[VALUE] + value.detach().double()

    def add_steps(self, steps: TensorDictBase) -> None:
        """Count the episodes that end among ``(T,)`` collected steps, copies that diverged and clipped actuations.

        The sums stay tensors, as those of losses.
        """
        outcome = steps["next"]
        done, actuation = outcome["done"], outcome["actuation"]
        self._steps += steps.shape[-1]
        clipped = ((actuation <= self._low) | (actuation >= self._high)).any(-1, keepdim=True)
        self._episodes = self._episodes + self._count(done)
        self._add(CLIPPED, clipped)
        for name in (SUCCESS, FAILURE):
            self._add(name, outcome[name] & done)
        self._add(DIVERGED, outcome[DIVERGED])

    def add_returns(self, steps: TensorDictBase, rows: slice = slice(None)) -> None:
        """Count return and length of the episodes that end among steps ``(*learners, copies, T)`` of some copies."""
        if self._episode_sums is None:
            return
        outcome = steps["next"]
        ended = self._episode_sums.ended(outcome["reward"].squeeze(-1), outcome["done"].squeeze(-1), rows)
        for name, total in zip((RETURN, LENGTH), ended, strict=True):
            self._sums[name] = self._sums[name] + total

    def forget_episodes(self) -> None:
        """The episodes that were going on are not gone on with: they have no return."""
        if self._episode_sums is not None:
            self._episode_sums.forget()

    def _add(self, name: str, flags: torch.Tensor) -> None:
        self._sums[name] = self._sums[name] + self._count(flags)

    def _count(self, flags: torch.Tensor) -> torch.Tensor:
        """The number of true flags ``(T, 1)``; for several learners, the number of each."""
        return flags.squeeze(-1).sum(-1).double()

    def state_dict(self) -> dict[str, Any]:
        """The sums so far."""
        episodes = torch.as_tensor(self._episodes)
        counts = {
            "updates": self._updates,
            "episodes": int(episodes) if self._learners is None else episodes,  # of each of them
            "steps": self._steps,
        }
        return {
            "counts": counts,
            "sums": {name: torch.as_tensor(total) for name, total in self._sums.items()},
            "shown": {name: torch.as_tensor(total) for name, total in self._shown.items()},
            "going_on": {} if self._episode_sums is None else self._episode_sums.state_dict(),
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on adding to ``saved``."""
        counts = saved["counts"]
        self._updates, self._episodes, self._steps = counts["updates"], counts["episodes"], counts["steps"]
        self._sums = defaultdict(float, saved.get("sums", {}))
        self._shown = dict(saved.get("shown", {}))
        if self._episode_sums is not None:
            self._episode_sums.load_state_dict(saved.get("going_on", {}))

    def take(
        self, add: Callable[[torch.Tensor], torch.Tensor] = lambda sums: sums
    ) -> list[Means | FloatingPointError]:
        """Return the means of every learner and reset; NaN where nothing was counted.

        Args:
            add: adds up the sums of all processes that train together.

        Returns:
            a row of metrics for each learner; an error in its place if its losses are no longer finite.
        """
        totals = self._totals()
        self._clear()
        return self._rows(totals, add)

    def latest(
        self, add: Callable[[torch.Tensor], torch.Tensor] = lambda sums: sums
    ) -> list[Means | FloatingPointError]:
        """The means since this was last called, or since ``take``, which does not notice. As of ``take``."""
        totals, before = self._totals(), self._shown
        self._shown = totals
        return self._rows({name: total - before.get(name, 0.0) for name, total in totals.items()}, add)

    def _totals(self) -> Totals:
        """What has been counted so far, by name; the same names in all processes."""
        returns = (RETURN, LENGTH) if self._episode_sums is not None else ()
        names = (SUCCESS, FAILURE, DIVERGED, CLIPPED, *self._losses, *returns, VALUE)
        counted: Totals = {"updates": self._updates, "episodes": self._episodes, "steps": self._steps}
        counted["sampled"] = -(-self._updates // SAMPLED) if VALUE in self._sums else 0
        return counted | {f"sum of {name}": self._sums.get(name, 0.0) for name in names}

    def _rows(
        self, totals: Totals, add: Callable[[torch.Tensor], torch.Tensor]
    ) -> list[Means | FloatingPointError]:
        own = [torch.as_tensor(value, dtype=torch.float64).cpu() for value in totals.values()]
        summed = add(torch.stack([value.expand(self._learners or 1) for value in own]))
        return [self._row(dict(zip(totals, values, strict=True))) for values in summed.T.tolist()]

    def _row(self, totals: dict[str, float]) -> Means | FloatingPointError:
        updates, episodes, steps, sampled = (
            totals.pop(name) for name in ("updates", "episodes", "steps", "sampled")
        )
        sums = {name.removeprefix("sum of "): total for name, total in totals.items()}
        for name in (SUCCESS, FAILURE, DIVERGED, CLIPPED, *self._losses):
            if not math.isfinite(sums[name]):
                return FloatingPointError(
                    f"{name} is {sums[name]}: training diverged. Lower the learning rates."
                )
        if steps and sums[DIVERGED] >= steps:
            return FloatingPointError(
                f"every one of {steps:.0f} steps diverged: actuations or physics are not finite. Look at the map."
            )
        row = {
            trained(SUCCESS): sums[SUCCESS] / (episodes or math.nan),
            trained(FAILURE): sums[FAILURE] / (episodes or math.nan),
            DIVERGED: sums[DIVERGED],  # a count: each one is a failure of map, policy or physics
            CLIPPED: sums[CLIPPED] / (steps or math.nan),  # steps with a motor at its limit
        }
        row |= {name: sums[name] / (updates or math.nan) for name in self._losses}
        if self._episode_sums is not None:
            row |= {trained(name): sums[name] / (episodes or math.nan) for name in (RETURN, LENGTH)}
        return row | ({VALUE: sums[VALUE] / (sampled or math.nan)} if self._losses else {})
