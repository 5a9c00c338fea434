"""What a map's constructor was given, so that a file can hold it and make the map's twin."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import numpy as np
from torch import nn

POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.VAR_POSITIONAL)


def recorded(map: nn.Module, args: tuple[Any, ...], kwargs: dict[str, Any]) -> dict[str, Any]:
    """The constructor's arguments by the names of its parameters, defaults among them.

    Those that cannot stand in a file are left out: whether that matters shows when a file is written.

    Args:
        map: the object that is being constructed.
        args: what its constructor is given by position, without ``self``.
        kwargs: what it is given by name.
    """
    try:
        bound = inspect.signature(type(map).__init__).bind(map, *args, **kwargs)
    except TypeError:  # the constructor says it better
        return {}
    bound.apply_defaults()
    kept = {}
    for name, value in list(bound.arguments.items())[1:]:
        try:
            kept[name] = plain(value)
        except TypeError:
            continue
    return kept


def constructor_arguments(map: nn.Module, given: Mapping[str, Any]) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """The arguments that make a twin of ``map``: by position, where there is no other way, and by name.

    Args:
        map: an object that has been constructed; its attributes go before what was given.
        given: from `recorded`.

    Raises:
        TypeError: if one is neither an attribute that can stand in a file nor was given as such.
    """
    parameters = list(inspect.signature(type(map).__init__).parameters.values())[1:]
    by_position = max((i for i, one in enumerate(parameters) if one.kind in POSITIONAL), default=-1)
    positional: list[Any] = []
    named: dict[str, Any] = {}
    for i, parameter in enumerate(parameters):
        name = parameter.name
        if parameter.kind is inspect.Parameter.VAR_POSITIONAL:
            positional += _given(map, name, given)
        elif parameter.kind is inspect.Parameter.VAR_KEYWORD:
            rest = _given(map, name, given)
            named |= {key: _argument(map, key, rest) for key in rest}
        elif i < by_position:
            positional.append(_argument(map, name, given))
        else:
            named[name] = _argument(map, name, given)
    return tuple(positional), named


def plain(value: Any) -> Any:
    """A value as it can stand in a file: numpy's numbers become Python's; maps and tuples stay.

    Raises:
        TypeError: on anything but numbers, text, None, other maps, and lists and dictionaries of these.
    """
    if value is None or isinstance(value, bool | int | float | str) or _is_map(value):
        return value
    if isinstance(value, np.bool_ | np.integer | np.floating):
        return value.item()
    if isinstance(value, tuple):
        return tuple(plain(one) for one in value)
    if isinstance(value, list):
        return [plain(one) for one in value]
    if isinstance(value, dict) and all(isinstance(key, str) for key in value):
        return {key: plain(one) for key, one in value.items()}
    raise TypeError(
        f"{type(value).__name__} is neither number, text, None, map, nor a list or dict of these."
    )


def _is_map(value: Any) -> bool:
    return isinstance(value, nn.Module) and hasattr(value, "init_args")


def _argument(map: nn.Module, name: str, given: Mapping[str, Any]) -> Any:
    try:
        return plain(getattr(map, name))
    except (AttributeError, TypeError):
        return _given(map, name, given)


def _given(map: nn.Module, name: str, given: Mapping[str, Any]) -> Any:
    if name not in given:
        raise TypeError(
            f"the argument {name!r} of {type(map).__name__} can stand in no file: keep it as an attribute {name!r} "
            "that is a number, text, None, another map, or a list or dictionary of these, or override init_args."
        )
    return given[name]
