"""The episodes of a Minari dataset that is open, as transitions."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict

from nht.arrays import as_tensor
from nht.episodes import whole_episodes
from nht.minari_internals import MINARI_ERRORS
from nht.reading import naming, shortened, shown

if TYPE_CHECKING:
    from minari import EpisodeData, MinariDataset

AnyArray = NDArray[Any]


def minari_episodes(
    dataset: MinariDataset, context: Mapping[str, str] | Sequence[str] | None = None
) -> tuple[TensorDict, int]:
    """The transitions of a dataset, their values not checked yet, and the number of episodes that are left out."""
    targets = context if context is None or isinstance(context, Mapping) else {name: name for name in context}
    with naming(dataset.storage.data_path):
        parts, lengths = [], []
        for episode in _episodes(dataset):
            moments = moments_of(dataset, episode)
            if targets is None:
                targets = {name: name for name in moments if not name.startswith("infos/")}
            if missing := set(targets.values()) - moments.keys():
                raise KeyError(
                    f"entries {sorted(missing)} are not in episode {episode.id} of {dataset.id}, which has "
                    f"{shown(moments)}."
                )
            parts.append(_transitions(episode, moments, set(targets.values())))
            lengths.append(len(episode))
        if targets is None or not sum(lengths):
            raise ValueError(f"the Minari dataset {dataset.id} has no transitions.")
        return whole_episodes(
            _joined(dataset.id, parts, lengths),
            context={tuple(name.split("/")): ("context", key) for name, key in targets.items()},
        )


def _joined(name: str, parts: list[dict[tuple[str, ...], AnyArray]], lengths: list[int]) -> TensorDict:
    """The rows of all episodes one after another, with the number of each one's episode."""
    if differing := {key for part in parts for key in part.keys() ^ parts[0].keys()}:
        entries = sorted("/".join(key) for key in differing)
        raise ValueError(f"some episodes of {name} have the entries {shown(entries)}, others lack them.")
    columns = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    rows = {key: as_tensor(column, f"{name}, {'/'.join(key)}") for key, column in columns.items()}
    rows["episode",] = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    return TensorDict(rows, [sum(lengths)])


def _episodes(dataset: MinariDataset) -> Iterator[EpisodeData]:
    try:
        yield from dataset.iterate_episodes()
    except MINARI_ERRORS as error:
        raise ValueError(
            f"the Minari dataset {dataset.id} cannot be read, it may be cut short or of another env: "
            f"{shortened(error, 600)}."
        ) from error


def moments_of(dataset: MinariDataset, episode: EpisodeData) -> dict[str, AnyArray]:
    """Observations and infos at the T + 1 moments of an episode, (T + 1, *shape) by name. Checks all shapes."""
    steps = len(episode)
    moments: dict[str, AnyArray] = {}
    for name, values, space in _leaves(episode.observations, dataset.observation_space, "observation"):
        _check_shape(
            dataset, episode, f"entry {name!r} of the observations", values, (steps + 1, *space.shape)
        )
        moments[name] = values
    actions = episode.actions
    if not isinstance(actions, np.ndarray):
        raise ValueError(
            f"the actions of {dataset.id} must be arrays, its action space is {dataset.action_space}."
        )
    _check_shape(dataset, episode, "actions", actions, (steps, *dataset.action_space.shape))
    for name in ("terminations", "truncations"):
        _check_shape(dataset, episode, name, getattr(episode, name), (steps,))
    for name, values in _arrays(episode.infos or {}, "infos"):
        if values.dtype.kind in "biuf" and values.shape[:1] == (steps + 1,):
            moments[name] = values
    return moments


def _transitions(
    episode: EpisodeData, moments: dict[str, AnyArray], names: set[str]
) -> dict[tuple[str, ...], AnyArray]:
    """The rows of an episode, (T, *shape) by key, in TorchRL's layout."""
    rows: dict[tuple[str, ...], AnyArray] = {
        ("action",): episode.actions,
        ("next", "reward"): episode.rewards,
        ("next", "terminated"): episode.terminations,
        ("next", "truncated"): episode.truncations,
    }
    for name in names:
        rows["context", name], rows["next", "context", name] = moments[name][:-1], moments[name][1:]
    if "infos/success" in moments:
        rows["next", "success"] = moments["infos/success"][1:]
    return rows


def _leaves(values: Any, space: Any, name: str) -> Iterator[tuple[str, AnyArray, Any]]:
    """Arrays of an observation with their names and spaces; the entries of a Dict space have their own names."""
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _leaves(value, space[key], key if name == "observation" else f"{name}/{key}")
    elif isinstance(values, tuple):
        for number, value in enumerate(values):
            yield from _leaves(value, space[number], f"{name}/{number}")
    elif isinstance(values, np.ndarray):
        yield name, values, space


def _arrays(values: Any, name: str) -> Iterator[tuple[str, AnyArray]]:
    if isinstance(values, dict):
        for key, value in values.items():
            yield from _arrays(value, f"{name}/{key}")
    elif isinstance(values, np.ndarray):
        yield name, values


def _check_shape(
    dataset: MinariDataset, episode: EpisodeData, name: str, values: AnyArray, expected: tuple[int, ...]
) -> None:
    if values.shape != expected:
        raise ValueError(
            f"{name} in episode {episode.id} of {dataset.id} must have shape {expected}, got {values.shape}."
        )
