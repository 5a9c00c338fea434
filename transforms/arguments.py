"""Arguments that the transform and the wrappers share, checked and resolved; needs no TorchRL."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path

from tensordict import NestedKey, unravel_key
from torch import Tensor

from nht import ActionMap, load_map
from nht.saturation import Saturation

MapOrFile = ActionMap | str | Path


def take_map(
    map: MapOrFile,
    action_scale: float | Tensor | None = None,
    saturation: Saturation | None = None,
    allow: Sequence[str] = (),
) -> ActionMap:
    """A copy of a map, or the map in a file: frozen and in eval mode, with the given scale and saturation.

    Args:
        map: a map, of which this is a copy, or the path of a file of ``nht.save_map``.
        action_scale: what a policy's action of 1 stands for, in the map's own units. None leaves the map's.
        saturation: ``"scale"`` or ``"clip"``. None leaves the map's.
        allow: modules that may be imported for the class of a map in a file, see ``nht.load_map``.

    Raises:
        TypeError: if ``map`` is neither.
        FileNotFoundError: if there is no such file.
        ValueError: if the file holds no map; if the action scale, given or the map's own, is not positive and finite;
            on another saturation.
    """
    if isinstance(map, str | Path):
        taken = load_map(map, allow=allow)
    elif isinstance(map, ActionMap):
        taken = copy.deepcopy(map)
    else:
        raise TypeError(
            f"map must be an nht.ActionMap, or the path of a map's file, got {type(map).__name__}."
        )
    taken.requires_grad_(False).eval()
    taken.set_action_scale(taken.action_scale if action_scale is None else action_scale)
    if saturation is not None:
        taken.saturation = saturation
    return taken


def resolve_context_keys(map: ActionMap, given: Sequence[NestedKey] | None) -> list[NestedKey]:
    """Keys of the entries that are concatenated into the map's context; none if its context is empty.

    Args:
        map: its own keys are the default.
        given: keys; a nested one is a tuple, or a list as in JSON and YAML, within a list.

    Raises:
        ValueError: if there are none but the map needs some, or the other way round, or if they are those of the
            map in another order.
    """
    own = None if map.context_keys is None else [unravel_key(key) for key in map.context_keys]
    if given is None:
        if own is None and map.context_dim:
            raise ValueError(
                f"context_keys must name the entries that make up the map's context of {map.context_dim}: "
                "the map does not know them, as it was not trained on demonstrations."
            )
        return own if own and map.context_dim else []
    listed = [given] if isinstance(given, str) else given
    keys = [unravel_key(key if isinstance(key, str) else tuple(key)) for key in listed]
    if own is not None and keys != own and set(keys) == set(own):
        raise ValueError(f"the map was trained on context_keys {own}, in this order; got {keys}.")
    if bool(keys) != bool(map.context_dim):
        raise ValueError(f"the map's context has {map.context_dim} entries, got context_keys {keys}.")
    return keys


def check_distinct(action_keys: set[NestedKey], context_key: NestedKey, executed_key: NestedKey) -> None:
    """Check that no two entries have the same key; only the policy's action may share the actuation's.

    Raises:
        ValueError: if two have.
    """
    if context_key == executed_key or {context_key, executed_key} & action_keys:
        raise ValueError(
            f"context_key {context_key!r} and executed_key {executed_key!r} must differ from each other and "
            f"from the action's keys, {', '.join(sorted(map(repr, action_keys)))}."
        )
