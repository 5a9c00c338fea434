"""A map in one file: a safetensors file with the weights and, as JSON in its header, all it takes to rebuild the map.

Loading checks every part and never unpickles. The header can be read without this package:
`safetensors.safe_open(path, "pt").metadata()["map"]`.
"""

import json
import os
import tempfile
from collections.abc import Iterator
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
    """Writes a map to one file, in one go: a reader sees the old file or the new one, never half of it.

    Besides the weights (normaliser and bounds are among them, as buffers) it holds class and constructor arguments,
    context keys in order, n and k, the bounds and the certificate as plain numbers, and the data's fingerprint.
    """
    path = Path(path)
    keys = map.context_keys
    description = {
        "class": type(map).__name__,
        "init_args": map.init_args(),
        "context_keys": None
        if keys is None
        else [key if isinstance(key, str) else list(key) for key in keys],
        "context_dim": map.context_dim,
        "actuation_dim": map.actuation_dim,
        "action_dim": map.action_dim,
        "action_scale": float(map.action_scale),
        "actuation_low": map.actuation_low.tolist(),
        "actuation_high": map.actuation_high.tolist(),
        "lipschitz_certificate": certificate(map),
        "data_fingerprint": map.data_fingerprint,
        "nht_version": version("nht"),
    }
    header = {"format": FORMAT, "format_version": str(FORMAT_VERSION), "map": json.dumps(description)}
    tensors = {name: value.detach().cpu().contiguous() for name, value in map.state_dict().items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as scratch:
        save_file(tensors, Path(scratch) / path.name, header)
        os.replace(Path(scratch) / path.name, path)
    return path


def load_map(path: str | Path, device: torch.device | str = "cpu") -> ActionMap:
    """Reads a map back, ready to use: in eval mode, its parameters without gradients.

    A map of a class of your own loads once that subclass of `ActionMap` has been imported.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is truncated, not a map, of a newer format, of an unknown class, or its weights do not fit.
    """
    header, tensors = _read(Path(path))
    if header.get("format") != FORMAT:
        raise ValueError(f"{path} is not an action map: its header is not marked {FORMAT!r}")
    if header.get("format_version") != str(FORMAT_VERSION):
        raise ValueError(
            f"{path} has format version {header.get('format_version')}, this version of nht reads {FORMAT_VERSION}"
        )
    description = json.loads(header["map"])
    map = _build(description, path)
    _fill(map, tensors, path)
    keys = description["context_keys"]
    map.context_keys = (
        None if keys is None else tuple(key if isinstance(key, str) else tuple(key) for key in keys)
    )
    map.data_fingerprint = description["data_fingerprint"]
    return map.to(device).eval().requires_grad_(False)


def _read(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    if not path.is_file():
        raise FileNotFoundError(f"there is no map file {path}")
    try:
        with safe_open(path, framework="pt") as file:
            return file.metadata() or {}, {name: file.get_tensor(name) for name in file.keys()}
    except SafetensorError as error:
        raise ValueError(f"{path} is not a safetensors file, or is cut short: {error}") from error


def _build(description: dict[str, Any], path: str | Path) -> ActionMap:
    """The untrained twin of the saved map."""
    name = description["class"]
    known = {candidate.__name__: candidate for candidate in _subclasses(ActionMap)}
    if name not in known:
        raise ValueError(
            f"{path} holds a map of the unknown class {name!r}; known are {', '.join(sorted(known))}. "
            "Import the module of a class of your own before loading."
        )
    try:
        return known[name](**description["init_args"])
    except TypeError as error:
        raise ValueError(f"{path} holds arguments that {name} does not take: {error}") from error


def _subclasses(parent: type[ActionMap]) -> Iterator[type[ActionMap]]:
    for child in parent.__subclasses__():
        if not child.__abstractmethods__:
            yield child
        yield from _subclasses(child)


def _fill(map: ActionMap, tensors: dict[str, Tensor], path: str | Path) -> None:
    """Loads the weights, all of them and nothing else, in the precision they were saved in."""
    expected = map.state_dict()
    missing, unexpected = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or unexpected:
        raise ValueError(f"the weights in {path} do not fit {type(map).__name__}: {missing=}, {unexpected=}")
    precision = tensors["action_scale"].dtype
    for name, value in expected.items():
        found = tensors[name]
        wanted = precision if value.is_floating_point() else value.dtype
        if found.shape != value.shape or found.dtype != wanted:
            raise ValueError(
                f"the weights in {path} do not fit {type(map).__name__}: {name} is {found.dtype} "
                f"{tuple(found.shape)}, expected {wanted} {tuple(value.shape)}"
            )
    map.to(precision).load_state_dict(tensors)
