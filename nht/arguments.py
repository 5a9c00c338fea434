"""The arguments of a map's constructor: saved in the map's file, they make its untrained twin."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from torch import nn

POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.VAR_POSITIONAL)


def remembering_arguments(constructor: Callable[..., None]) -> Callable[..., None]:
    """Let a constructor store the arguments of the outermost call in the attribute ``_recorded_arguments``."""

    @functools.wraps(constructor)
    def __init__(self: nn.Module, *args: Any, **kwargs: Any) -> None:  # noqa: N807 (tracebacks show this name)
        if "_recorded_arguments" not in self.__dict__:
            self.__dict__["_recorded_arguments"] = recorded(self, args, kwargs)
        constructor(self, *args, **kwargs)

    return __init__


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


def named_arguments(map: nn.Module, given: Mapping[str, Any]) -> dict[str, Any]:
    """The arguments by name that, after those of ``positional_arguments``, make a twin of ``map``.

    Args:
        map: an object that has been constructed; its attributes take precedence over what was given.
        given: from ``recorded``.

    Raises:
        TypeError: if an argument can be saved neither from an attribute nor as it was given.
    """
    named: dict[str, Any] = {}
    for parameter in _parameters(map)[_by_position(map) :]:
        if parameter.kind is inspect.Parameter.VAR_KEYWORD:
            others = _given(map, parameter.name, given)
            named |= {name: _argument(map, name, others) for name in others}
        else:
            named[parameter.name] = _argument(map, parameter.name, given)
    return named


def positional_arguments(map: nn.Module, given: Mapping[str, Any]) -> tuple[Any, ...]:
    """The values of positional-only arguments, and of those before them; arguments and errors as above."""
    values: list[Any] = []
    for parameter in _parameters(map)[: _by_position(map)]:
        if parameter.kind is inspect.Parameter.VAR_POSITIONAL:
            values += _given(map, parameter.name, given)
        else:
            values.append(_argument(map, parameter.name, given))
    return tuple(values)


def _parameters(map: nn.Module) -> list[inspect.Parameter]:
    return list(inspect.signature(type(map).__init__).parameters.values())[1:]


def _by_position(map: nn.Module) -> int:
    """How many parameters must be given by position: up to the last of those that have no name."""
    kinds = [parameter.kind for parameter in _parameters(map)]
    return max((i + 1 for i, kind in enumerate(kinds) if kind in POSITIONAL), default=0)


def plain(value: Any) -> Any:
    """A value that can be saved: numpy's numbers become Python's; maps and tuples stay as they are.

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
