"""Offline training of many action maps of one kind, on the same demonstrations, in shared calls."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor, nn

from nht.adam_together import AdamTogether
from nht.demos import Demos
from nht.limits_together import LimitsTogether
from nht.lipschitz import LipschitzProjection
from nht.maps import NHT, ActionMap
from nht.networks_together import ConstantsTogether, NetworksTogether
from nht.offset import ConstantOffset, NetworkOffset
from nht.scl import SCL
from nht.storable import check_storable
from nht.train import EVALUATE_EVERY, EarlyStopping, MapTraining, check_numbers, finished, train_map
from nht.training_data import context_keys_of, split_episodes, training_data

ProgressTogether = Callable[[int, dict[str, float]], None]
SHARING = (NHT, SCL)
"""Kinds that share their calls: their losses need no more than what networks of linear layers make of the context."""
SHARED = ("context_keys", "context_dim", "actuation_dim", "action_dim", "offset")
"""What maps that train together have alike, beside their class, precision and device; the first unless it is told."""


def train_maps(
    demos: Demos,
    maps: Sequence[ActionMap],
    *,
    context_keys: Sequence[NestedKey] | None = None,
    batch_size: int | Sequence[int] = 256,
    learning_rate: float | Sequence[float] = 1e-3,
    max_steps: int | Sequence[int] = 10_000,
    patience: int | Sequence[int] = 4_000,
    validation_share: float | Sequence[float] = 0.1,
    seed: int | Sequence[int] = 0,
    progress: ProgressTogether | None = None,
) -> list[MapTraining | FloatingPointError]:
    """Train maps of one kind in place, each as ``train_map`` would alone, whoever trains beside it.

    Widths, depths, activations, limits and initial seeds are each map's own, and so is every number below that is given
    as a sequence. NHT and SCL share their calls; other kinds, subclasses and maps with several heads train one after
    another. A map that is done takes no more time.

    Args:
        demos: the demonstrations.
        maps: of one class and the same widths of context, actuation and action.
        context_keys: the entries that make up the context, in order. Default: the maps' own, or "context".
        batch_size: transitions per gradient step.
        learning_rate: of Adam, at the start.
        max_steps: of gradient descent, at most.
        patience: steps without a better validation error after which training ends.
        validation_share: of the episodes, held out.
        seed: of the split and of the batches.
        progress: called at every evaluation of every map, with its place in ``maps`` and what ``train_map`` tells;
            "seconds" are the map's share.

    Returns:
        What training gave, in the order of ``maps``; for a map whose loss diverged from the start the error that
        ``train_map`` raises.

    Raises:
        KeyError, ValueError: as ``train_map``; and if maps differ in what they share, which is named.
    """
    numbers = {
        "batch_size": batch_size,
        "learning_rate": learning_rate,
        "max_steps": max_steps,
        "patience": patience,
        "validation_share": validation_share,
        "seed": seed,
    }
    own = _of_each(numbers, len(maps))
    _check_alike(maps, SHARED if context_keys is None else SHARED[1:])
    _check_each(maps, own)
    if not maps:
        return []
    keys = context_keys_of(demos, maps[0], context_keys)
    found: dict[int, MapTraining | FloatingPointError] = {}
    sharing = [place for place, map in enumerate(maps) if _shares_calls(map)]
    if sharing:
        data = training_data(demos, maps[0], keys)
        begun = [_begin(place, maps[place], demos, data, **own[place]) for place in sharing]
        _descend(begun, data, progress)
        found = {one.place: _result(one, demos, keys, data) for one in begun}
    for place in set(range(len(maps))) - set(sharing):
        found[place] = _alone(demos, maps[place], keys, place, progress, own[place])
    return [found[place] for place in range(len(maps))]


@dataclass
class _Training:
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


def _begin(
    place: int,
    map: Any,
    demos: Demos,
    data: TensorDictBase,
    *,
    batch_size: int,
    learning_rate: float,
    max_steps: int,
    patience: int,
    validation_share: float,
    seed: int,
) -> _Training:
    start = time.perf_counter()
    held_out = split_episodes(demos.episode, validation_share, seed)
    map.train()
    map.fit(data[~held_out])
    for parameter in map.parameters():
        parameter.grad = torch.zeros_like(parameter)
    begun = _Training(
        place=place,
        map=map,
        held_out=held_out,
        rows=torch.nonzero(~held_out).squeeze(1),
        batch_size=batch_size,
        max_steps=max_steps,
        generator=torch.Generator().manual_seed(seed),
        rates=cosine(learning_rate, max_steps),
        best=EarlyStopping(map, data[held_out], patience),  # before a limit moves the start, as alone
        limit=None if map.lipschitz is None else LipschitzProjection(map),
    )
    begun.seconds = time.perf_counter() - start
    return begun


def _descend(begun: Sequence[_Training], data: TensorDictBase, progress: ProgressTogether | None) -> None:
    """Take gradient steps until every map is done; those that are leave the others' calls."""
    adam = AdamTogether([one.map for one in begun])
    going_on, step = list(begun), 0
    steps = _Steps(going_on, data, adam)
    while going_on:
        start = time.perf_counter()
        until = min(step - step % EVALUATE_EVERY + EVALUATE_EVERY, *(one.max_steps for one in going_on))
        losses = steps.take(until - step)
        step, share = until, (time.perf_counter() - start) / len(going_on)
        still = []
        for place, (one, loss) in enumerate(zip(going_on, losses, strict=True)):
            one.seconds += share
            if _looked(one, step, loss, progress):
                still.append(place)
        if 0 < len(still) < len(going_on):
            adam.keep(still)
            steps = _Steps([going_on[place] for place in still], data, adam)
        steps.follow()
        going_on = [going_on[place] for place in still]


def _looked(one: _Training, step: int, loss: float, progress: ProgressTogether | None) -> bool:
    """Whether a map goes on after this step."""
    if step % EVALUATE_EVERY and step < one.max_steps:
        return True
    start = time.perf_counter()
    if one.limit is not None:
        one.limit.exact()
    goes_on = one.best.look(step, loss) and step < one.max_steps
    one.seconds += time.perf_counter() - start
    if progress is not None and math.isfinite(loss):
        told = {"step": step, "loss": loss, "validation_error": one.best.error, "seconds": one.seconds}
        progress(one.place, told)
    return goes_on


class _Steps:
    """Gradient steps of several maps, in shared calls.

    One map of their class computes the losses of all rows, for it reads its networks' outputs from where
    ``NetworksTogether`` wrote them.

    Args:
        trainings: of the maps.
        data: context and actuation of all transitions.
        adam: moves the maps' parameters.
    """

    def __init__(self, trainings: Sequence[_Training], data: TensorDictBase, adam: AdamTogether) -> None:
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


def _result(
    one: _Training, demos: Demos, keys: tuple[NestedKey, ...], data: TensorDictBase
) -> MapTraining | FloatingPointError:
    one.map.zero_grad()
    try:
        best_step = one.best.restore()
    except FloatingPointError as error:
        return error
    told = {"steps": one.best.steps, "best_step": best_step, "seconds": one.seconds}
    return finished(one.map, demos, keys, data, one.held_out, told)


def cosine(rate: float, steps: int) -> Iterator[float]:
    """The learning rates of steps 0, 1 ..., as ``torch.optim.lr_scheduler.CosineAnnealingLR`` sets them, to the bit."""
    for step in range(1, steps + 1):
        yield rate
        rate *= (1 + math.cos(math.pi * step / steps)) / (1 + math.cos(math.pi * (step - 1) / steps))


def _alone(
    demos: Demos,
    map: ActionMap,
    keys: Sequence[NestedKey],
    place: int,
    progress: ProgressTogether | None,
    numbers: dict[str, Any],
) -> MapTraining | FloatingPointError:
    show = None if progress is None else lambda told: progress(place, told)
    try:
        return train_map(demos, map, context_keys=keys, progress=show, **numbers)
    except FloatingPointError as error:
        return error


def _shares_calls(map: ActionMap) -> bool:
    return type(map) in SHARING and not getattr(map, "multi_head", False)


def _of_each(numbers: dict[str, Any], count: int) -> list[dict[str, Any]]:
    """The numbers of each map."""
    for name, value in numbers.items():
        if not isinstance(value, int | float) and len(value) != count:
            raise ValueError(f"{name} must be one number, or one for each of {count} maps, got {len(value)}.")
    return [
        {name: value if isinstance(value, int | float) else value[place] for name, value in numbers.items()}
        for place in range(count)
    ]


def _check_each(maps: Sequence[ActionMap], own: Sequence[dict[str, Any]]) -> None:
    for place, (map, numbers) in enumerate(zip(maps, own, strict=True)):
        try:
            check_numbers(**{name: value for name, value in numbers.items() if name != "seed"})
            check_storable(map)
        except (TypeError, ValueError) as error:
            told = str(error).rstrip(".")
            raise type(error)(f"map {place}: {told}.") from error


def _check_alike(maps: Sequence[ActionMap], shared: Sequence[str]) -> None:
    seen: dict[int, int] = {}
    for place, map in enumerate(maps):
        first = maps[0]
        if type(map) is not type(first):
            raise ValueError(
                f"maps that train together are of one kind: map 0 is {type(first).__name__}, map {place} is "
                f"{type(map).__name__}."
            )
        if (twin := seen.setdefault(id(map), place)) != place:
            raise ValueError(
                f"map {place} is map {twin} once more: each is trained in place, so give it a twin."
            )
        kept, found = _shared(first, shared), _shared(map, shared)
        for name, value in found.items():
            if value != kept[name]:
                raise ValueError(
                    f"maps that train together share {name}: map 0 has {kept[name]}, map {place} has {value}."
                )


def _shared(map: ActionMap, names: Sequence[str]) -> dict[str, Any]:
    told = {name: getattr(map, name, None) for name in names}
    return told | {"precision": map.action_scale.dtype, "device": map.action_scale.device}
