"""The data that a map is trained on: context and actuation of demonstrations, and the held-out episodes."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDict
from torch import Tensor

from nht.demos import Demos
from nht.maps import ActionMap, LinearActionMap

RANK_TOLERANCE = 1e-5  # actuations' singular values below this share of the largest one are rounding


def split_episodes(episode: Tensor, share: float, seed: int) -> Tensor:
    """Hold out a share of the episodes, at least one, never all: (T,) -> (T,) bool, true where held out.

    Of a single episode its last steps are held out: neighbours in time are too alike to be drawn at random.
    """
    names = torch.unique(episode)
    if len(names) == 1 and len(episode) > 1:
        return torch.arange(len(episode)) >= len(episode) - max(1, round(share * len(episode)))
    if len(names) < 2:
        raise ValueError(f"at least 2 transitions are needed, to hold one out, but there is {len(episode)}.")
    count = min(max(1, round(share * len(names))), len(names) - 1)
    order = torch.randperm(len(names), generator=torch.Generator().manual_seed(seed))
    return torch.isin(episode, names[order[:count]])


def context_keys_of(
    demos: Demos, map: ActionMap, context_keys: Sequence[NestedKey] | None
) -> tuple[NestedKey, ...]:
    """The entries that make up the context: those given, else the map's own, else "context".

    Raises:
        ValueError: if none are given and there is no such entry.
    """
    if context_keys is not None:
        return tuple(context_keys)
    if map.context_keys is not None:
        return map.context_keys
    if map.context_dim == 0:
        return ()
    if "context" in demos.data:
        return ("context",)
    raise ValueError(
        f"context_keys must name some of the demonstrations' keys: {', '.join(demos.manifest['keys'])}."
    )


def training_data(demos: Demos, map: ActionMap, keys: Sequence[NestedKey]) -> TensorDict:
    """Context and actuation of all transitions, in memory, in the map's precision and on its device.

    Raises:
        KeyError: on a context key that the demonstrations lack, or lack under "next" where the map needs it.
        ValueError: on demonstrations that do not fit the map, or have fewer than k independent actuations.
    """
    context, actuation = demos.context(keys), demos.actuation
    if actuation.shape[-1] != map.actuation_dim:
        raise ValueError(
            f"demonstrated actuations have {actuation.shape[-1]} dimensions, the map's {map.actuation_dim}."
        )
    if context.shape[-1] != map.context_dim:
        widths = ", ".join(f"{key!r}: {demos.data[key].shape[-1]}" for key in keys)
        raise ValueError(
            f"the map's context has width {map.context_dim}, the keys give {context.shape[-1]}: {widths}."
        )
    affine = isinstance(map, LinearActionMap) and map.offset_model is not None
    spread = actuation.double() - actuation.double().mean(0) if affine else actuation.double()
    singular = torch.linalg.svdvals(spread)
    rank = int((singular > RANK_TOLERANCE * singular[0]).sum())
    if map.learns and rank < map.action_dim < map.actuation_dim:
        raise ValueError(
            f"the demonstrations have {rank} independent actuations"
            f"{', measured from their mean' if affine else ''}, too few for k = {map.action_dim}."
        )
    data = TensorDict({"context": context, "actuation": actuation}, batch_size=len(actuation))
    if map.needs_next_context:
        data["next", "context"] = _next_context(demos, map, keys)
    return data.to(map.action_scale.device, map.action_scale.dtype)


def _next_context(demos: Demos, map: ActionMap, keys: Sequence[NestedKey]) -> Tensor:
    following = [("next", *((key,) if isinstance(key, str) else key)) for key in keys]
    missing = [key for key in following if key not in demos.data.keys(include_nested=True)]
    if missing:
        raise KeyError(
            f"{type(map).__name__} learns from the next context too, but the demonstrations lack "
            f"{', '.join(repr(key) for key in missing)}; a LASER with beta_dynamics=0 does without."
        )
    return demos.context(following)
