"""Adam for one learner, or for several whose parameters are stacked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from nht.recipes.agents.settings import Setting, beside, largest


class LearnersAdam(torch.optim.Adam):
    """``torch.optim.Adam`` over parameters of one learner, or over ``(L, ...)`` of several.

    Where these have learning rates of their own, the optimiser has a group for each, of their parts of the parameters:
    it takes the same steps as L optimisers would.

    Args:
        networks: parameters, and their learning rate or rates ``(L,)``.
        eps: added to the root of the second moment.
    """

    def __init__(self, networks: Sequence[tuple[Iterable[nn.Parameter], Setting]], eps: float = 1e-8) -> None:
        groups: list[dict[str, Any]] = []
        self._parted = any(isinstance(rate, Tensor) for _, rate in networks)
        for parameters, rate in networks:
            own = list(parameters)
            if not self._parted:
                groups.append({"params": own, "lr": rate})
                continue
            for parameter in own:
                parameter.grad = torch.zeros_like(parameter)
            count = len(own[0])
            rates = rate.tolist() if isinstance(rate, Tensor) else count * [rate]
            groups += [
                {"params": [_part(parameter, learner) for parameter in own], "lr": rates[learner]}
                for learner in range(count)
            ]
        super().__init__(groups, eps=eps, fused=True)
        self._rates = [group["lr"] for group in self.param_groups]

    def decay(self, share: float) -> None:
        """Let every learning rate be this share of what it began as."""
        for group, rate in zip(self.param_groups, self._rates, strict=True):
            group["lr"] = rate * share

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget the gradients; parts of parameters keep the memory that they share with the whole."""
        super().zero_grad(set_to_none=set_to_none and not self._parted)


def _part(parameter: nn.Parameter, learner: int) -> nn.Parameter:
    """One learner's part of a stacked parameter, with its part of the gradient: both are views."""
    assert parameter.grad is not None
    part = nn.Parameter(parameter.data[learner])
    part.grad = parameter.grad[learner]
    return part


def clip_gradients(parameters: Sequence[nn.Parameter], norm: Setting, learners: int | None) -> None:
    """Shorten a longer gradient to ``norm``: that of one learner, or of each of several, parameters ``(L, ...)``."""
    if learners is None:
        nn.utils.clip_grad_norm_(parameters, largest(norm))
        return
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    lengths = torch.stack([gradient.flatten(1).square().sum(1) for gradient in gradients]).sum(0).sqrt()
    factor = (norm / (lengths + 1e-6)).clamp(max=1.0)
    for gradient in gradients:
        gradient.mul_(beside(factor, gradient))
