"""Gradient steps of several action maps of one kind, in shared calls."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor, nn

from nht.adam_together import AdamTogether
from nht.limits_together import LimitsTogether
from nht.lipschitz import LipschitzProjection
from nht.maps import NHT
from nht.networks_together import ConstantsTogether, NetworksTogether
from nht.offset import ConstantOffset, NetworkOffset
from nht.scl import SCL
from nht.train import EarlyStopping


@dataclass
class MapInTraining:
    """A map in training, and all that is its own.

    Attributes:
        place: among the maps.
        map: with memory for its gradients.
        held_out: (T,), true where training does not look.
        rows: the numbers of the transitions that it trains on.
        generator: of its batches.
        rates: the learning rate of each step to come.
        limit: what keeps it within its Lipschitz limit, if it has one.
        best: its early stopping.
        seconds: that it took so far.
    """

    place: int
    map: NHT | SCL
    held_out: Tensor
    rows: Tensor
    batch_size: int
    max_steps: int
    generator: torch.Generator
    rates: Iterator[float]
    limit: LipschitzProjection | None
    best: EarlyStopping
    seconds: float = field(default=0.0)


class StepsTogether:
    """Gradient steps of several maps.

    One map of their class computes the losses of all rows, for it reads its networks' outputs from where
    ``NetworksTogether`` wrote them.

    Args:
        trainings: of the maps.
        data: context and actuation of all transitions.
        adam: moves the maps' parameters.
    """

    def __init__(self, trainings: Sequence[MapInTraining], data: TensorDictBase, adam: AdamTogether) -> None:
        self._trainings, self._data, self._adam = trainings, data, adam
        rows = [one.batch_size for one in trainings]
        maps: list[Any] = [one.map for one in trainings]
        like = data["actuation"]
        self._shares = torch.cat([like.new_full((count,), 1 / count) for count in rows])  # of each map's mean
        self._rows = rows
        self._map = copy.deepcopy(maps[0]).requires_grad_(requires_grad=False)
        self._read: list[_Given] = []
        self._networks: list[NetworksTogether | ConstantsTogether] = [
            NetworksTogether([map.network for map in maps], rows)
        ]
        self._map.network = self._reader()
        offsets = [map.offset_model for map in maps]
        if isinstance(offsets[0], NetworkOffset):
            self._networks.append(NetworksTogether([offset.network for offset in offsets], rows))
            self._map.offset_model.network = self._reader()
        elif isinstance(offsets[0], ConstantOffset):
            self._networks.append(ConstantsTogether(offsets, rows))
            self._map.offset_model = self._reader()
        self._limits = LimitsTogether([one.limit for one in trainings if one.limit is not None])

    def _reader(self) -> Any:
        self._read.append(_Given())
        return self._read[-1]

    def take(self, count: int) -> list[float]:
        """Take steps, at least one: the loss of each map in the last of them."""
        losses = self._shares
        for index in self._drawn(count):
            rows = {name: self._data[name].index_select(0, index) for name in ("context", "actuation")}
            batch = TensorDict(rows, len(index))
            losses = self._losses(batch)
            gradients = torch.autograd.grad(losses @ self._shares, [given.output for given in self._read])
            for networks, gradient in zip(self._networks, gradients, strict=True):
                networks.backward(gradient)
            self._adam.step([next(one.rates) for one in self._trainings])
            self._limits.step()
        return [float(own.mean()) for own in losses.detach().split(self._rows)]

    def _losses(self, batch: TensorDictBase) -> Tensor:
        """The loss of every row, from outputs that await their gradient."""
        for given, networks in zip(self._read, self._networks, strict=True):
            given.output = networks.forward(batch["context"]).detach().requires_grad_()
        return self._map.losses(batch)

    def _drawn(self, count: int) -> Iterator[Tensor]:
        """The transitions of each step, of all maps one behind another; each draws as if it were alone."""
        drawn = [
            one.rows[torch.randint(len(one.rows), (count, one.batch_size), generator=one.generator)]
            for one in self._trainings
        ]
        yield from torch.cat(drawn, dim=1).to(self._data.device)

    def follow(self) -> None:
        """After maps were brought within their limits exactly."""
        self._limits.follow()


class _Given(nn.Module):
    """In the place of a network, or of an offset: gives what has been computed elsewhere."""

    output: Tensor

    def forward(self, context: Tensor) -> Tensor:
        return self.output
