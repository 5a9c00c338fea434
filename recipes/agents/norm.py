"""Normalisers of observations and rewards, with running statistics."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from nht.recipes.agents.settings import Setting, beside

Reduction = Callable[[Tensor], Tensor]
"""Adds up a tensor over processes."""


def alone(values: Tensor) -> Tensor:
    """The sum over one process."""
    return values


class RunningNorm(nn.Module):
    """Normalises by the mean and deviation of all data so far, and clips.

    Unlike TorchRL's ``VecNorm`` it stands before the networks instead of in the environment, so that the replay
    buffer holds raw observations and old ones are normalised by today's statistics.

    Args:
        size: width of the observation.
        clip: largest absolute value put out.
        floor: smallest deviation divided by.
        learners: number of learners with separate statistics, if several: observations are ``(learners, *batch,
            size)``.
    """

    count: Tensor
    mean: Tensor
    squares: Tensor
    shift: Tensor
    scale: Tensor

    def __init__(
        self, size: int, clip: float = 5.0, floor: float = 0.01, *, learners: int | None = None
    ) -> None:
        super().__init__()
        self.clip, self.floor = clip, floor
        lead = () if learners is None else (learners,)
        self.register_buffer("count", torch.zeros(lead, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(*lead, size, dtype=torch.float64))
        self.register_buffer(
            "squares", torch.zeros(*lead, size, dtype=torch.float64)
        )  # of deviations, summed
        self.register_buffer("shift", torch.zeros(*lead, size))
        self.register_buffer("scale", torch.ones(*lead, size))

    @torch.no_grad()
    def update(self, observation: Tensor, add: Reduction = alone) -> None:
        """Take ``(*batch, size)`` observations into the statistics (Chan et al.'s pairwise update).

        Args:
            observation: of this process.
            add: adds up tensors of all processes that share the statistics, which then stay the same in all of them.
        """
        seen = self.count.unsqueeze(-1)
        rows = observation.reshape(*self.count.shape, -1, observation.shape[-1]).double()
        rows = rows - self.mean.unsqueeze(-2)
        count, first, second = add(torch.stack([torch.ones_like(rows), rows, rows.square()]).sum(-2))
        deviation = first / count
        total = seen + count
        self.squares += second - count * deviation**2 + deviation**2 * seen * count / total
        self.mean += deviation * count / total
        self.count.copy_(total[..., 0])
        self.shift.copy_(self.mean)
        # Of what never changes, rounding can leave a sum of squares below 0.
        self.scale.copy_((self.squares / total).clamp_min(0.0).sqrt().clamp_min(self.floor))

    def forward(self, observation: Tensor) -> Tensor:
        """Normalised observations of the same shape."""
        shift, scale = (self.spread(values, observation) for values in (self.shift, self.scale))
        return ((observation - shift) / scale).clamp(-self.clip, self.clip)

    def spread(self, values: Tensor, observation: Tensor) -> Tensor:
        """Statistics ``(*learners, size)`` in a shape that broadcasts with observations."""
        return values.view(*self.count.shape, *[1] * (observation.ndim - values.ndim), values.shape[-1])


class NoNorm(nn.Module):
    """Leaves observations as they are, in the place of a ``RunningNorm``."""

    def update(self, observation: Tensor, add: Reduction = alone) -> None:
        """Nothing: there are no statistics."""

    def forward(self, observation: Tensor) -> Tensor:
        """The observations."""
        return observation


class ReturnNorm(nn.Module):
    """Divides rewards by the deviation of the discounted returns so far, and clips, as OpenAI's baselines do.

    Args:
        num_envs: number of copies of the environment.
        gamma: discount factor.
        clip: largest absolute reward put out.
        learners: that each have statistics and ``num_envs`` copies of their own; ``gamma`` may be one for each.
    """

    returns: Tensor

    def __init__(
        self, num_envs: int, gamma: Setting, clip: float = 10.0, *, learners: int | None = None
    ) -> None:
        super().__init__()
        self.gamma, self.clip = gamma, clip
        self.statistics = RunningNorm(1, floor=1e-4, learners=learners)
        lead = () if learners is None else (learners,)
        # Of the rewards up to now, of each copy's episode.
        self.register_buffer("returns", torch.zeros(*lead, num_envs))

    @torch.no_grad()
    def forward(
        self, data: TensorDictBase, copies: slice = slice(None), add: Reduction = alone
    ) -> TensorDictBase:
        """Take rewards into the statistics, then normalise them in place.

        Args:
            data: steps ``(*learners, len(copies), steps)``.
            copies: those that made these steps, of the ``num_envs``.
            add: adds up tensors of all processes that share the statistics.
        """
        outcome = data["next"]
        reward, going_on = outcome["reward"].squeeze(-1), ~outcome["done"].squeeze(-1)
        returns, last = torch.empty_like(reward), self.returns[..., copies]
        gamma = beside(self.gamma, last)
        for step in range(reward.shape[-1]):
            returns[..., step] = gamma * last + reward[..., step]
            torch.mul(returns[..., step], going_on[..., step], out=last)
        self.statistics.update(returns.unsqueeze(-1), add)
        scale = self.statistics.spread(self.statistics.scale, outcome["reward"])
        outcome["reward"] = (outcome["reward"] / scale).clamp(-self.clip, self.clip)
        return data
