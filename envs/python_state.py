"""The state that a Gymnasium environment keeps in Python: generators, clocks, goals, and all of it without MuJoCo."""

from __future__ import annotations

import types
from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np

from nht.envs.gymnasium_internals import GENERATOR

PLAIN_TYPES = (bool, int, float, str, np.bool_, np.integer, np.floating, types.NoneType)
CONSTANT = (
    *(types.FunctionType, types.BuiltinFunctionType, types.MethodType, types.ModuleType, type),
    *(gymnasium.Space, gymnasium.envs.registration.EnvSpec, np.dtype),
)
"""Types of attributes that steps do not change."""


class PythonState:
    """The attributes of an environment, its wrappers, and the environments that it holds, as far as steps change them.

    It saves plain attributes (numbers, text, arrays, and lists, sets and dicts of them) that have changed since the
    environment was made: so a saved state does not contain the options of its environment.

    Args:
        env: just made, not reset yet.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        self._env = env
        self._made = {place: _plain_attributes(part) for place, part in self._parts()}

    @property
    def unknown(self) -> str:
        """Names and types of the attributes that cannot be saved; ``""`` if there are none."""
        found = [
            f"{type(part).__name__}.{name} is a {type(value).__module__}.{type(value).__qualname__}"
            for _, part in self._parts()
            for name, value in vars(part).items()
            if name != GENERATOR
            and not isinstance(value, (gymnasium.Env, *CONSTANT))
            and not _is_plain(value)
        ]
        return ", ".join(found)

    def state_dict(self) -> dict[str, Any]:
        """For each environment, by its place, the attributes changed since it was made, and its generator."""
        saved: dict[str, Any] = {}
        for place, part in self._parts():
            made = self._made.get(place, {})
            now = _plain_attributes(part)
            changed = {
                name: encoded(value)
                for name, value in now.items()
                if name not in made or not _alike(value, made[name])
            }
            saved[place] = {"attributes": changed}
            if (generator := vars(part).get(GENERATOR)) is not None:
                saved[place]["generator"] = generator.bit_generator.state
        return saved

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        for place, part in self._parts():
            if place not in saved:
                continue
            made = self._made.get(place, {})
            changed = {name: decoded(value) for name, value in saved[place]["attributes"].items()}
            for name in _plain_attributes(part):
                if name not in changed and name not in made:
                    delattr(part, name)
            for name, value in {**{n: _copied(v) for n, v in made.items()}, **changed}.items():
                _assign(part, name, value)
            if "generator" in saved[place]:
                part.np_random.bit_generator.state = saved[place]["generator"]

    def _parts(self) -> Iterator[tuple[str, gymnasium.Env[Any, Any]]]:
        """The environment, those that it wraps or that these hold, each once, by the attributes that lead there."""
        seen: set[int] = set()
        waiting = [("env", self._env)]
        while waiting:
            place, part = waiting.pop(0)
            if id(part) in seen:
                continue
            seen.add(id(part))
            yield place, part
            waiting += [
                (f"{place}.{name}", value)
                for name, value in vars(part).items()
                if isinstance(value, gymnasium.Env)
            ]


def _assign(part: gymnasium.Env[Any, Any], name: str, value: Any) -> None:
    """Set an attribute; an array, to which others may refer, is overwritten in place."""
    there = vars(part).get(name)
    if (
        isinstance(there, np.ndarray)
        and isinstance(value, np.ndarray)
        and there.flags.writeable
        and (there.shape, there.dtype) == (value.shape, value.dtype)
    ):
        there[...] = value
    else:
        setattr(part, name, value)


def _plain_attributes(part: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    return {
        name: _copied(value) for name, value in vars(part).items() if name != GENERATOR and _is_plain(value)
    }


def _is_plain(value: Any) -> bool:
    if isinstance(value, np.ndarray):
        return value.dtype.kind in "biuf"
    if isinstance(value, dict):
        return all(isinstance(key, str) and _is_plain(each) for key, each in value.items())
    if isinstance(value, list | tuple | set | frozenset):
        return all(_is_plain(each) for each in value)
    return isinstance(value, PLAIN_TYPES)


def _copied(value: Any) -> Any:
    return decoded(encoded(value))


def _alike(one: Any, other: Any) -> bool:
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and np.array_equal(one, other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_alike(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(_alike, one, other))
    return bool(one == other)


def encoded(value: Any) -> Any:
    """A plain value as numbers, text, arrays and dicts only: a sequence becomes a dict that names its type."""
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, np.generic):
        return {"scalar": np.array(value)}
    if isinstance(value, dict):
        return {"dict": {key: encoded(each) for key, each in value.items()}}
    if isinstance(value, list | tuple | set | frozenset):
        items = sorted(value, key=repr) if isinstance(value, set | frozenset) else value
        kind = type(value).__name__ if type(value) in SEQUENCES.values() else "tuple"
        return {kind: {str(i): encoded(each) for i, each in enumerate(items)}}
    return value


def decoded(saved: Any) -> Any:
    """The value that ``encoded`` was given."""
    if not isinstance(saved, dict):
        return saved.copy() if isinstance(saved, np.ndarray) else saved
    ((kind, items),) = saved.items()
    if kind == "scalar":
        return np.asarray(items)[()]
    if kind == "dict":
        return {key: decoded(each) for key, each in items.items()}
    return SEQUENCES[kind](decoded(items[str(i)]) for i in range(len(items)))


SEQUENCES: dict[str, type] = {"list": list, "tuple": tuple, "set": set, "frozenset": frozenset}
