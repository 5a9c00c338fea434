"""A map in one safetensors file: the weights and, as JSON in the header, what is needed to rebuild the map.

Loading checks every part, never unpickles, and imports nothing that the caller has not allowed. The header can be read
without this package: ``json.loads(safetensors.safe_open(path, "pt").metadata()["map"])``.
"""

from __future__ import annotations

import hashlib
import json
import math
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from nht.action_map import ActionMap
from nht.allowance import Allowance
from nht.description import describe, of_version_1, twin
from nht.reading import shortened
from nht.storable import check_storable, state_of
from nht.writing import replacing

__all__ = ["format_version", "load_map", "save_map"]

MAP_FORMAT = "nht.action_map"
MAP_FORMAT_VERSION = 2
LONGEST_REASON = 600  # characters of what an error says about a file


def save_map(map: ActionMap, path: str | Path) -> Path:
    """Write a map to one file; a reader sees the old file or the whole new one, never a part.

    Normaliser, scale and bounds are buffers and therefore among the weights. The header has the class, by module and
    name, the constructor's arguments, the context's keys in order and the saturation; for whoever reads only the header
    k, n, scale, bounds, certificate, the fingerprint of the data and the version; and a checksum over all of it.

    The same map gives the same bytes.

    Returns:
        The path.

    Raises:
        TypeError: if an argument of the constructor cannot stand in a file; ``train_map`` says so before it trains.
        ValueError: if a weight is not finite, or a map loaded from the file would be another one.
    """
    path = Path(path)
    tensors = state_of(map)
    _check_finite(tensors, check_storable(map).state_dict())
    text = json.dumps(describe(map))
    header = {"format": MAP_FORMAT, "format_version": str(MAP_FORMAT_VERSION), "map": text}
    header["checksum"] = _checksum(text, tensors)
    content = _in_order(save(tensors, header))
    with replacing(path) as scratch:
        scratch.write_bytes(content)
    return path


def load_map(path: str | Path, device: torch.device | str = "cpu", *, allow: Sequence[str] = ()) -> ActionMap:
    """Read a map, ready to use: in eval mode, its parameters without gradients.

    A class of your own is found if its module has been imported, or if ``allow`` names the module or a package that
    holds it; then it is imported. Maps in files of format version 1 clip actuations.

    Args:
        path: of a file that ``save_map`` wrote.
        device: where the map shall be.
        allow: modules and packages that may be imported, and so run, for the map's class.

    Raises:
        FileNotFoundError: if there is no such file.
        PermissionError: if it may not be read.
        ValueError: if the file is cut short, no map, changed since it was written, of another format version or of a
            class that is not found; if its weights do not fit the class or are not finite.
    """
    path = Path(path)
    _check_readable(path)
    try:
        map = _loaded(path, allow)
    except Exception as error:  # whatever stands in a file, the answer names the file
        known = isinstance(error, ValueError) and not isinstance(error, UnicodeError | json.JSONDecodeError)
        reason = str(error) if known else f"its description is damaged: {type(error).__name__}: {error}"
        raise ValueError(f"{path} {shortened(reason, LONGEST_REASON)}.") from error
    return map.to(device).eval().requires_grad_(False)


def _in_order(content: bytes) -> bytes:
    """A safetensors file with what it says beside its tensors by name: safetensors writes that in any order."""
    start = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:start])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)  # tensors begin at a multiple of their numbers' size
    return len(text).to_bytes(8, "little") + text + content[start:]


def _checksum(text: str, tensors: dict[str, Tensor]) -> str:
    """SHA-256 of the description and, in the order of their names, every tensor's name, type, shape and bytes."""
    digest = hashlib.sha256(text.encode())
    for name, value in sorted(tensors.items()):
        digest.update(f"\n{name} {value.dtype} {list(value.shape)}\n".encode())
        digest.update(value.reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _check_readable(path: Path) -> None:
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise ValueError(f"{path} is no file that holds a map, but a folder or a device.")
        path.open("rb").close()
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileNotFoundError(f"there is no map file {path}.") from error
    except PermissionError as error:
        raise PermissionError(
            f"the map file {path} may not be read by this user: {error.strerror}."
        ) from error


def _loaded(path: Path, allow: Sequence[str]) -> ActionMap:
    header, tensors = _read(path)
    if header.get("format") != MAP_FORMAT:
        raise ValueError(f"holds no action map: its header is not marked {MAP_FORMAT!r}.")
    found = header.get("format_version")
    if found not in ("1", str(MAP_FORMAT_VERSION)):
        raise ValueError(f"has format version {found}, this version of nht reads 1 and {MAP_FORMAT_VERSION}.")
    if found == "1" and "checksum" in header:
        raise ValueError("was changed: it says format version 1, which has no checksum, and has one.")
    text = header["map"]
    if found != "1" and header.get("checksum") != _checksum(text, tensors):
        raise ValueError("has been changed since it was written: its checksum does not fit.")
    description = json.loads(text)
    if found == "1":
        description = of_version_1(description)
    with Allowance(sum(value.nbytes for value in tensors.values())):
        map = twin(description, allow)
    _check_finite(tensors, map.state_dict())
    _fill(map, tensors)
    _check_description(map, description)
    return map


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"is no safetensors file, or is cut short: {shortened(error)}.") from error


def _fill(map: ActionMap, tensors: dict[str, Tensor]) -> None:
    """Load the weights, all of them and no others, in the precision they were saved in."""
    name, untrained = type(map).__name__, map.state_dict()
    if untrained.keys() != tensors.keys():
        raise ValueError(
            f"holds weights that do not fit {name}: missing {sorted(untrained.keys() - tensors.keys())}, "
            f"unexpected {sorted(tensors.keys() - untrained.keys())}."
        )
    precision = tensors["action_scale"].dtype
    for key, value in untrained.items():
        allowed = [value.dtype]
        if value.is_floating_point():
            # That of the map; only what was of another one from the start may have kept it.
            allowed = [precision] if value.dtype == map.action_scale.dtype else [precision, value.dtype]
        given = tensors[key]
        if given.shape != value.shape or given.dtype not in allowed:
            raise ValueError(
                f"holds weights that do not fit {name}: {key} is {given.dtype} {tuple(given.shape)}, "
                f"expected {allowed[0]} {tuple(value.shape)}."
            )
    map.to(precision)
    for key, value in map.state_dict(keep_vars=True).items():
        value.data = value.data.to(tensors[key].dtype)
    map.load_state_dict(tensors)


def _check_description(map: ActionMap, description: dict[str, Any]) -> None:
    """Check that the header's entries for people agree with the map."""
    for name in ("context_dim", "actuation_dim", "action_dim", "action_scale"):
        if description[name] != (actual := float(getattr(map, name))):
            raise ValueError(
                f"contradicts itself: its description has {name} {description[name]}, its map {actual:g}."
            )


def _check_finite(tensors: dict[str, Tensor], untrained: dict[str, Any]) -> None:
    """Refuse NaN anywhere, and infinities where the untrained map has none."""
    scale = tensors.get("action_scale")
    if scale is None or scale.ndim or not 0 < float(scale) < math.inf:
        raise ValueError(f"holds a map whose action_scale is {scale}; it must be a positive, finite number.")
    for key, value in tensors.items():
        unbounded = key in untrained and bool(untrained[key].isinf().any())
        if not (~value.isnan() if unbounded else value.isfinite()).all():
            raise ValueError(f"holds a map whose {key} is not finite everywhere.")


def format_version(path: str | Path) -> int:
    """The format version of a map file: 1 for those that say neither saturation nor offset.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no map file.
    """
    _check_readable(Path(path))
    try:
        return int(_read(Path(path))[0].get("format_version", "0"))
    except ValueError as error:
        raise ValueError(f"{path} {shortened(error)}.") from error
