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

from nht.recipes.run.metrics import CLIPPED, DIVERGED, FAILURE, SUCCESS, trained


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


class TrainingStatistics:
    """Means since the last evaluation: losses, outcomes of ended episodes, and shares of clipped and diverged steps.

    Args:
        bounds: the actuation's space in the environment, which clips at its ``low`` and ``high``, ``(*batch, n)``.
        losses: names of the losses that an update reports.
        learners: number of learners with separate means, if several: steps are ``(learners, T)``, losses
            ``(learners,)``.
    """

    def __init__(
        self, bounds: ContinuousBox, losses: Sequence[str] = (), learners: int | None = None
    ) -> None:
        self._losses = tuple(losses)
        self._low, self._high = (bound.reshape(-1, bound.shape[-1])[0] for bound in (bounds.low, bounds.high))
        self._learners = learners
        self._clear()

    def _clear(self) -> None:
        self._sums: dict[str, torch.Tensor | float] = defaultdict(float)
        self._updates = self._steps = 0
        self._episodes: torch.Tensor | int = 0

    def add_losses(self, losses: TensorDictBase) -> None:
        """Count one update; the sums stay tensors, so that nothing waits for the device."""
        self._updates += 1
        for name in self._losses:
            self._sums[name] = self._sums[name] + losses[name].detach().double()

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
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on adding to ``saved``."""
        counts = saved["counts"]
        self._updates, self._episodes, self._steps = counts["updates"], counts["episodes"], counts["steps"]
        self._sums = defaultdict(float, saved.get("sums", {}))

    def take(
        self, add: Callable[[torch.Tensor], torch.Tensor] = lambda sums: sums
    ) -> list[dict[str, float] | FloatingPointError]:
        """Return the means of every learner and reset; NaN where nothing was counted.

        Args:
            add: adds up the sums of all processes that train together.

        Returns:
            a row of metrics for each learner; an error in its place if its losses are no longer finite.
        """
        names = (SUCCESS, FAILURE, DIVERGED, CLIPPED, *self._losses)
        counted = (self._updates, self._episodes, self._steps, *(self._sums[name] for name in names))
        own = [torch.as_tensor(value, dtype=torch.float64).cpu() for value in counted]
        totals = add(torch.stack([value.expand(self._learners or 1) for value in own]))
        self._clear()
        return [
            self._row(dict(zip(names, sums, strict=True)), updates, episodes, steps)
            for updates, episodes, steps, *sums in totals.T.tolist()
        ]

    def _row(
        self, sums: dict[str, float], updates: float, episodes: float, steps: float
    ) -> dict[str, float] | FloatingPointError:
        for name, value in sums.items():
            if not math.isfinite(value):
                return FloatingPointError(f"{name} is {value}: training diverged. Lower the learning rates.")
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
        return row | {name: sums[name] / (updates or math.nan) for name in self._losses}
