"""Checks whether a map can be saved: its file must give the same map again."""

from __future__ import annotations

import json
from typing import Any

import torch
from torch import Tensor

from nht.action_map import ActionMap
from nht.arguments import plain
from nht.reading import shortened


@torch.no_grad()
def check_storable(map: ActionMap) -> ActionMap:
    """Build the twin that a file of this map would give, to find out before training whether the map can be saved.

    Returns:
        The twin: constructed alike, not trained.

    Raises:
        TypeError: if an argument of the constructor cannot stand in a file, or the state is not all of tensors.
        ValueError: if the twin is another map.
    """
    refused = f"{type(map).__name__} could not be loaded after saving"
    given = _listed(map)
    try:
        other = type(map)(*map.init_positional(), **map.init_args())
    except Exception as error:  # of a constructor of any kind
        raise ValueError(
            f"{refused}: {given} raise {type(error).__name__}: {shortened(error, 600)}."
        ) from error
    if (again := _listed(other)) != given:
        raise ValueError(
            f"{refused}: an attribute named like an argument of the constructor must be that argument, but "
            f"{given} turns into {again}."
        )
    shapes, expected = (
        {(key, value.shape) for key, value in state.items()} for state in (other.state_dict(), state_of(map))
    )
    if shapes != expected:
        raise ValueError(f"{refused}: constructed again, its weights differ: {sorted(shapes ^ expected)}.")
    return other


def _listed(map: ActionMap) -> str:
    """The constructor's arguments, as text to compare."""

    def listed(value: Any) -> Any:
        if isinstance(value, ActionMap):
            return {type(value).__name__: [listed(value.init_positional()), listed(value.init_args())]}
        if isinstance(value, dict):
            return {key: listed(one) for key, one in value.items()}
        return [listed(one) for one in value] if isinstance(value, list | tuple) else plain(value)

    return json.dumps(listed(map))


def state_of(map: ActionMap) -> dict[str, Tensor]:
    """The state as it is saved: on the CPU, with separate copies of tied weights."""
    state = map.state_dict()
    if strange := [key for key, value in state.items() if not isinstance(value, Tensor)]:
        raise TypeError(
            f"the state of {type(map).__name__} has entries that are no tensors: {', '.join(strange)}."
        )
    return {key: value.detach().cpu().contiguous().clone() for key, value in state.items()}
