"""A map in one safetensors file: the weights and, as JSON in the header, what it takes to rebuild the map.

Loading checks every part and never unpickles. The header can be read without this package:
`json.loads(safetensors.safe_open(path, "pt").metadata()["map"])`.
"""

import inspect
import json
import math
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from nht.lipschitz import certificate
from nht.maps import ActionMap

FORMAT = "nht.action_map"
FORMAT_VERSION = 1


def save_map(map: ActionMap, path: str | Path) -> Path:
    """Writes a map to one file; a reader sees the old file or the whole new one, never a part.

    Normaliser and bounds are buffers and therefore among the weights. The header has class, constructor
    arguments and the context's keys in order; and for whoever reads only the header k, n, bounds,
    certificate, the fingerprint of the data and the version.

    Returns:
        The path.
    """
    path = Path(path)
    header = {"format": FORMAT, "format_version": str(FORMAT_VERSION), "map": json.dumps(describe(map))}
    tensors = {name: value.detach().cpu().contiguous() for name, value in map.state_dict().items()}
    with replacing(path) as scratch:
        save_file(tensors, scratch, header)
    return path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A scratch file of the same name, which takes the place of `path` once it is written whole."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        scratch = Path(folder) / path.name
        yield scratch
        os.replace(scratch, path)


def load_map(path: str | Path, device: torch.device | str = "cpu") -> ActionMap:
    """Reads a map, ready to use: in eval mode, its parameters without gradients.

    A class of your own is found once its module is imported.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file is cut short, no map, of another format version or of an unknown class, or if
            its weights do not fit the class.
    """
    path = Path(path)
    header, tensors = _read(path)
    if header.get("format") != FORMAT:
        raise ValueError(f"{path} holds no action map: its header is not marked {FORMAT!r}")
    found = header.get("format_version")
    if found != str(FORMAT_VERSION):
        raise ValueError(f"{path} has format version {found}, this version of nht reads {FORMAT_VERSION}")
    try:
        description = json.loads(header["map"])
        map = _untrained(description, path)
        keys = description["context_keys"]
        map.data_fingerprint = description["data_fingerprint"]
    except (KeyError, TypeError, json.JSONDecodeError) as error:
        raise ValueError(f"{path} is an action map, but its description is damaged: {error}") from error
    map.context_keys = (
        None if keys is None else tuple(key if isinstance(key, str) else tuple(key) for key in keys)
    )
    _fill(map, tensors, path)
    return map.to(device).eval().requires_grad_(False)


def describe(map: ActionMap) -> dict[str, Any]:
    """What whoever reads only the header learns of a map: JSON values, None where a number is infinite."""
    return {
        "class": type(map).__name__,
        "init_args": _encoded(map),
        "context_keys": map.context_keys,
        "data_fingerprint": map.data_fingerprint,
        "context_dim": map.context_dim,
        "actuation_dim": map.actuation_dim,
        "action_dim": map.action_dim,
        "action_scale": float(map.action_scale),
        "actuation_low": [_finite(value) for value in map.actuation_low.tolist()],
        "actuation_high": [_finite(value) for value in map.actuation_high.tolist()],
        "lipschitz_certificate": _finite(certificate(map)),
        "nht_version": version("nht"),
    }


def _encoded(map: ActionMap) -> dict[str, Any]:
    """A map's arguments; a map among them becomes its class and arguments."""
    return {
        name: {"class": type(value).__name__, "init_args": _encoded(value)}
        if isinstance(value, ActionMap)
        else value
        for name, value in map.init_args().items()
    }


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return value if math.isfinite(value) else None


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    if not path.is_file():
        raise FileNotFoundError(f"there is no map file {path}")
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except SafetensorError as error:
        raise ValueError(f"{path} is no safetensors file, or is cut short: {error}") from error


def _untrained(description: dict[str, Any], path: Path) -> ActionMap:
    """The saved map's twin, before training."""
    name = description["class"]
    known = {kind.__name__: kind for kind in _subclasses(ActionMap) if not inspect.isabstract(kind)}
    if name not in known:
        raise ValueError(
            f"{path} holds a map of the unknown class {name!r}; known are {', '.join(sorted(known))}. "
            "Import a class of your own before loading its map"
        )
    arguments = {
        key: _untrained(value, path) if isinstance(value, dict) and "class" in value else value
        for key, value in dict(description["init_args"]).items()
    }
    try:
        return known[name](**arguments)
    except TypeError as error:
        raise ValueError(f"{path} holds arguments that {name} does not take: {error}") from error


def _subclasses(parent: type) -> Iterator[type]:
    child: type
    for child in parent.__subclasses__():
        yield child
        yield from _subclasses(child)


def _fill(map: ActionMap, tensors: dict[str, Tensor], path: Path) -> None:
    """Loads the weights, all of them and no others, in the precision they were saved in."""
    untrained = map.state_dict()
    if untrained.keys() != tensors.keys():
        raise ValueError(
            f"the weights in {path} do not fit {type(map).__name__}: "
            f"missing {sorted(untrained.keys() - tensors.keys())}, "
            f"unexpected {sorted(tensors.keys() - untrained.keys())}"
        )
    precision = tensors["action_scale"].dtype
    for name, value in untrained.items():
        dtype = precision if value.is_floating_point() else value.dtype
        if tensors[name].shape != value.shape or tensors[name].dtype != dtype:
            raise ValueError(
                f"the weights in {path} do not fit {type(map).__name__}: {name} is {tensors[name].dtype} "
                f"{tuple(tensors[name].shape)}, expected {dtype} {tuple(value.shape)}"
            )
    map.to(precision).load_state_dict(tensors)


def format_version(path: str | Path) -> int:
    """The format version of a map file.

    Raises:
        FileNotFoundError, ValueError: as `load_map`.
    """
    header, _ = _read(Path(path))
    return int(header.get("format_version", "0"))
