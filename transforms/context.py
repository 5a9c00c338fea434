"""Reads and checks the raw context in TorchRL's data."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.data import Composite
from torchrl.envs.transforms import Transform


def read_context(tensordict: TensorDictBase, keys: Sequence[NestedKey], dtype: torch.dtype) -> Tensor:
    """The context in raw observations, (*batch, context_dim).

    Always a copy, for environments may reuse the buffers that they hand out.
    """
    return torch.cat([tensordict[key] for key in keys], -1).to(dtype)


def check_context(
    observation_spec: Composite, keys: Sequence[NestedKey], lead: torch.Size, context_dim: int
) -> None:
    """Check that every key is there, of floats, shaped (*lead, width), and that the widths add up to the map's.

    Raises:
        KeyError: if one is not there.
        TypeError: if one is not of floats.
        ValueError: on another shape or width, or if the actuation is a sequence, as MultiAction makes it.
    """
    if -1 in lead:
        raise ValueError(
            "the environment takes several actuations at once, but there is one context for all of them: "
            "put MultiAction behind the ActionMapTransform."
        )
    available = list(observation_spec.keys(True, True))
    for key in keys:
        if key not in available:
            raise KeyError(f"the environment has no context key {key!r}; it has {available}.")
        spec = observation_spec[key]
        if not spec.dtype.is_floating_point:
            raise TypeError(f"context key {key!r} must be of floats, got {spec.dtype}.")
        if not spec.shape or spec.shape[:-1] != lead:
            raise ValueError(
                f"context key {key!r} must have the shape ({', '.join(map(str, [*lead, 'width']))}), "
                f"as the actuation has, got {tuple(spec.shape)}."
            )
    widths = {key: observation_spec[key].shape[-1] for key in keys}
    if sum(widths.values()) != context_dim:
        sizes = ", ".join(f"{key!r}: {width}" for key, width in widths.items())
        raise ValueError(
            f"the map's context has {context_dim} entries, the context keys {sum(widths.values())} ({sizes})."
        )


def check_writers(ahead: Sequence[Transform], keys: Sequence[NestedKey], made: set[NestedKey]) -> None:
    """Check that no transform ahead rewrites a context entry that another one, or the environment, made.

    Raises:
        ValueError: if one does.
    """
    for key in keys:
        writers = [transform for transform in ahead if key in transform.out_keys]
        if len(writers) > (key in made):
            raise ValueError(
                f"{type(writers[-1]).__name__} rewrites context key {key!r}: "
                "put the ActionMapTransform in front of it."
            )
