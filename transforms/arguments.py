"""What everything that puts a map before an environment makes of its arguments; TorchRL is not needed for it."""

import copy
from collections.abc import Sequence

import torch
from tensordict import NestedKey, unravel_key
from torch import Tensor

from nht import ActionMap


def frozen_copy(map: ActionMap) -> ActionMap:
    """A copy of the map in eval mode, its parameters without gradients."""
    return copy.deepcopy(map).requires_grad_(False).eval()


def resolve_action_scale(map: ActionMap, given: float | None) -> Tensor:
    """What an action of 1 stands for: a scalar tensor of the map's dtype, on its device.

    Args:
        map: whose own scale holds where none is given.
        given: in the map's own units.

    Raises:
        ValueError: if it is not positive and finite.
    """
    scale = torch.as_tensor(map.action_scale if given is None else given)
    if scale.ndim or not scale.isfinite() or scale <= 0:
        raise ValueError(f"action_scale must be a positive, finite number, got {scale.tolist()}")
    return scale.detach().to(map.action_scale, copy=True)


def resolve_context_keys(map: ActionMap, given: Sequence[NestedKey] | None) -> list[NestedKey]:
    """The entries that, side by side, are the map's context; none if its context is empty.

    Args:
        map: whose own keys hold where none are given.
        given: keys; a nested one is a tuple within a list.

    Raises:
        TypeError: if `map` is no ActionMap.
        ValueError: if there are none but the map needs some, or the other way round, or if they are those of the
            map in another order.
    """
    if not isinstance(map, ActionMap):
        raise TypeError(f"map must be an nht.ActionMap, got {type(map).__name__}")
    own = None if map.context_keys is None else [unravel_key(key) for key in map.context_keys]
    if given is None:
        if own is None and map.context_dim:
            raise ValueError(
                f"context_keys must name the entries that make up the map's context of {map.context_dim}: "
                "the map does not know them, as it was not trained on demonstrations"
            )
        return own if own and map.context_dim else []
    keys = [unravel_key(key) for key in ([given] if isinstance(given, str) else given)]
    if own is not None and keys != own and set(keys) == set(own):
        raise ValueError(f"the map was trained on context_keys {own}, in this order; got {keys}")
    if bool(keys) != bool(map.context_dim):
        raise ValueError(f"the map's context has {map.context_dim} entries, got context_keys {keys}")
    return keys
