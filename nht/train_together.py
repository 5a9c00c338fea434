"""Offline training of many action maps of one kind, on the same demonstrations, in shared calls."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase

from nht.adam_together import AdamTogether
from nht.demos import Demos
from nht.lipschitz import LipschitzProjection
from nht.maps import NHT, ActionMap
from nht.scl import SCL
from nht.steps_together import MapInTraining, StepsTogether
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
) -> MapInTraining:
    start = time.perf_counter()
    held_out = split_episodes(demos.episode, validation_share, seed)
    map.train()
    map.fit(data[~held_out])
    for parameter in map.parameters():
        parameter.grad = torch.zeros_like(parameter)
    begun = MapInTraining(
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


def _descend(begun: Sequence[MapInTraining], data: TensorDictBase, progress: ProgressTogether | None) -> None:
    """Take gradient steps until every map is done; those that are leave the others' calls."""
    adam = AdamTogether([one.map for one in begun])
    going_on, step = list(begun), 0
    steps = StepsTogether(going_on, data, adam)
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
            steps = StepsTogether([going_on[place] for place in still], data, adam)
        steps.follow()
        going_on = [going_on[place] for place in still]


def _looked(one: MapInTraining, step: int, loss: float, progress: ProgressTogether | None) -> bool:
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


def _result(
    one: MapInTraining, demos: Demos, keys: tuple[NestedKey, ...], data: TensorDictBase
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
