"""Demonstrations: whole episodes in a TorchRL replay buffer, beside a manifest.

On disk it is a folder: ``manifest.json`` says what was recorded, by whom and with which versions, and has a
fingerprint of the data; ``data/`` has one raw file per key, mapped into memory when it is read. Nothing is pickled, and
a folder is complete or not there at all.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from numpy.typing import ArrayLike
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, ReplayBuffer, TensorStorage

from nht.arrays import as_tensor
from nht.episodes import check, items, key_name, listed, whole_episodes
from nht.memmap import STORAGE, raw, read_tensordict, write_tensordict
from nht.reading import checksum, entry, known_entries, read_json, shortened
from nht.writing import check_room, publish, scratch

FORMAT = "nht.demos"
FORMAT_VERSION = 1
PACKAGES = ("nht", "torch", "torchrl", "tensordict", "numpy", "mujoco")  # whose versions the manifest records
ENTRIES: dict[str, type | tuple[type, ...]] = {
    "format": str,
    "format_version": int,
    "env": str,
    "seed": (int, type(None)),
    "expert": str,
    "settings": dict,
    "episodes": int,
    "transitions": int,
    "keys": dict,
    "versions": dict,
    "fingerprint": str,
}
"""Of a manifest; ``checksum``, over all of these, is missing in those of earlier versions."""


class Demos:
    """Demonstrations, not to be changed: made by ``save_demos``, ``load_demos`` or one of the methods ``from_...``.

    Attributes:
        buffer: replay buffer over all transitions, ``buffer.sample(256)``; nothing can be added to it.
        manifest: env, seed, expert, settings; keys with shapes and types; episodes, transitions; versions;
            fingerprint.
    """

    def __init__(self, buffer: ReplayBuffer, manifest: Mapping[str, Any]) -> None:
        self.buffer = buffer
        self.manifest = dict(manifest)

    @classmethod
    def from_tensors(
        cls,
        *,
        actuation: Tensor | ArrayLike,
        episode: Tensor | ArrayLike,
        context: Tensor | ArrayLike | Mapping[str, Tensor | ArrayLike],
        next_context: Tensor | ArrayLike | Mapping[str, Tensor | ArrayLike] | None = None,
        env: str = "unknown",
    ) -> Demos:
        """Demonstrations from tensors or NumPy arrays of your own, copied into memory.

        Args:
            actuation: (T, n), in order of time.
            episode: (T,), integers; the rows of an episode stand together.
            context: (T, context_dim), to be found under "context"; or several such tensors by key.
            next_context: the same, one step later, to be found under "next"; some maps need it.
            env: a name for where they come from.

        Raises:
            ValueError: on data that are no whole, finite demonstrations.
        """
        entries: dict[str, Any] = _named(context, "context")
        if next_context is not None:
            entries["next"] = _named(next_context, "next_context")
        entries["actuation"] = motors = as_tensor(actuation, "actuation")
        entries["episode"] = as_tensor(episode, "episode").long()
        return cls.from_episodes(TensorDict(entries, batch_size=motors.shape[:1]), env=env)

    @classmethod
    def from_tensordict(
        cls,
        data: TensorDictBase,
        *,
        actuation_key: NestedKey = "action",
        context: Mapping[str, NestedKey] | Sequence[NestedKey] = ("observation",),
        episode_key: NestedKey | None = None,
        done_key: NestedKey | None = None,
        env: str = "unknown",
    ) -> Demos:
        """Demonstrations from what TorchRL rolled out, collected or stored: ``dataset[:]`` of any of its data sets.

        Where episodes end is found from ids of trajectories and flags; episodes that do not end are left out, and
        their number is in the manifest under "settings".

        Args:
            data: (T,), or (N, T) with a trajectory in each row; in order of time, outcomes under "next".
            actuation_key: (*batch, n), what the motors got.
            context: keys that may serve as context, or such keys by the names they get: `{"goal": ("info",
                "goal")}`; those that also stand under "next" are taken along.
            episode_key: integers that differ between episodes, where they are not "episode" or those of a
                collector.
            done_key: true at an episode's last step, where it is not "done", "terminated" or "truncated".
            env: a name for where they come from.

        Raises:
            KeyError: on a key that is not in the data; the message lists those that are.
            ValueError: if nothing says where episodes end, or on values that are not finite.
        """
        episodes, left_out = whole_episodes(
            data,
            actuation_key=actuation_key,
            context=context,
            episode_key=episode_key,
            done_key=done_key,
        )
        return cls.from_episodes(episodes, env=env, settings={"left_out_episodes": left_out})

    @classmethod
    def from_episodes(
        cls,
        data: TensorDictBase,
        *,
        env: str = "unknown",
        expert: str = "unknown",
        settings: Mapping[str, Any] | None = None,
    ) -> Demos:
        """Demonstrations from a TensorDict as ``save_demos`` takes it, copied into memory.

        Raises:
            KeyError: if "actuation" or "episode" is missing.
            ValueError: on data that are no whole, finite demonstrations.
        """
        manifest = _manifest(data, env=env, seed=None, expert=expert, settings=dict(settings or {}))
        return cls(_buffer(data.cpu().clone()), manifest)

    @property
    def data(self) -> TensorDictBase:
        """All transitions, (T,), in order of time."""
        return self.buffer.storage[: len(self)]

    @property
    def actuation(self) -> Tensor:
        """Demonstrated actuations, (T, n)."""
        return self.data["actuation"]

    @property
    def episode(self) -> Tensor:
        """The episode that each transition belongs to, (T,) int64."""
        return self.data["episode"]

    @property
    def fingerprint(self) -> str:
        """SHA-256 over keys, types, shapes and values."""
        return self.manifest["fingerprint"]

    def __len__(self) -> int:
        return len(self.buffer)

    def __repr__(self) -> str:
        about = self.manifest
        keys = ", ".join(f"{key} {tuple(value['shape'])}" for key, value in about["keys"].items())
        return (
            f"Demos({len(self):,} transitions in {about['episodes']:,} episodes, env={about['env']!r}, "
            f"expert={about['expert']!r}, keys: {shortened(keys, 400)})"
        )

    def context(self, keys: Sequence[NestedKey]) -> Tensor:
        """The entries of ``keys`` side by side, (T, context_dim); no keys give (T, 0).

        Raises:
            KeyError: on a key that is not there.
            ValueError: on an entry that is not one row of floats per transition.
        """
        data = self.data
        for key in keys:
            value = data.get(key, None)
            if not isinstance(value, Tensor):
                raise KeyError(
                    f"context key {key!r} is not in the demonstrations, which have {listed(data)}."
                )
            if value.ndim != 2 or not value.is_floating_point():
                raise ValueError(
                    f"context key {key!r} must hold floats (T, width), got {value.dtype} {tuple(value.shape)}."
                )
        return torch.cat([self.actuation[:, :0], *(data[key] for key in keys)], dim=-1)


def save_demos(
    data: TensorDictBase | Demos,
    path: str | Path,
    *,
    env: str | None = None,
    seed: int | None = None,
    expert: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Demos:
    """Writes demonstrations to a new folder, all or nothing.

    Args:
        data: (T,) transitions in order of time: "actuation" (T, n), "episode" (T,) int64, and every raw key
            that may serve as context, (T, width). More keys are welcome: "reward", flags, ("next", key). If
            there is "done" (T, 1), the last transition of every episode must have it set. Or ``Demos``, whose
            manifest says what is not given here.
        path: a folder that does not exist yet.
        env: name of the env.
        seed: what the collection was seeded with, if it was.
        expert: name of the demonstrator.
        settings: options of env and expert, JSON values.

    Raises:
        FileExistsError: if ``path`` exists: demonstrations are never overwritten.
        KeyError: if "actuation" or "episode" is missing.
        OSError: if there is no room.
        ValueError: on data that are no whole, finite demonstrations.
    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(
            f"{path} exists, and demonstrations are never overwritten: choose another path."
        )
    about = data.manifest if isinstance(data, Demos) else {}
    data = data.data if isinstance(data, Demos) else data
    manifest = _manifest(
        data,
        env=about.get("env", "unknown") if env is None else env,
        seed=about.get("seed") if seed is None else seed,
        expert=about.get("expert", "unknown") if expert is None else expert,
        settings=dict(about.get("settings", {}) if settings is None else settings),
    )
    manifest = json.loads(json.dumps(manifest))  # as it will be read
    text = json.dumps(manifest | {"checksum": checksum(manifest)}, indent=2) + "\n"
    size = sum(value.numel() * value.element_size() for _, value in items(data))
    check_room(path.parent, size, f"saving demonstrations in {path}")
    with scratch(path) as place:
        write_tensordict(data, place / "data")
        (place / "data" / STORAGE).write_text(
            json.dumps({"metadata": {}, "is_pytree": False, "len": len(data)})
        )
        (place / "manifest.json").write_text(text)
        publish(place, path)
    return load_demos(path)


def load_demos(path: str | Path, *, env: str | None = None) -> Demos:
    """Opens a folder that ``save_demos`` wrote; the data stay on disk until read. Nothing is unpickled.

    Args:
        path: the folder.
        env: the env that the demonstrations must be of, if that matters.

    Raises:
        FileNotFoundError: if ``path`` holds no demonstrations.
        ValueError: on another format version or env, and on data other than the manifest's.
    """
    path = Path(path)
    manifest = _read_manifest(path)
    if env is not None and manifest["env"] != env:
        raise ValueError(f"{path} holds demonstrations of env {manifest['env']!r}, expected {env!r}.")
    try:
        data = read_tensordict(path / "data")
    except (OSError, ValueError) as error:
        raise ValueError(f"the data of {path} cannot be read: {error}") from error
    if _described(data) != {name: manifest[name] for name in _described(data)}:
        raise ValueError(f"the data of {path} are not those of its manifest: they were changed or cut short.")
    return Demos(_buffer(data), manifest)


def _read_manifest(path: Path) -> dict[str, Any]:
    file = path / "manifest.json"
    if not file.is_file():
        raise FileNotFoundError(f"{path} holds no demonstrations: there is no manifest.json in it.")
    manifest = read_json(file)
    if manifest.get("format") != FORMAT:
        raise ValueError(f"{path} holds no demonstrations: its manifest.json is not marked {FORMAT!r}.")
    found = entry(manifest, "format_version", int, str(file))
    if found != FORMAT_VERSION:
        raise ValueError(f"{path} has format version {found}, this version of nht reads {FORMAT_VERSION}.")
    for name, kind in ENTRIES.items():
        entry(manifest, name, kind, str(file))
    known_entries(manifest, [*ENTRIES, "checksum"], str(file))
    expected = manifest.pop("checksum", None)
    if expected is not None and checksum(manifest) != expected:
        raise ValueError(
            f"{file} was changed since it was written: its checksum is that of another manifest."
        )
    return manifest


def _buffer(data: TensorDictBase) -> ReplayBuffer:
    """A buffer over ``data``, not copied, that takes no more."""
    return ReplayBuffer(storage=TensorStorage(data), writer=ImmutableDatasetWriter())


def _named(values: Any, name: str) -> dict[str, Tensor]:
    """Arrays by key, those of a context; a single one stands under "context"."""
    given = values if isinstance(values, Mapping) else {"context": values}
    return {key: as_tensor(value, f"{name}, key {key!r}") for key, value in given.items()}


def _manifest(
    data: TensorDictBase, *, env: str, seed: int | None, expert: str, settings: dict[str, Any]
) -> dict[str, Any]:
    check(data)
    described = _described(data)
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "env": env,
        "seed": seed,
        "expert": expert,
        "settings": settings,
        **described,
        "versions": _versions(),
    }


def _described(data: TensorDictBase) -> dict[str, Any]:
    """What a manifest says of the data themselves."""
    return {
        "episodes": len(torch.unique(data["episode"])),
        "transitions": len(data),
        "keys": {
            key_name(key): {"shape": list(value.shape[1:]), "dtype": str(value.dtype)}
            for key, value in items(data)
        },
        "fingerprint": _fingerprint(data),
    }


def _fingerprint(data: TensorDictBase) -> str:
    digest = hashlib.sha256()
    for key, value in items(data):
        digest.update(f"{key_name(key)} {value.dtype} {tuple(value.shape)};".encode())
        digest.update(raw(value))
    return digest.hexdigest()


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found
