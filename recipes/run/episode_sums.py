"""Return and length of the episodes of training, from batches that cut them anywhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


class EpisodeSums:
    """Adds up the rewards and steps of the episodes that are going on in every copy of a task.

    Args:
        shape: of the copies, ``(copies,)``, or ``(learners, copies)``.
    """

    def __init__(self, shape: Sequence[int]) -> None:
        self._running = torch.zeros(2, *shape, dtype=torch.float64)  # rewards and steps so far

    def ended(self, reward: Tensor, done: Tensor, rows: slice = slice(None)) -> Tensor:
        """Sums of return and length over the episodes that end in a batch, ``(2,)``, or ``(2, learners)``.

        Args:
            reward: of every step ``(*learners, copies, T)``.
            done: whether an episode ends there; ``(*learners, copies, T)``.
            rows: the copies that the batch comes from.
        """
        if self._running.device != reward.device:
            self._running = self._running.to(reward.device)
        steps = torch.ones_like(reward, dtype=torch.float64)
        sums = torch.stack([reward.double(), steps]).cumsum(-1)
        running = self._running[..., rows].clone()
        place = torch.arange(1, done.shape[-1] + 1, device=done.device)
        last = (done * place).amax(-1)  # 0: no end
        index = (last - 1).clamp_min(0).expand(2, *last.shape).unsqueeze(-1)
        # Sums of consecutive episodes: all steps up to the last end are of some episode that has ended.
        until = torch.where(last > 0, sums.gather(-1, index).squeeze(-1), 0.0)
        self._running[..., rows] = sums[..., -1] - until + torch.where(last > 0, 0.0, running)
        return torch.where(last > 0, until + running, 0.0).sum(-1)

    def forget(self) -> None:
        """What has been added up so far is not known: the episodes that are going on have no return."""
        self._running.fill_(torch.nan)

    def state_dict(self) -> dict[str, Any]:
        """The sums of the episodes that are going on."""
        return {"running": self._running.clone()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from ``saved``; earlier versions counted none, and then they are forgotten.

        Raises:
            ValueError: if it is of other copies.
        """
        if "running" not in saved:
            self.forget()
            return
        running = torch.as_tensor(saved["running"])
        if running.shape != self._running.shape:
            raise ValueError(
                f"sums of episodes are {tuple(running.shape)}, expected {tuple(self._running.shape)}."
            )
        self._running = running.to(torch.float64).clone()
