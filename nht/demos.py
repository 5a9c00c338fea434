"""Demonstrations: whole episodes in a TorchRL replay buffer on memory-mapped storage, beside a manifest.

On disk a folder with `manifest.json` (what was recorded, by whom, with which versions, and a fingerprint of the data)
and `data/` (one raw file per key). Nothing in it is pickled, and a folder is either complete or not there.
"""

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import ImmutableDatasetWriter, LazyMemmapStorage, ReplayBuffer

FORMAT = "nht.demos"
FORMAT_VERSION = 1
PACKAGES = ("nht", "torch", "torchrl", "tensordict", "numpy", "mujoco")  # whose versions a manifest records


class Demos:
    """Demonstrations, read-only. Made by `save_demos`, `load_demos` or `Demos.from_tensors`.

    Attributes:
        buffer: a replay buffer over all transitions: `buffer.sample(256)`.
        manifest: env, seed, expert, settings, keys with shapes and dtypes, episodes, transitions, versions, fingerprint.
    """

    def __init__(self, buffer: ReplayBuffer, manifest: Mapping[str, Any]) -> None:
        self.buffer = buffer
        self.manifest = dict(manifest)

    @classmethod
    def from_tensors(
        cls,
        *,
        actuation: Tensor,
        episode: Tensor,
        context: Tensor | Mapping[str, Tensor],
        env: str = "unknown",
    ) -> "Demos":
        """Demonstrations from tensors of your own, kept in temporary memory-mapped files.

        Args:
            actuation: (T, n), in order of time.
            episode: (T,) integers; each episode's rows stand together.
            context: (T, context_dim), stored under "context"; or several such tensors by key.
        """
        entries = dict(context) if isinstance(context, Mapping) else {"context": context}
        entries |= {"actuation": actuation, "episode": episode.long()}
        data = TensorDict(entries, batch_size=actuation.shape[:1])
        return cls(_buffer(data), _manifest(data, env=env, seed=None, expert="unknown", settings={}))

    @property
    def data(self) -> TensorDictBase:
        """All transitions, (T,), in order of time."""
        return self.buffer.storage[: len(self)]

    @property
    def actuation(self) -> Tensor:
        """(T, n)."""
        return self.data["actuation"]

    @property
    def episode(self) -> Tensor:
        """(T,), the episode that each transition belongs to."""
        return self.data["episode"]

    @property
    def fingerprint(self) -> str:
        """SHA-256 over keys, shapes, types and values."""
        return self.manifest["fingerprint"]

    def __len__(self) -> int:
        """The number of transitions."""
        return len(self.buffer)

    def context(self, keys: Sequence[NestedKey]) -> Tensor:
        """The entries of `keys` side by side, (T, context_dim); no keys give (T, 0).

        Raises:
            KeyError: on a key that is not there, naming those that are.
            ValueError: on an entry that is not a row of floating-point numbers per transition.
        """
        data = self.data
        for key in keys:
            if key not in data.keys(include_nested=True, leaves_only=True):
                raise KeyError(
                    f"context key {key!r} is not in the demonstrations; they have {_key_list(data)}"
                )
            if data[key].ndim != 2 or not data[key].is_floating_point():
                raise ValueError(
                    f"context key {key!r} must hold floats of shape (T, width), "
                    f"got {data[key].dtype} of shape {tuple(data[key].shape)}"
                )
        return torch.cat([self.actuation[:, :0], *(data[key] for key in keys)], dim=-1)


def save_demos(
    data: TensorDictBase,
    path: str | Path,
    *,
    env: str,
    seed: int,
    expert: str,
    settings: Mapping[str, Any] | None = None,
) -> Demos:
    """Writes demonstrations to a new folder, all or nothing.

    Args:
        data: (T,) transitions in order of time, with "actuation" (T, n), "episode" (T,) int64 and one entry per raw
            context key; rewards, flags and ("next", key) as you like. Where "done" (T, 1) is given, the last transition
            of each episode must carry it.
        settings: options of env and expert worth keeping, JSON values.

    Raises:
        FileExistsError: if `path` exists: demonstrations are never overwritten.
        KeyError, ValueError: on data that are no whole, finite demonstrations.
    """
    path = Path(path)
    if path.exists():
        raise FileExistsError(
            f"{path} exists; demonstrations are never overwritten: remove it or choose another path"
        )
    manifest = _manifest(data, env=env, seed=seed, expert=expert, settings=dict(settings or {}))
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        _buffer(data, scratch / "data").storage.dumps(scratch / "data")
        (scratch / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n")
        scratch.chmod(0o777 & ~_umask())
        os.rename(scratch, path)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return load_demos(path)


def load_demos(path: str | Path, *, env: str | None = None) -> Demos:
    """Opens a folder that `save_demos` wrote; the data stay on disk until read. Nothing is unpickled.

    Args:
        env: the env that the demonstrations must be of, if it matters.

    Raises:
        FileNotFoundError: if `path` holds no demonstrations.
        ValueError: on another format version, another env, or data that differ from their fingerprint.
    """
    path = Path(path)
    manifest = _read_manifest(path)
    if env is not None and manifest["env"] != env:
        raise ValueError(f"{path} holds demonstrations of env {manifest['env']!r}, expected {env!r}")
    try:
        data = TensorDict.load_memmap(path / "data", allow_pickle=False)
        storage = LazyMemmapStorage(len(data), scratch_dir=path / "data", existsok=True)
        storage.loads(path / "data")  # from its own folder it maps the files and copies nothing
    except Exception as error:
        raise ValueError(f"the data of {path} cannot be read: {error}") from error
    if _fingerprint(data) != manifest["fingerprint"]:
        raise ValueError(f"the data of {path} are not those of its manifest: they were changed or cut short")
    return Demos(ReplayBuffer(storage=storage, writer=ImmutableDatasetWriter()), manifest)


def _read_manifest(path: Path) -> dict[str, Any]:
    try:
        manifest = json.loads((path / "manifest.json").read_text())
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"{path} holds no demonstrations: it has no manifest.json") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"{path / 'manifest.json'} is no JSON: {error}") from error
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise ValueError(f"{path} holds no demonstrations: its manifest.json is not marked {FORMAT!r}")
    if manifest.get("format_version") != FORMAT_VERSION:
        raise ValueError(
            f"{path} has format version {manifest.get('format_version')}, this version of nht reads {FORMAT_VERSION}"
        )
    return manifest


def _buffer(data: TensorDictBase, folder: Path | None = None) -> ReplayBuffer:
    """A full buffer over `data`, in `folder` or in temporary files; then nothing can be added to it."""
    storage = LazyMemmapStorage(len(data), scratch_dir=folder)
    ReplayBuffer(storage=storage).extend(data)
    return ReplayBuffer(storage=storage, writer=ImmutableDatasetWriter())


def _manifest(
    data: TensorDictBase, *, env: str, seed: int | None, expert: str, settings: dict[str, Any]
) -> dict[str, Any]:
    _check(data)
    return {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "env": env,
        "seed": seed,
        "expert": expert,
        "settings": settings,
        "episodes": len(data["episode"].unique()),
        "transitions": len(data),
        "keys": {
            _name(key): {"shape": list(value.shape[1:]), "dtype": str(value.dtype)}
            for key, value in _items(data)
        },
        "versions": _versions(),
        "fingerprint": _fingerprint(data),
    }


def _check(data: TensorDictBase) -> None:
    """Raises unless `data` are whole episodes of finite numbers with an actuation."""
    for key in ("actuation", "episode"):
        if key not in data.keys():
            raise KeyError(f"demonstrations need the key {key!r}; these have {_key_list(data)}")
    if data.batch_dims != 1 or len(data) == 0:
        raise ValueError(
            f"demonstrations must have a batch size (T,) with T >= 1, got {tuple(data.batch_size)}"
        )
    if data["actuation"].ndim != 2 or data["episode"].shape != data.batch_size:
        raise ValueError(
            f"actuation must be (T, n) and episode (T,), got {tuple(data['actuation'].shape)} "
            f"and {tuple(data['episode'].shape)}"
        )
    for key, value in _items(data):
        bad = int((~value.isfinite()).sum()) if value.is_floating_point() else 0
        if bad:
            raise ValueError(
                f"demonstrations must be finite, but key {key!r} holds {bad} NaN or infinite values"
            )
    _check_episodes(data)


def _check_episodes(data: TensorDictBase) -> None:
    episode = data["episode"]
    last = torch.cat([episode[1:] != episode[:-1], episode.new_ones(1, dtype=torch.bool)])
    names = episode[last]
    if len(names) != len(names.unique()):
        torn = [name for name in names.unique().tolist() if (names == name).sum() > 1]
        raise ValueError(
            f"the rows of an episode must stand together, but episodes {torn[:5]} are torn apart"
        )
    if "done" in data.keys():
        open_ended = names[~data["done"].reshape(len(data), -1).any(-1)[last]].tolist()
        if open_ended:
            raise ValueError(
                f"demonstrations must be whole episodes, but {len(open_ended)} of {len(names)} do not end with done, "
                f"the first being episode {open_ended[0]}"
            )


def _fingerprint(data: TensorDictBase) -> str:
    digest = hashlib.sha256()
    for key, value in _items(data):
        digest.update(f"{_name(key)} {value.dtype} {tuple(value.shape)};".encode())
        digest.update(value.contiguous().view(torch.uint8).numpy() if value.numel() else b"")
    return digest.hexdigest()


def _items(data: TensorDictBase) -> list[tuple[NestedKey, Tensor]]:
    """Every tensor with its key, sorted by name."""
    return sorted(data.items(include_nested=True, leaves_only=True), key=lambda item: _name(item[0]))


def _name(key: NestedKey) -> str:
    return key if isinstance(key, str) else "/".join(key)


def _key_list(data: TensorDictBase) -> str:
    return ", ".join(repr(key) for key, _ in _items(data))


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
