"""Offline training of an action map from demonstrations."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from nht.demos import Demos
from nht.lipschitz import LipschitzProjection, certificate
from nht.maps import ActionMap, LinearActionMap
from nht.storable import check_storable
from nht.training_data import context_keys_of, split_episodes, training_data

EVALUATE_EVERY = 250  # gradient steps
CHUNK = 65_536  # transitions projected at once when measuring

Progress = Callable[[dict[str, float]], None]


class MapTraining(NamedTuple):
    """The result of training a map.

    Attributes:
        map: the map that was handed in, trained, in eval mode.
        metrics: relative projection errors "validation_error" (on what was held out) and "training_error"
            (on the rest); "steps", "best_step", "seconds"; "certificate", "action_scale"; "transitions",
            "training_episodes", "validation_episodes".
    """

    map: ActionMap
    metrics: dict[str, float]


def train_map(
    demos: Demos,
    map: ActionMap,
    *,
    context_keys: Sequence[NestedKey] | None = None,
    batch_size: int = 256,
    learning_rate: float = 1e-3,
    max_steps: int = 10_000,
    patience: int = 4_000,
    validation_share: float = 0.1,
    seed: int = 0,
    progress: Progress | None = None,
) -> MapTraining:
    """Train a map in place, on its own device, and keep the weights that were best on held-out episodes.

    If ``map.fit`` is no closed form, Adam follows ``map.loss``, with a learning rate that falls to 0 along a
    cosine. The map also learns its context keys, action scale, bounds and the fingerprint of the data.

    Args:
        demos: the demonstrations.
        map: any action map.
        context_keys: the entries that make up the context, in order. Default: the map's own, or "context".
        batch_size: transitions per gradient step.
        learning_rate: of Adam, at the start.
        max_steps: of gradient descent, at most.
        patience: steps without a better validation error after which training ends.
        validation_share: of the episodes, held out; at least one episode. Of a single episode, its last part.
        seed: of the split and of the batches. The initial weights have their own, an argument of the map.
        progress: called at every evaluation with "step", "loss", "validation_error" and "seconds".

    Raises:
        KeyError: on a context key that the demonstrations lack, or lack under "next" where the map needs it.
        ValueError: on demonstrations that do not fit the map, or have fewer than k independent actuations or
            two episodes; on a number out of range. FloatingPointError: if the loss diverged from the start.
    """
    check_numbers(batch_size, learning_rate, max_steps, patience, validation_share)
    check_storable(map)
    start = time.perf_counter()
    keys = context_keys_of(demos, map, context_keys)
    data = training_data(demos, map, keys)
    held_out = split_episodes(demos.episode, validation_share, seed)
    training, validation = data[~held_out], data[held_out]

    map.train()
    steps = best_step = 0
    if not map.fit(training):
        rounds = _gradient_steps(map, training, batch_size, learning_rate, max_steps, seed)
        steps, best_step = _keep_best(map, validation, rounds, patience, progress)
    seconds = time.perf_counter() - start
    return finished(
        map, demos, keys, data, held_out, {"steps": steps, "best_step": best_step, "seconds": seconds}
    )


def finished(
    map: ActionMap,
    demos: Demos,
    keys: tuple[NestedKey, ...],
    data: TensorDictBase,
    held_out: Tensor,
    told: dict[str, float],
) -> MapTraining:
    """A map with its final weights, told what it is to know of its demonstrations, and measured.

    Args:
        map: whose gradient steps are done.
        demos: the demonstrations.
        keys: the entries that make up the context.
        data: context and actuation of all transitions.
        held_out: (T,), true where training did not look.
        told: "steps", "best_step", and "seconds" so far.
    """
    start = time.perf_counter()
    map.eval()
    map.context_keys, map.data_fingerprint = keys, demos.fingerprint
    _set_bounds(map, data)
    training, validation = data[~held_out], data[held_out]
    metrics = {
        "validation_error": projection_error(map, validation["context"], validation["actuation"]),
        "training_error": projection_error(map, training["context"], training["actuation"]),
        **told,
        "certificate": certificate(map),
        "action_scale": float(map.action_scale),
        "transitions": len(data),
        "training_episodes": len(torch.unique(demos.episode[~held_out])),
        "validation_episodes": len(torch.unique(demos.episode[held_out])),
    }
    metrics["seconds"] += time.perf_counter() - start
    return MapTraining(map, metrics)


@torch.no_grad()
def projection_error(map: ActionMap, context: Tensor, actuation: Tensor) -> float:
    """Relative projection error, sum |u - u_hat|^2 / sum |u|^2, u_hat being u projected and mapped back.

    Args:
        map: any action map.
        context: (T, context_dim); of demonstrations ``demos.context(map.context_keys)``.
        actuation: (T, n).
    """
    missed = total = 0.0
    for c, u in zip(torch.split(context, CHUNK), torch.split(actuation, CHUNK), strict=True):
        missed += float((u - map._reconstruct(u, c)).double().square().sum())
        total += float(u.double().square().sum())
    if total == 0:
        raise ValueError("the projection error is relative to the actuations, and these are all zero.")
    return missed / total


def _gradient_steps(
    map: ActionMap, data: TensorDictBase, batch_size: int, learning_rate: float, max_steps: int, seed: int
) -> Iterator[tuple[int, float]]:
    """Yield step and loss every EVALUATE_EVERY steps, when the map is exactly within its limit."""
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(map.parameters(), lr=learning_rate, fused=True)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max_steps)
    limit = None
    if isinstance(map, LinearActionMap) and map.lipschitz is not None:
        limit = LipschitzProjection(map)
    for step, batch in enumerate(_batches(data, batch_size, max_steps, generator), start=1):
        loss = map.loss(batch)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if limit is not None:
            limit.step()
        if step % EVALUATE_EVERY == 0 or step == max_steps:
            if limit is not None:
                limit.exact()
            yield step, loss.item()


def _batches(
    data: TensorDictBase, batch_size: int, count: int, generator: torch.Generator
) -> Iterator[TensorDictBase]:
    """Yield batches of random rows; those of many steps are gathered at once, as each gathering has its price."""
    for start in range(0, count, EVALUATE_EVERY):
        steps = min(EVALUATE_EVERY, count - start)
        rows = torch.randint(len(data), (steps, batch_size), generator=generator)
        yield from data[rows].unbind(0)


def _keep_best(
    map: ActionMap,
    validation: TensorDictBase,
    rounds: Iterator[tuple[int, float]],
    patience: int,
    progress: Progress | None,
) -> tuple[int, int]:
    """Train until the validation error stops falling: the steps made, and the step of the best weights."""
    start = time.perf_counter()
    best = EarlyStopping(map, validation, patience)
    for step, loss in rounds:
        goes_on = best.look(step, loss)
        if progress is not None and math.isfinite(loss):
            seconds = time.perf_counter() - start
            progress({"step": step, "loss": loss, "validation_error": best.error, "seconds": seconds})
        if not goes_on:
            break
    return best.steps, best.restore()


class EarlyStopping:
    """Watches the validation error of a map in training, and keeps the weights of the lowest.

    Args:
        map: in training. The start counts, too: a map that starts at the best plane never ends below it.
        validation: what was held out.
        patience: steps without a better error after which training ends.

    Attributes:
        steps: made, when it last looked.
        error: what it saw then.
    """

    def __init__(self, map: ActionMap, validation: TensorDictBase, patience: int) -> None:
        self._map, self._validation, self._patience = map, validation, patience
        self.steps, self.error = 0, self._measured()
        self._best_step, self._best_error, self._best_weights = 0, self.error, copy.deepcopy(map.state_dict())
        self._diverged = True  # until the first finite loss

    def _measured(self) -> float:
        return projection_error(self._map, self._validation["context"], self._validation["actuation"])

    def look(self, step: int, loss: float) -> bool:
        """Whether training goes on after this step, which had this loss."""
        self.steps = step
        if not math.isfinite(loss):
            return False
        self._diverged = False
        self.error = self._measured()
        if self.error < self._best_error:
            self._best_step, self._best_error = step, self.error
            self._best_weights = copy.deepcopy(self._map.state_dict())
        return step - self._best_step < self._patience

    def restore(self) -> int:
        """Give the map its best weights back, and say of which step they are.

        Raises:
            FloatingPointError: if the loss was not finite when it was looked at first.
        """
        if self._diverged:
            raise FloatingPointError(
                f"training diverged in the first {self.steps} steps; lower learning_rate."
            )
        self._map.load_state_dict(self._best_weights)
        return self._best_step


@torch.no_grad()
def _set_bounds(map: ActionMap, data: TensorDictBase) -> None:
    batches = zip(torch.split(data["actuation"], CHUNK), torch.split(data["context"], CHUNK), strict=True)
    map.action_scale.copy_(torch.stack([map.project(u, c).abs().max() for u, c in batches]).max())
    map.actuation_low.copy_(data["actuation"].amin(0))
    map.actuation_high.copy_(data["actuation"].amax(0))


def check_numbers(
    batch_size: int, learning_rate: float, max_steps: int, patience: int, validation_share: float
) -> None:
    """Raise ValueError for a number out of range."""
    for name, value in (("batch_size", batch_size), ("max_steps", max_steps), ("patience", patience)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}.")
    if not learning_rate > 0:
        raise ValueError(f"learning_rate must be positive, got {learning_rate}.")
    if not 0 < validation_share < 1:
        raise ValueError(f"validation_share must be between 0 and 1, got {validation_share}.")
