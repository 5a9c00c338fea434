"""Offline training of an action map from demonstrations."""

import copy
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor

from nht.demos import Demos
from nht.lipschitz import LipschitzProjection, certificate
from nht.maps import ActionMap, LinearActionMap

EVALUATE_EVERY = 250  # gradient steps
RANK_TOLERANCE = 1e-5  # singular values below this share of the largest count as rounding
CHUNK = 65_536  # transitions projected at once when measuring an error


class MapTraining(NamedTuple):
    """A trained map and what its training came to.

    Attributes:
        map: the map that was handed in, trained in place.
        metrics: "validation_error" and "training_error" (relative projection errors on the held-out and the other
            episodes), "steps", "best_step", "seconds", "certificate", "action_scale", "transitions",
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
    max_steps: int = 20_000,
    patience: int = 4_000,
    validation_share: float = 0.1,
    seed: int = 0,
    progress: Callable[[dict[str, float]], None] | None = None,
) -> MapTraining:
    """Trains a map in place, on the device it is on, and keeps the weights that were best on held-out episodes.

    Adam on `map.loss`, unless `map.fit` says that a closed form was enough. The learning rate falls by a cosine over
    `max_steps`; training ends early when the validation error has not fallen for `patience` steps. Sets the map's
    context keys, action scale, bounds and fingerprint.

    Args:
        context_keys: the context, in order; default `map.context_keys`, else "context" if the demonstrations have it.
        validation_share: of the episodes, held out; at least one.
        seed: of the split and of the batches. The initial weights have a seed of their own, in the map.
        progress: called at every evaluation with "step", "loss", "validation_error" and "seconds".

    Raises:
        KeyError: on a context key that the demonstrations lack.
        ValueError: on demonstrations that do not fit the map, have fewer than k independent actuations or fewer than
            two episodes, and on a share or a number out of range.
    """
    _check_numbers(batch_size, learning_rate, max_steps, patience, validation_share)
    start = time.perf_counter()
    keys = _context_keys(demos, map, context_keys)
    data = _training_data(demos, map, keys)
    held_out = split_episodes(demos.episode, validation_share, seed).to(data.device)
    training, validation = data[~held_out], data[held_out]

    steps = best_step = 0
    map.train()
    if not map.fit(training):
        steps, best_step = _descend(
            map, training, validation, batch_size, learning_rate, max_steps, patience, seed, progress
        )
    map.eval()
    _describe(map, data, keys, demos.fingerprint)
    return MapTraining(
        map,
        {
            "validation_error": projection_error(map, validation["context"], validation["actuation"]),
            "training_error": projection_error(map, training["context"], training["actuation"]),
            "steps": steps,
            "best_step": best_step,
            "seconds": time.perf_counter() - start,
            "certificate": certificate(map),
            "action_scale": float(map.action_scale),
            "transitions": len(data),
            "training_episodes": len(demos.episode[~held_out.cpu()].unique()),
            "validation_episodes": len(demos.episode[held_out.cpu()].unique()),
        },
    )


@torch.no_grad()
def projection_error(map: ActionMap, context: Tensor, actuation: Tensor) -> float:
    """Relative projection error sum |u - u_hat|^2 / sum |u|^2, u_hat being u projected and mapped back.

    Args:
        context: (T, context_dim); of demonstrations, `demos.context(map.context_keys)`.
        actuation: (T, n), in the map's own precision.
    """
    missed = total = 0.0
    for c, u in zip(context.split(CHUNK), actuation.split(CHUNK), strict=True):
        missed += float((u - map(map.project(u, c), c)).double().square().sum())
        total += float(u.double().square().sum())
    return missed / total


def split_episodes(episode: Tensor, share: float, seed: int) -> Tensor:
    """Holds out a share of the episodes, at least one and never all: (T,) -> (T,) bool, true where held out."""
    names = episode.unique()
    if len(names) < 2:
        raise ValueError(
            f"at least 2 episodes are needed to hold one out, the demonstrations have {len(names)}"
        )
    count = min(max(1, round(share * len(names))), len(names) - 1)
    order = torch.randperm(len(names), generator=torch.Generator().manual_seed(seed))
    return torch.isin(episode, names[order[:count]])


def _descend(
    map: ActionMap,
    training: TensorDictBase,
    validation: TensorDictBase,
    batch_size: int,
    learning_rate: float,
    max_steps: int,
    patience: int,
    seed: int,
    progress: Callable[[dict[str, float]], None] | None,
) -> tuple[int, int]:
    """Gradient steps until the validation error stops falling; leaves the best weights in the map."""
    start = time.perf_counter()
    generator = torch.Generator().manual_seed(seed)
    optimiser = torch.optim.Adam(map.parameters(), lr=learning_rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max_steps)
    limited = isinstance(map, LinearActionMap) and map.lipschitz is not None
    limit = LipschitzProjection(map) if limited else None
    best_error, best_step, best_weights = float("inf"), 0, {}
    for step in range(1, max_steps + 1):
        rows = torch.randint(len(training), (batch_size,), generator=generator)
        loss = map.loss(training[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
        if limit is not None:
            limit.step()
        if step % EVALUATE_EVERY and step < max_steps:
            continue
        if limit is not None:
            limit.exact()
        error = projection_error(map, validation["context"], validation["actuation"])
        if error < best_error:
            best_error, best_step, best_weights = error, step, copy.deepcopy(map.state_dict())
        if progress is not None:
            seconds = time.perf_counter() - start
            progress({"step": step, "loss": float(loss), "validation_error": error, "seconds": seconds})
        if step - best_step >= patience:
            break
    map.load_state_dict(best_weights)
    return step, best_step


def _training_data(demos: Demos, map: ActionMap, keys: Sequence[NestedKey]) -> TensorDict:
    """Context and actuation of all transitions, in memory, in the map's precision and on its device."""
    context, actuation = demos.context(keys), demos.actuation
    if actuation.shape[-1] != map.actuation_dim:
        raise ValueError(
            f"the demonstrated actuations have {actuation.shape[-1]} dimensions, the map {map.actuation_dim}"
        )
    if context.shape[-1] != map.context_dim:
        widths = {key: demos.data[key].shape[-1] for key in keys}
        raise ValueError(
            f"the map takes a context of {map.context_dim} numbers, the keys {widths} give another"
        )
    singular = torch.linalg.svdvals(actuation.double())
    rank = int((singular > RANK_TOLERANCE * singular[0]).sum())
    if rank < map.action_dim < map.actuation_dim:
        raise ValueError(
            f"the demonstrations have {rank} independent actuations, too few for action_dim={map.action_dim}"
        )
    entries = {"context": context, "actuation": actuation}
    return TensorDict(entries, batch_size=len(actuation)).to(map.action_scale.device, map.action_scale.dtype)


def _context_keys(
    demos: Demos, map: ActionMap, context_keys: Sequence[NestedKey] | None
) -> tuple[NestedKey, ...]:
    if context_keys is not None:
        return tuple(context_keys)
    if map.context_keys is not None:
        return map.context_keys
    if map.context_dim == 0:
        return ()
    if "context" in demos.data.keys():
        return ("context",)
    raise ValueError(
        f"name the context_keys of the map; the demonstrations have {', '.join(demos.manifest['keys'])}"
    )


@torch.no_grad()
def _describe(map: ActionMap, data: TensorDictBase, keys: tuple[NestedKey, ...], fingerprint: str) -> None:
    """Writes into the map what its users need to know of the demonstrations."""
    map.context_keys, map.data_fingerprint = keys, fingerprint
    chunks = zip(data["actuation"].split(CHUNK), data["context"].split(CHUNK), strict=True)
    map.action_scale.copy_(torch.stack([map.project(u, c).abs().max() for u, c in chunks]).max())
    map.actuation_low.copy_(data["actuation"].amin(0))
    map.actuation_high.copy_(data["actuation"].amax(0))


def _check_numbers(
    batch_size: int, learning_rate: float, max_steps: int, patience: int, validation_share: float
) -> None:
    for name, value in (("batch_size", batch_size), ("max_steps", max_steps), ("patience", patience)):
        if value < 1:
            raise ValueError(f"{name} must be at least 1, got {value}")
    if not learning_rate > 0:
        raise ValueError(f"learning_rate must be positive, got {learning_rate}")
    if not 0 < validation_share < 1:
        raise ValueError(f"validation_share must be between 0 and 1, got {validation_share}")
