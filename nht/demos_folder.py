"""Demonstrations on disk, in a folder that is complete or not there at all.

``manifest.json`` says what was recorded, by whom and with which versions, and has a fingerprint of the data; ``data/``
has one raw file per key, mapped into memory when it is read. Nothing is pickled.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tensordict import TensorDictBase

from nht.demos import Demos, immutable_buffer
from nht.episodes import items
from nht.manifest import DEMOS_MANIFEST, described, manifest_of, manifest_text, read_manifest
from nht.memmap import read_tensordict
from nht.memmap_files import STORAGE, write_tensordict
from nht.reading import shortened
from nht.writing import check_room, publish, scratch


def save_demos(
    data: TensorDictBase | Demos,
    path: str | Path,
    *,
    env: str | None = None,
    seed: int | None = None,
    expert: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Demos:
    """Write demonstrations to a new folder, all or nothing.

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
    manifest = manifest_of(
        data,
        env=about.get("env", "unknown") if env is None else env,
        seed=about.get("seed") if seed is None else seed,
        expert=about.get("expert", "unknown") if expert is None else expert,
        settings=dict(about.get("settings", {}) if settings is None else settings),
    )
    text = manifest_text(manifest)
    size = sum(value.numel() * value.element_size() for _, value in items(data))
    check_room(path.parent, size, f"saving demonstrations in {path}")
    with scratch(path) as place:
        write_tensordict(data, place / "data")
        (place / "data" / STORAGE).write_text(
            json.dumps({"metadata": {}, "is_pytree": False, "len": len(data)})
        )
        (place / DEMOS_MANIFEST).write_text(text)
        publish(place, path)
    return load_demos(path)


def load_demos(path: str | Path, *, env: str | None = None) -> Demos:
    """Open a folder that ``save_demos`` wrote; the data stay on disk until read. Nothing is unpickled.

    Args:
        path: the folder.
        env: the env that the demonstrations must be of, if that matters.

    Raises:
        FileNotFoundError: if ``path`` holds no demonstrations.
        ValueError: on another format version or env, and on data other than the manifest's.
    """
    path = Path(path)
    manifest = read_manifest(path)
    if env is not None and manifest["env"] != env:
        raise ValueError(f"{path} holds demonstrations of env {manifest['env']!r}, expected {env!r}.")
    try:
        data = read_tensordict(path / "data")
    except (OSError, ValueError) as error:
        raise ValueError(f"the data of {path} cannot be read: {shortened(error, 600)}.") from error
    if described(data) != {name: manifest[name] for name in described(data)}:
        raise ValueError(f"the data of {path} are not those of its manifest: they were changed or cut short.")
    return Demos(immutable_buffer(data), manifest)
