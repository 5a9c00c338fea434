"""Behaviour cloning on demonstrated actions beside an actor's own loss (Nair et al. 2018)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor

from nht.recipes.agents.off_policy import mean_over
from nht.recipes.sections import ReplayDemosConfig


@dataclass
class ClonedDemosConfig(ReplayDemosConfig):
    """Demonstrations that a deterministic actor may also imitate."""

    cloning: float = 0.0  # weight of the squared distance to demonstrated actions in the actor's loss
    cloning_frames: int | None = None  # environment steps in which that weight falls to 0; None is never
    q_filter: bool = False  # imitate only where the critic prefers the demonstrated action

    def __post_init__(self) -> None:
        """Raise ValueError for a weight or duration that is none, or nothing to imitate."""
        super().__post_init__()
        if not 0 <= self.cloning < float("inf"):
            raise ValueError(f"algo.demos.cloning must be at least 0 and finite, got {self.cloning}.")
        if self.cloning_frames is not None and self.cloning_frames < 1:
            raise ValueError(f"algo.demos.cloning_frames must be at least 1, got {self.cloning_frames}.")
        if self.cloning and not self.share:
            raise ValueError(
                f"algo.demos.cloning={self.cloning} imitates the demonstrations of a minibatch: set algo.demos.share, "
                "too."
            )
        if not self.cloning and (self.q_filter or self.cloning_frames is not None):
            raise ValueError("algo.demos.q_filter and algo.demos.cloning_frames need algo.demos.cloning.")


class Cloning:
    """The term that an actor's loss gets for the demonstrated steps D of a minibatch.

        w mean_D |pi(s) - a|^2,   with a Q-filter: of those with Q(s, a) > Q(s, pi(s)), others counting as 0,

    where w falls linearly to 0 over ``frames`` environment steps.

    Args:
        weight: w at the start.
        frames: None keeps w.
        q_filter: whether the critic says where to imitate.
        device: of the losses.
    """

    def __init__(
        self, weight: float, frames: int | None, q_filter: bool, device: torch.device | str = "cpu"
    ) -> None:
        self._start, self._frames, self._filter = weight, frames, q_filter
        self.weight = torch.tensor(weight, device=device)  # a recorded update reads it anew

    def fade(self, frames: int) -> None:
        """Set w to what it is after so many environment steps."""
        if self._frames is not None:
            self.weight.fill_(self._start * max(0.0, 1.0 - frames / self._frames))

    def loss(
        self, batch: TensorDictBase, action: Tensor, value: Tensor, critic: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """The term, a scalar, for a minibatch ``(B,)``; ``(L,)`` for ``(L, B)``.

        Args:
            batch: ``"action"`` and ``"demonstrated"``, as ``minibatches`` gives them.
            action: of the actor, ``(*batch, k)``.
            value: of these actions, ``(*batch,)``.
            critic: gives that of others.
        """
        error = (action - batch["action"]).square().sum(-1)
        if self._filter:
            with torch.no_grad():
                passes = critic(batch["action"]) > value
            error = error * passes
        return self.weight * mean_over(batch, (batch["demonstrated"] * error).unsqueeze(-1))


def cloning_of(demos: ClonedDemosConfig, device: torch.device) -> Cloning | None:
    """The term that the settings ask for, if they do."""
    if not demos.cloning:
        return None
    return Cloning(demos.cloning, demos.cloning_frames, demos.q_filter, device)
