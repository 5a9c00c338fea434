"""Adam for several maps, each with a learning rate of its own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from nht.torch_internals import adam_step


class AdamTogether:
    """Takes the steps that a ``torch.optim.Adam`` of each map would take, to the bit.

    Args:
        maps: with memory for their gradients, on one device.
    """

    def __init__(self, maps: Sequence[nn.Module]) -> None:
        self._groups: list[tuple[list[Tensor], list[Tensor], list[Tensor], list[Tensor]]] = []
        for map in maps:
            own = [parameter.detach() for parameter in map.parameters()]
            gradients = [value.grad for value in map.parameters() if value.grad is not None]
            means, squares = ([torch.zeros_like(value) for value in own] for _ in range(2))
            self._groups.append((own, gradients, means, squares))
        self._step = torch.zeros((), device=self._groups[0][0][0].device)

    def step(self, rates: Sequence[float]) -> None:
        """Move all parameters along their gradients, those of each map at its learning rate."""
        self._step += 1
        for group, rate in zip(self._groups, rates, strict=True):
            adam_step(*group, self._step, rate)

    def keep(self, places: Sequence[int]) -> None:
        """Go on with some of the maps only."""
        self._groups = [self._groups[place] for place in places]
