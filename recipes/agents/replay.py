"""The replay buffer: which entries of steps it keeps, and the minibatches that are drawn from it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

from nht.recipes.quiet import quiet_storages
from nht.recipes.run.draws import Draws

STORED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
    "steps_to_next_obs",
)
"""The entries of a step that the buffer keeps: all that a loss needs, with raw observations."""


def replay_buffer(size: int, device: torch.device) -> TensorDictReplayBuffer:
    """An empty buffer of up to ``size`` steps, from which minibatches are drawn uniformly."""
    quiet_storages()
    return TensorDictReplayBuffer(storage=LazyTensorStorage(size, device=device))


def storable(steps: TensorDictBase) -> TensorDictBase:
    """Rows for the buffer from collected steps ``(copies, T)``, without those whose action is not finite.

    For several learners, ``(L, copies, T)``, a row holds a step of each, ``(rows, L)``, also of learners that diverged.
    """
    if steps.ndim == 3:
        return steps.select(*STORED).flatten(1, 2).transpose(0, 1)
    flat = steps.reshape(-1).select(*STORED)
    finite = (
        flat["action"].isfinite().all(-1).nonzero().squeeze(-1)
    )  # a GPU waits once, with a mask at every entry
    return flat[finite]


class DemosBuffer(NamedTuple):
    """Demonstrations that have a fixed share of every minibatch."""

    buffer: TensorDictReplayBuffer
    share: float

    def count(self, batch_size: int) -> int:
        """How many steps of a minibatch are demonstrated: at least one, and not all."""
        return min(max(1, round(self.share * batch_size)), batch_size - 1)


def minibatches(
    buffer: TensorDictReplayBuffer,
    updates: int,
    batch_size: int | Sequence[int],
    features: TensorDictModule,
    device: torch.device,
    draws: Draws | None = None,
    demos: DemosBuffer | None = None,
) -> Iterator[TensorDictBase]:
    """``updates`` minibatches ``(batch_size,)``, drawn at once and normalised by today's statistics.

    Args:
        buffer: of raw observations.
        updates: number of minibatches.
        batch_size: steps in each; of several learners, each one's own.
        features: ``"observation"`` to ``"features"``.
        device: where the networks are.
        draws: of several learners: minibatches are ``(L, B)`` then. Those of fewer steps are filled up to the largest,
            and a ``"weight"`` says what a step counts for.
        demos: demonstrations, which have their share of every minibatch; ``"demonstrated"`` then says what a step
            counts for in a mean over them, 0 for a collected one. None is none.
    """
    if not updates:
        return
    if draws is not None:
        assert not isinstance(batch_size, int)
        yield from _minibatches_of_each(buffer, updates, batch_size, features, device, draws, demos)
        return
    assert isinstance(batch_size, int)
    shown = 0 if demos is None else demos.count(batch_size)
    replay = buffer.sample(updates * (batch_size - shown)).to(device)
    if demos is not None:
        parts = replay, demos.buffer.sample(updates * shown).to(device)
        mixed: Any = torch.cat([part.view(updates, -1) for part in parts], dim=1)
        mixed["demonstrated"] = _demonstrated([batch_size], [shown], device).expand(updates, -1)
        replay = mixed.reshape(-1)
    with torch.no_grad():
        features(replay), features(replay["next"])
    yield from replay.split(batch_size)


def _minibatches_of_each(
    buffer: TensorDictReplayBuffer,
    updates: int,
    sizes: Sequence[int],
    features: TensorDictModule,
    device: torch.device,
    draws: Draws,
    demos: DemosBuffer | None,
) -> Iterator[TensorDictBase]:
    shown = [0 if demos is None else demos.count(size) for size in sizes]
    sources = [(buffer, [size - own for size, own in zip(sizes, shown, strict=True)])]
    if demos is not None:
        sources.append((demos.buffer, shown))
    rows = [source.storage[: len(source)].reshape(-1) for source, _ in sources]  # of all learners, in turn
    drawn = [_places(draws, len(source), counts, updates, device) for source, counts in sources]
    total = torch.tensor(sizes, device=device).unsqueeze(-1)
    weight = torch.cat([_filled(counts, device) for _, counts in sources], dim=-1) / total
    demonstrated = None if demos is None else _demonstrated(sizes, shown, device)
    # One at a time stays in a processor's cache; a GPU would rather have few large calls.
    for places in zip(
        *(part.split(updates if device.type == "cuda" else 1, dim=1) for part in drawn), strict=True
    ):
        parts = [
            source[chosen.flatten()].view(chosen.shape).to(device)
            for source, chosen in zip(rows, places, strict=True)
        ]
        replay: Any = parts[0] if demos is None else torch.cat(parts, dim=2)
        with torch.no_grad():
            features(replay), features(replay["next"])
        for batch in replay.unbind(1):
            if demonstrated is not None:
                batch["demonstrated"] = demonstrated
            yield batch if min(sizes) == max(sizes) else batch.set("weight", weight)


def _places(draws: Draws, high: int, counts: Sequence[int], updates: int, device: torch.device) -> Tensor:
    """For each learner the places of its steps in rows of all learners, ``(L, updates, max(counts))``.

    What fills a minibatch up is a learner's own step: a weight of 0 makes nothing of another's NaN.
    """
    learners = len(counts)
    places = torch.arange(learners, device=device).view(-1, 1, 1).repeat(1, updates, max(counts))
    drawn = draws.integers(high, [updates * count for count in counts])
    for learner, (count, own) in enumerate(zip(counts, drawn, strict=True)):
        places[learner, :, :count] += own.view(updates, count) * learners
    return places


def _filled(counts: Sequence[int], device: torch.device) -> Tensor:
    """Which steps count, ``(L, max(counts))``: each learner's first ones."""
    return torch.arange(max(counts), device=device) < torch.tensor(counts, device=device).unsqueeze(-1)


def _demonstrated(sizes: Sequence[int], shown: Sequence[int], device: torch.device) -> Tensor:
    """What steps count for in a mean over the demonstrated ones, which stand behind the others, ``(L, width)``."""
    counts, total = (torch.tensor(numbers, device=device).unsqueeze(-1) for numbers in (shown, sizes))
    collected = max(size - own for size, own in zip(sizes, shown, strict=True))
    return torch.nn.functional.pad(_filled(shown, device) * total / counts, (collected, 0))
