"""Finds the context in Gymnasium's data, and turns actions into actuations, in NumPy arrays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray
from tensordict import NestedKey

from nht import ActionMap
from nht.transforms.arguments import resolve_context_keys

Floats = NDArray[np.floating[Any]]
Flags = NDArray[np.bool_]


class GymnasiumMapping:
    """What both wrappers share: finding the context, and turning actions into actuations.

    Args:
        map: the wrapper's own, see ``take_map``.
        context_keys: as of the wrappers.
        observation_space: of the wrapped environment.
        action_space: of the wrapped environment.
        lead: what stands in front of every shape: (), or (N,) for a vector.
    """

    def __init__(
        self,
        map: ActionMap,
        context_keys: Sequence[NestedKey] | None,
        observation_space: Space[Any],
        action_space: Space[Any],
        lead: tuple[int, ...] = (),
    ) -> None:
        self.keys = resolve_context_keys(map, context_keys)
        self.map = map
        self.lead = lead
        box = _actuation_space(action_space, (*lead, map.actuation_dim))
        device = map.action_scale.device
        self.low, self.high = (torch.tensor(limit, device=device) for limit in (box.low, box.high))
        dtype = _numpy_dtype(map.action_scale.dtype)
        self.action_space = Box(-1.0, 1.0, (*lead, map.action_dim), dtype)
        self.single_action_space = Box(-1.0, 1.0, (map.action_dim,), dtype)
        observed = {key: _find(_by_key(observation_space), key) for key in self.keys}
        if None not in observed.values():  # otherwise it is known after the first reset
            self._check(observed)

    def context(self, observation: Any, info: dict[str, Any], rows: Flags | None = None) -> Floats:
        """The context (*lead, context_dim); it must be there for the copies ``rows`` (N,), by default for all."""
        observed = _by_key(observation)
        values = {}
        for key in self.keys:
            value = _find(observed, key)
            if value is None:
                value = self._from_info(key, info, rows, observed)
            values[key] = np.asarray(value)
        self._check(values)
        columns = [np.reshape(value, (*self.lead, -1)) for value in values.values()]
        return np.concatenate(columns, axis=-1) if columns else np.empty((*self.lead, 0), np.float32)

    def _from_info(
        self, key: NestedKey, info: dict[str, Any], rows: Flags | None, observed: Mapping[str, Any]
    ) -> Any:
        value = _find(info, key)
        if value is None:
            raise KeyError(
                f"no context key {key!r}: the observation has {list(observed)}, info has {_names(info)}."
            )
        *outer, name = (key,) if isinstance(key, str) else key
        has = _find(info, (*outer, f"_{name}")) if self.lead else None
        if has is not None:
            missing = ~has if rows is None else rows & ~has
            if missing.any():
                raise KeyError(f"info has no {key!r} of the copies {np.flatnonzero(missing).tolist()}.")
        return value

    def _check(self, entries: Mapping[NestedKey, Any]) -> None:
        """Check that every entry, an array or a space, is of floats and that the widths add up to the map's."""
        widths = {}
        for key, entry in entries.items():
            if entry.dtype is None or not np.issubdtype(entry.dtype, np.floating):
                raise TypeError(f"context key {key!r} must be of floats, got {entry.dtype}.")
            width = entry.shape[len(self.lead) :] or (1,)
            if entry.shape[: len(self.lead)] != self.lead or len(width) > 1:
                wanted = ", ".join(map(str, [*self.lead, "width"]))
                raise ValueError(f"context key {key!r} must have the shape ({wanted}), got {entry.shape}.")
            widths[key] = width[0]
        if sum(widths.values()) != self.map.context_dim:
            sizes = ", ".join(f"{key!r}: {width}" for key, width in widths.items())
            raise ValueError(
                f"the map's context has {self.map.context_dim} entries, "
                f"the context keys {sum(widths.values())} ({sizes})."
            )

    @torch.no_grad()
    def actuation(self, action: Floats, context: Floats | None) -> Floats:
        """Actuation (*lead, n) for an action (*lead, k), in the dtype of the environment's action space."""
        if context is None:
            raise ResetNeeded("call reset before the first step.")
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            raise ValueError(f"expected an action of shape {self.action_space.shape}, got {action.shape}.")
        given, seen = (self.map.action_scale.new_tensor(values) for values in (action, context))
        actuation: Floats = self.map.decode(given, seen, self.low, self.high).cpu().numpy()
        return actuation


def _numpy_dtype(dtype: torch.dtype) -> type[np.floating[Any]]:
    """The NumPy type for a map's dtype; single precision where NumPy has none."""
    if dtype == torch.float64:
        return np.float64
    return np.float16 if dtype == torch.float16 else np.float32


def _actuation_space(space: Space[Any], shape: tuple[int, ...]) -> Box:
    if not isinstance(space, Box) or not np.issubdtype(space.dtype, np.floating):
        raise TypeError(f"the environment's actions are not continuous: {space}.")
    if space.shape != shape:
        raise ValueError(
            f"the map drives {shape[-1]} actuators, the environment's actions have the shape {space.shape}."
        )
    return space


def _by_key(observation: Any) -> Mapping[str, Any]:
    """A Dict observation or space unchanged; any other under the key ``"observation"``."""
    return observation if isinstance(observation, Mapping) else {"observation": observation}


def _find(entries: Any, key: NestedKey) -> Any:
    """The entry of a Mapping, or of Mappings within it; None if there is none."""
    for name in (key,) if isinstance(key, str) else key:
        entries = entries.get(name) if isinstance(entries, Mapping) else None
    return entries


def _names(info: Mapping[str, Any]) -> list[str]:
    """The keys of ``info`` without masks."""
    return [key for key in info if not str(key).startswith("_")]
