"""The manifest of demonstrations: what was recorded, by whom and with which versions, and a fingerprint of the data."""

from __future__ import annotations

import hashlib
import json
from importlib import metadata
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from nht.episodes import check, items, key_name
from nht.memmap_files import raw
from nht.reading import checksum, entry, known_entries, read_json

DEMOS_FORMAT = "nht.demos"
DEMOS_FORMAT_VERSION = 1
DEMOS_MANIFEST = "manifest.json"
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
"""Entries of a manifest and their types; earlier versions wrote no ``checksum``, which is over all others."""


def manifest_of(
    data: TensorDictBase, *, env: str, seed: int | None, expert: str, settings: dict[str, Any]
) -> dict[str, Any]:
    """The manifest of demonstrations.

    Args:
        data: the demonstrations, as ``save_demos`` takes them.
        env: name of the env.
        seed: what the collection was seeded with, if it was.
        expert: name of the demonstrator.
        settings: options of env and expert, JSON values.

    Raises:
        KeyError: if "actuation" or "episode" is missing.
        ValueError: on data that are no whole, finite demonstrations.
    """
    check(data)
    return {
        "format": DEMOS_FORMAT,
        "format_version": DEMOS_FORMAT_VERSION,
        "env": env,
        "seed": seed,
        "expert": expert,
        "settings": settings,
        **described(data),
        "versions": _versions(),
    }


def described(data: TensorDictBase) -> dict[str, Any]:
    """The entries of a manifest that describe the data."""
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


def manifest_text(manifest: dict[str, Any]) -> str:
    """The text of a manifest's file.

    Raises:
        TypeError: if its settings hold other values than JSON has.
    """
    manifest = json.loads(json.dumps(manifest))  # as it will be read
    return json.dumps(manifest | {"checksum": checksum(manifest)}, indent=2) + "\n"


def read_manifest(path: Path) -> dict[str, Any]:
    """The manifest of the demonstrations in a folder, checked, without its checksum.

    Raises:
        FileNotFoundError: if the folder holds no demonstrations.
        ValueError: on another format version, on entries that are missing, unknown or of other types, and on a manifest
            that was changed.
    """
    file = path / DEMOS_MANIFEST
    if not file.is_file():
        raise FileNotFoundError(f"{path} holds no demonstrations: there is no {DEMOS_MANIFEST} in it.")
    manifest = read_json(file)
    if manifest.get("format") != DEMOS_FORMAT:
        raise ValueError(
            f"{path} holds no demonstrations: its {DEMOS_MANIFEST} is not marked {DEMOS_FORMAT!r}."
        )
    found = entry(manifest, "format_version", int, str(file))
    if found != DEMOS_FORMAT_VERSION:
        raise ValueError(
            f"{path} has format version {found}, this version of nht reads {DEMOS_FORMAT_VERSION}."
        )
    for name, kind in ENTRIES.items():
        entry(manifest, name, kind, str(file))
    known_entries(manifest, [*ENTRIES, "checksum"], str(file))
    expected = manifest.pop("checksum", None)
    if expected is not None and checksum(manifest) != expected:
        raise ValueError(
            f"{file} was changed since it was written: its checksum is that of another manifest."
        )
    return manifest
