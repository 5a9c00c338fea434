"""Writes the file of a checkpoint, which ``checkpoint_file`` describes and reads."""

from __future__ import annotations

import hashlib
import json
import uuid
import zipfile
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from nht.memmap_files import TENSORDICT_TYPE, raw
from nht.reading import checksum
from nht.recipes.run.checkpoint_file import CHECKPOINT_MANIFEST, CHUNK_BYTES, FORMAT, FORMAT_VERSION
from nht.recipes.run.state_json import as_json


def write_checkpoint(file: Path, parts: Mapping[str, Any]) -> None:
    """Write state dictionaries to a new file.

    Args:
        file: path of a file that does not exist yet.
        parts: by name, dictionaries of tensors, arrays, numbers, text, lists, tuples and dictionaries.

    Raises:
        OSError: if there is no room.
        TypeError: for values of other types.
    """
    records: dict[str, Any] = {}
    sums: dict[str, str] = {}
    with zipfile.ZipFile(file, "x", zipfile.ZIP_STORED) as archive:
        for number, (name, state) in enumerate(sorted(parts.items())):
            folder = f"components/{number:04d}-{name}"
            tensors: dict[str, Tensor] = {}
            files: dict[str, bytes | Tensor] = {
                "state.json": json.dumps(as_json(state, tensors), separators=(",", ":")).encode()
            }
            about: dict[str, Any] = {key: _about(value) for key, value in tensors.items()}
            about |= {"shape": [], "device": "cpu", "_type": TENSORDICT_TYPE}
            files["state/meta.json"] = json.dumps(about, separators=(",", ":")).encode()
            files |= {f"state/{key}.memmap": value for key, value in tensors.items() if value.numel()}
            for inner, content in files.items():
                sums[f"{folder}/{inner}"] = _write(archive, f"{folder}/{inner}", content)
            records[name] = {
                "adapter": "torchrl.state_dict",
                "adapter_version": 1,
                "path": folder,
                "files": sorted(files),
            }
        manifest = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "container": "archive",
            "checkpoint_id": uuid.uuid4().hex,
            "created_at": datetime.now(UTC).isoformat(),
            "versions": {package: version(package) for package in ("nht", "torchrl", "tensordict", "torch")},
            "metadata": {},
            "components": records,
            "sha256": sums,
        }
        _write(
            archive,
            CHECKPOINT_MANIFEST,
            json.dumps(manifest | {"checksum": checksum(manifest)}, indent=2).encode(),
        )


def size_of(state: Any) -> int:
    """Bytes of all tensors and arrays in a state dictionary."""
    if isinstance(state, Tensor):
        return state.numel() * state.element_size()
    if isinstance(state, np.ndarray):
        return state.nbytes
    if isinstance(state, Mapping):
        return sum(size_of(value) for value in state.values())
    return sum(map(size_of, state)) if isinstance(state, (list, tuple)) else 0


def _about(value: Tensor) -> dict[str, Any]:
    return {"device": "cpu", "shape": list(value.shape), "dtype": str(value.dtype), "is_nested": False}


def _write(archive: zipfile.ZipFile, name: str, content: bytes | Tensor) -> str:
    """Write a member and return its SHA-256."""
    view = raw(content) if isinstance(content, Tensor) else memoryview(content)
    digest = hashlib.sha256()
    with archive.open(zipfile.ZipInfo(name), "w", force_zip64=True) as member:
        for start in range(0, len(view), CHUNK_BYTES):
            digest.update(view[start : start + CHUNK_BYTES])
            member.write(view[start : start + CHUNK_BYTES])
    return digest.hexdigest()
