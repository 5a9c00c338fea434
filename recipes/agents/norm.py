"""Normalisers of observations and rewards, which follow what they are shown."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

Reduction = Callable[[Tensor], Tensor]
"""Adds up a tensor over processes."""


def alone(values: Tensor) -> Tensor:
    """The sum over one process."""
    return values


class RunningNorm(nn.Module):
    """Normalises by the mean and deviation of everything it was shown, and clips.

    Unlike TorchRL's ``VecNorm`` it stands before the networks instead of in the environment, so that the replay
    buffer holds raw observations and old ones are normalised by today's statistics.

    Args:
        size: width of the observation.
        clip: largest absolute value put out.
        floor: smallest deviation divided by.
    """

    count: Tensor
    mean: Tensor
    squares: Tensor
    shift: Tensor
    scale: Tensor

    def __init__(self, size: int, clip: float = 5.0, floor: float = 0.01) -> None:
        super().__init__()
        self.clip, self.floor = clip, floor
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(size, dtype=torch.float64))  # summed squared deviations
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    @torch.no_grad()
    def update(self, observation: Tensor, add: Reduction = alone) -> None:
        """Take ``(*batch, size)`` observations into the statistics (Chan et al.'s pairwise update).

        Args:
            observation: of this process.
            add: adds up tensors of all processes that share the statistics, which then stay the same in all of them.
        """
        rows = observation.reshape(-1, observation.shape[-1]).double() - self.mean
        count, first, second = add(torch.stack([torch.ones_like(rows), rows, rows.square()]).sum(1))
        deviation = first / count
        total = self.count + count
        self.squares += second - count * deviation**2 + deviation**2 * self.count * count / total
        self.mean += deviation * count / total
        self.count.copy_(total[0])
        self.shift.copy_(self.mean)
        self.scale.copy_((self.squares / total).sqrt().clamp_min(self.floor))

    def forward(self, observation: Tensor) -> Tensor:
        """Normalised observations of the same shape."""
        return ((observation - self.shift) / self.scale).clamp(-self.clip, self.clip)


class ReturnNorm(nn.Module):
    """Divides rewards by the deviation of the discounted returns so far, and clips, as OpenAI's baselines do.

    Args:
        num_envs: number of copies of the environment.
        gamma: discount factor.
        clip: largest absolute reward put out.
    """

    returns: Tensor

    def __init__(self, num_envs: int, gamma: float, clip: float = 10.0) -> None:
        super().__init__()
        self.gamma, self.clip = gamma, clip
        self.statistics = RunningNorm(1, floor=1e-4)
        self.register_buffer(
            "returns", torch.zeros(num_envs)
        )  # of the rewards up to now, of each copy's episode

    @torch.no_grad()
    def forward(
        self, data: TensorDictBase, copies: slice = slice(None), add: Reduction = alone
    ) -> TensorDictBase:
        """Take rewards into the statistics, then normalise them in place.

        Args:
            data: steps ``(len(copies), steps)``.
            copies: those that made these steps, of the ``num_envs``.
            add: adds up tensors of all processes that share the statistics.
        """
        outcome = data["next"]
        reward, going_on = outcome["reward"].squeeze(-1), ~outcome["done"].squeeze(-1)
        returns, last = torch.empty_like(reward), self.returns[copies]
        for step in range(reward.shape[-1]):
            returns[:, step] = self.gamma * last + reward[:, step]
            torch.mul(returns[:, step], going_on[:, step], out=last)
        self.statistics.update(returns.unsqueeze(-1), add)
        outcome["reward"] = (outcome["reward"] / self.statistics.scale).clamp(-self.clip, self.clip)
        return data
