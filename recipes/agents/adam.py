"""Adam for one learner, or for several whose parameters are stacked."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from nht.recipes.agents.settings import Setting, beside, largest


class LearnersAdam(torch.optim.Adam):
    """``torch.optim.Adam`` over the parameters of one learner, or over stacked parameters ``(L, ...)`` of several.

    Adam moves a parameter by the learning rate times something that does not depend on it. Where learners have rates of
    their own, Adam with a rate of 1 therefore moves a zero, and each learner's part of that, times its own rate, is
    added to the parameter: two calls for all learners, and to rounding the steps that L optimisers would take.

    Args:
        networks: parameters, and their learning rate or rates ``(L,)``.
        eps: added to the root of the second moment.
    """

    def __init__(self, networks: Sequence[tuple[Iterable[nn.Parameter], Setting]], eps: float = 1e-8) -> None:
        groups: list[dict[str, Any]] = []
        self._apart: list[tuple[nn.Parameter, nn.Parameter, Tensor]] = []  # parameter, its move, rates
        for parameters, rate in networks:
            own = list(parameters)
            if not isinstance(rate, Tensor):
                groups.append({"params": own, "lr": rate})
                continue
            moves = [nn.Parameter(torch.zeros_like(parameter)) for parameter in own]
            groups.append({"params": moves, "lr": 1.0})
            for each, move in zip(own, moves, strict=True):
                self._apart.append((each, move, rate.view(-1, *[1] * (each.ndim - 1))))
        graphed = groups[0]["params"][0].is_cuda  # the step must be one that a CUDA graph can repeat
        if graphed:
            groups = [{**group, "lr": torch.tensor(group["lr"], device="cuda")} for group in groups]
        super().__init__(groups, eps=eps, fused=True, capturable=graphed)
        self._rates = [float(group["lr"]) for group in self.param_groups]

    def decay(self, share: float) -> None:
        """Set every learning rate to this share of its initial value."""
        for group, rate in zip(self.param_groups, self._rates, strict=True):
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate * share)
            else:
                group["lr"] = rate * share

    def step(self, closure: Any = None) -> Any:
        """Take a step along the gradients."""
        for parameter, move, _ in self._apart:
            move.grad = parameter.grad
        result = super().step(closure)
        for parameter, move, rates in self._apart:
            parameter.data.addcmul_(move.data, rates)
            move.data.zero_()
        return result

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget the gradients."""
        super().zero_grad(set_to_none)
        for parameter, _, _ in self._apart:
            parameter.grad = None


def clip_gradients(parameters: Sequence[nn.Parameter], norm: Setting, learners: int | None) -> None:
    """Clip the gradient to ``norm``, for one learner, or for each of several with parameters ``(L, ...)``."""
    if learners is None:
        nn.utils.clip_grad_norm_(parameters, largest(norm))
        return
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    lengths = torch.stack([gradient.flatten(1).square().sum(1) for gradient in gradients]).sum(0).sqrt()
    factor = (norm / (lengths + 1e-6)).clamp(max=1.0)
    for gradient in gradients:
        gradient.mul_(beside(factor, gradient))
