"""Demonstrations that others recorded, from their files: Minari, HDF5 in D4RL's style, TensorDicts."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from tensordict import NestedKey, TensorDictBase

from nht.episodes import whole_episodes
from nht.hdf5 import D4RL_CONTEXT, hdf5_episodes
from nht.memmap import read_tensordict
from nht.minari import left_out_observations, open_minari
from nht.minari_episodes import minari_episodes
from nht.reading import naming
from nht.recipes.sections import SourceConfig


class Episodes(NamedTuple):
    """Episodes of a file in the layout of demonstrations; their values are not checked."""

    data: TensorDictBase
    left_out: int
    """Episodes that do not end."""
    env: str = "unknown"
    expert: str = "unknown"
    notes: dict[str, list[str]] = {}  # noqa: RUF012 - never changed
    """Further entries for the manifest's settings."""


def read_episodes(source: SourceConfig) -> Episodes:
    """Read the whole episodes of a file.

    Raises:
        FileNotFoundError: if there is no such file or dataset.
        KeyError: for a key that it lacks; the message lists those that are there.
        ValueError: if ``source.path`` is missing, a setting has no meaning for this kind of file, or the file cannot
            be read.
    """
    if source.path is None:
        raise ValueError(f"source={source.kind} needs source.path: {FILES[source.kind]}.")
    if source.kind == "minari":
        return _read_minari(source)
    keys = {"actuation_key": source.actuation_key, "episode_key": source.episode_key}
    given = {name: key for name, key in (keys | {"done_key": source.done_key}).items() if key is not None}
    if source.kind == "hdf5":
        return Episodes(*hdf5_episodes(source.path, context=source.context or D4RL_CONTEXT, **given))
    context = source.context or {"observation": "observation"}
    names = {name: _nested(key) for name, key in context.items()}
    nested = {name: _nested(key) for name, key in given.items()}
    data = load_tensordict(source.path)
    with naming(source.path):
        return Episodes(*whole_episodes(data, context=names, **nested))


FILES = {
    "minari": "the id of a local Minari dataset, its folder or its HDF5 file",
    "hdf5": "an HDF5 file with observations, actions, rewards, terminals, timeouts",
    "tensordict": "the folder of a memory-mapped TensorDict, such as that of a TorchRL data set",
}
"""Meaning of ``source.path`` for each kind of file, for messages."""


def _read_minari(source: SourceConfig) -> Episodes:
    for name in ("actuation_key", "episode_key", "done_key"):
        if getattr(source, name) is not None:
            raise ValueError(f"source.{name} is not for source=minari: its actions and episodes are known.")
    dataset = open_minari(source.path or "")
    data, left_out = minari_episodes(dataset, source.context or None)
    env = dataset.env_spec.id if dataset.env_spec is not None else "unknown"
    expert = dataset.storage.metadata.get("algorithm_name", "unknown")
    return Episodes(data, left_out, env, expert, left_out_observations(dataset, source.context or None))


def load_tensordict(path: str | Path) -> TensorDictBase:
    """A TensorDict from its folder of raw files, or from that of a TorchRL storage. Raises as ``read_tensordict``."""
    return read_tensordict(path)


def episode_returns(data: TensorDictBase) -> torch.Tensor:
    """Sum of the rewards of every episode, ``(episodes,)``, in float64."""
    rewards = data["reward"].reshape(len(data)).double()
    number = _number(data)
    return rewards.new_zeros(int(number[-1]) + 1).index_add(0, number, rewards)


def best_episodes(data: TensorDictBase, min_return: float) -> tuple[TensorDictBase, int]:
    """The episodes with a return of at least ``min_return``, and how many others there are.

    Raises:
        ValueError: if there is none, or there are no rewards.
    """
    if "reward" not in data:
        raise ValueError("demos.min_return needs rewards, and there are none.")
    returns = episode_returns(data)
    good = returns >= min_return
    if not good.any():
        raise ValueError(
            f"none of {len(returns)} episodes has a return of at least demos.min_return={min_return}: the best has "
            f"{float(returns.max()):.6g}."
        )
    best = data[good[_number(data)]]
    best["episode"] = _number(best)
    return best, int((~good).sum())


def _number(data: TensorDictBase) -> torch.Tensor:
    """The episode of every transition, ``(T,)``, counted from 0."""
    return data["episode"].unique_consecutive(return_inverse=True)[1]


def _nested(key: str) -> NestedKey:
    """``"next/observation"`` as TensorDict writes it."""
    return tuple(key.split("/")) if "/" in key else key
