"""Demonstrations from HDF5 files in D4RL's style, with `pip install 'nht[minari]'`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType, ModuleType
from typing import Any

import torch
from tensordict import TensorDict

from nht.demos import Demos
from nht.episodes import whole_episodes

D4RL_CONTEXT: Mapping[str, str] = MappingProxyType({"observation": "observations"})
OUTCOMES = {"reward": "rewards", "terminated": "terminals", "truncated": "timeouts"}  # ours: D4RL's, optional


def from_hdf5(
    path: str | Path,
    *,
    actuation_key: str = "actions",
    context: Mapping[str, str] | Sequence[str] = D4RL_CONTEXT,
    episode_key: str | None = None,
    done_key: str | None = None,
    env: str = "unknown",
) -> Demos:
    """Demonstrations from a file that holds one array per key, with a row per transition, in order of time.

    Rewards, terminals and timeouts are taken along where the file has them, as is "next_observations" beside
    "observations". Files without it give demonstrations without "next", for what followed an episode's last
    step is not in them. Episodes that do not end are left out, and counted in the manifest.

    Args:
        path: the file.
        actuation_key: (T, n), what the motors got.
        context: keys that may serve as context, or such keys by the names they get: `{"joint": "infos/qpos"}`.
        episode_key: (T,) integers that differ between episodes, if the file has them.
        done_key: (T,), true at an episode's last step, where that is neither "terminals" nor "timeouts".
        env: a name for where they come from.

    Raises:
        ImportError: without the extra.
        FileNotFoundError: if there is no such file.
        KeyError: on a key that is not in the file; the message lists those that are.
        ValueError: on a file that cannot be read or is cut short, on arrays of different lengths, on values that
            are no finite demonstrations, and if no episode ends.
    """
    data, left_out = hdf5_episodes(
        path, actuation_key=actuation_key, context=context, episode_key=episode_key, done_key=done_key
    )
    return Demos.from_episodes(data, env=env, settings={"left_out_episodes": left_out})


def hdf5_episodes(
    path: str | Path,
    *,
    actuation_key: str = "actions",
    context: Mapping[str, str] | Sequence[str] = D4RL_CONTEXT,
    episode_key: str | None = None,
    done_key: str | None = None,
) -> tuple[TensorDict, int]:
    """What `from_hdf5` makes demonstrations of, values unseen: transitions, and how many episodes are left out."""
    names = context if isinstance(context, Mapping) else {key: key for key in context}
    needed: dict[tuple[str, ...], str] = {("actuation",): actuation_key}
    needed |= {("context", name): key for name, key in names.items()}
    needed |= {(name,): key for name, key in (("number", episode_key), ("end", done_key)) if key is not None}
    optional: dict[tuple[str, ...], str] = {("next", name): key for name, key in OUTCOMES.items()}
    optional |= {("next", "context", name): f"next_{key}" for name, key in names.items()}
    return whole_episodes(
        _read(Path(path), needed, optional),
        actuation_key="actuation",
        context={tuple(name.split("/")): ("context", name) for name in names},
        episode_key=None if episode_key is None else "number",
        done_key=None if done_key is None else "end",
    )


def _read(path: Path, needed: dict[tuple[str, ...], str], optional: dict[tuple[str, ...], str]) -> TensorDict:
    """The arrays of the file by our keys."""
    h5py = _import_h5py()
    if not path.is_file():
        raise FileNotFoundError(f"there is no file {path}")
    try:
        with h5py.File(path, "r") as file:
            found: list[str] = []
            file.visititems(
                lambda name, entry: found.append(name) if isinstance(entry, h5py.Dataset) else None
            )
            if missing := set(needed.values()) - set(found):
                raise KeyError(f"keys {sorted(missing)} are not in {path}, which has {found}")
            wanted = needed | {key: name for key, name in optional.items() if name in found}
            arrays: dict[str, Any] = {name: file[name][()] for name in set(wanted.values())}
    except OSError as error:
        raise ValueError(f"{path} cannot be read, it is cut short or no HDF5 file: {error}") from error
    lengths = {name: len(array) if array.ndim else 0 for name, array in arrays.items()}
    if len(set(lengths.values())) > 1:
        raise ValueError(f"the arrays of {path} must have a row per transition each, got lengths {lengths}")
    rows = {key: torch.from_numpy(arrays[name]) for key, name in wanted.items()}
    return TensorDict(rows, batch_size=list(lengths.values())[:1])


def _import_h5py() -> ModuleType:
    try:
        import h5py
    except ImportError as error:
        raise ImportError("HDF5 files need an optional package: pip install 'nht[minari]'") from error
    return h5py
