"""The file of a policy: its weights in safetensors, with a checksum in the header."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from nht.memmap_files import raw
from nht.reading import plain_file, shortened, shown
from nht.writing import publish, scratch

CHECKSUM = "sha256"
"""Key of the checksum in the header. It is the only entry: safetensors writes several in a varying order."""


def write_policy(weights: Mapping[str, Tensor], file: Path) -> None:
    """Write weights, whole or not at all.

    Raises:
        OSError: if there is no room.
    """
    tensors = {name: value.detach().cpu().contiguous() for name, value in weights.items()}
    with scratch(file) as place:
        place.write_bytes(save(tensors, {CHECKSUM: _checksum(tensors)}))
        publish(place, file)


def read_policy(file: Path, expected: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The weights of a policy.

    Args:
        file: of the policy; those of earlier versions have no checksum.
        expected: the weights of the untrained policy, by name.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no safetensors file, was changed, has other weights than those expected, or has weights
            that are not finite.
    """
    plain_file(file)
    try:
        with safe_open(file, framework="pt") as opened:
            about = opened.metadata() or {}
            found = {name: opened.get_tensor(name) for name in opened.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, RuntimeError, KeyError) as error:
        raise ValueError(f"{file} is no safetensors file, or is cut short: {shortened(error)}.") from error
    if about and about.get(CHECKSUM) != _checksum(found):
        raise ValueError(
            f"{file} was changed since it was written, or holds no policy: its checksum is another."
        )
    missing, unknown = sorted(expected.keys() - found.keys()), sorted(found.keys() - expected.keys())
    if missing or unknown:
        raise ValueError(
            f"{file} is not of this policy: missing {shown(missing)}, unexpected {shown(unknown)}."
        )
    for name, value in found.items():
        own = expected[name]
        if value.shape != own.shape or value.dtype != own.dtype:
            raise ValueError(
                f"{file} is not of this policy: {name} is {value.dtype} {tuple(value.shape)}, expected {own.dtype} "
                f"{tuple(own.shape)}."
            )
        if not value.isfinite().all():
            raise ValueError(f"{file} holds NaN or infinite values in {name}: training had diverged.")
    return found


def _checksum(tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)};".encode())
        digest.update(raw(value))
    return digest.hexdigest()
