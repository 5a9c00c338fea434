"""The JSON description of a map in its file, beside the weights: people can read it, and it makes an untrained twin."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

from nht.action_map import ActionMap
from nht.arguments import plain
from nht.lipschitz import certificate
from nht.map_classes import find_by_name, find_class, identity
from nht.reading import shortened


def describe(map: ActionMap) -> dict[str, Any]:
    """The description of a map for the header of its file: JSON values, None where a number is infinite.

    Raises:
        TypeError: if an argument of its constructor cannot stand in a file.
    """
    return {
        **_core(map),
        "context_dim": map.context_dim,
        "actuation_dim": map.actuation_dim,
        "action_dim": map.action_dim,
        "action_scale": float(map.action_scale),
        "actuation_low": [_finite(value) for value in map.actuation_low.tolist()],
        "actuation_high": [_finite(value) for value in map.actuation_high.tolist()],
        "lipschitz_certificate": _finite(certificate(map)),
        "nht_version": version("nht"),
    }


def twin(description: dict[str, Any], allow: Sequence[str] = ()) -> ActionMap:
    """The described map before training, with context keys, fingerprint and saturation of the described one.

    Args:
        description: from ``describe``, or from ``of_version_1``.
        allow: modules that may be imported for its classes.

    Raises:
        ValueError: on a class that is not found, or arguments that it does not take.
        KeyError, TypeError: on a description that is damaged.
    """
    module, name = description["module"], description["class"]
    kind = find_by_name(name) if module is None else find_class(module, name, allow)
    positional = [_decoded(value, allow) for value in description.get("init_positional", [])]
    named = {key: _decoded(value, allow) for key, value in description["init_args"].items()}
    try:
        map = kind(*positional, **named)
    except TypeError as error:
        raise ValueError(f"holds arguments that {name} does not take: {shortened(error)}.") from error
    keys = description["context_keys"]
    if keys is not None:
        map.context_keys = tuple(_key(key) for key in keys)
    fingerprint = description["data_fingerprint"]
    if not isinstance(fingerprint, str | None):
        raise TypeError(f"data_fingerprint is {fingerprint!r}.")
    map.data_fingerprint = fingerprint
    map.saturation = description["saturation"]
    return map


def of_version_1(description: dict[str, Any]) -> dict[str, Any]:
    """A description of format version 1 as one of today's: actuations were clipped, and classes had no module."""
    arguments = {key: _value_of_version_1(value) for key, value in description["init_args"].items()}
    if description["class"] == "NHT":
        arguments |= {"start": "random", "offset": "none"}
    elif description["class"] in ("SVD", "SCL"):
        arguments |= {"offset": "none"}
    missing = {"context_keys": None, "data_fingerprint": None}  # of a map within a map
    return missing | description | {"module": None, "saturation": "clip", "init_args": arguments}


def _value_of_version_1(value: Any) -> Any:
    return of_version_1(value) if isinstance(value, dict) and "class" in value else _as_it_is(value)


def _as_it_is(value: Any) -> Any:
    """An argument of format version 1, in which every JSON object was a dictionary, as it is written today."""
    if isinstance(value, dict):
        return {"dict": {key: _as_it_is(one) for key, one in value.items()}}
    return [_as_it_is(one) for one in value] if isinstance(value, list) else value


def _core(map: ActionMap) -> dict[str, Any]:
    """What ``twin`` needs to know about a map."""
    module, name = identity(type(map))
    positional = {"init_positional": [_encoded(value) for value in map.init_positional()]}
    return {
        "class": name,
        "module": module,
        "init_args": {key: _encoded(value) for key, value in map.init_args().items()},
        **(positional if positional["init_positional"] else {}),
        "context_keys": map.context_keys,
        "data_fingerprint": map.data_fingerprint,
        "saturation": map.saturation,
    }


def _encoded(value: Any) -> Any:
    """An argument in JSON. Objects stand for maps, for dictionaries and for the numbers that JSON lacks."""
    if isinstance(value, ActionMap):
        return _core(value)
    if isinstance(value, float) and not math.isfinite(value):
        return {"number": str(value)}
    if isinstance(value, dict):
        return {"dict": {key: _encoded(one) for key, one in value.items()}}
    if isinstance(value, list | tuple):
        return [_encoded(one) for one in value]
    return plain(value)


def _decoded(value: Any, allow: Sequence[str]) -> Any:
    if isinstance(value, list):
        return [_decoded(one, allow) for one in value]
    if not isinstance(value, dict):
        return value
    if "class" in value:
        return twin(value, allow)
    if "number" in value:
        return float(value["number"])
    return {key: _decoded(one, allow) for key, one in value["dict"].items()}


def _key(key: Any) -> str | tuple[str, ...]:
    parts = [key] if isinstance(key, str) else key
    if not parts or not all(isinstance(part, str) for part in parts):
        raise TypeError(f"a context key is {key!r}.")
    return key if isinstance(key, str) else tuple(parts)


def _finite(value: float) -> float | None:
    """JSON has no infinity."""
    return value if math.isfinite(value) else None
