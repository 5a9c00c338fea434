"""Reads from an environment's specs which actuation a map has to make."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Composite, TensorSpec, Unbounded
from torchrl.data.tensor_specs import Stacked
from torchrl.envs import EnvBase
from torchrl.envs.transforms import RewardSum, StepCounter, Transform

STATE_ONLY = (RewardSum, StepCounter)
"""Transforms that add to the input, but leave actions alone. For that they ask the chain ahead of them for its specs,
which an ObservationNorm without statistics cannot tell yet."""


def transformed_action_spec(base: EnvBase, ahead: Sequence[Transform]) -> Composite:
    """The action spec of the environment after the transforms ahead."""
    spec = base.input_spec.clone()
    for transform in ahead:
        if not isinstance(transform, STATE_ONLY):
            spec = transform.transform_input_spec(spec)
    return spec["full_action_spec"]


def transformed_observation_spec(base: EnvBase, ahead: Sequence[Transform]) -> Composite:
    """The observation spec of the environment after the transforms ahead."""
    spec = base.output_spec.clone()
    for transform in ahead:
        spec = transform.transform_output_spec(spec)
    return spec["full_observation_spec"]


def find_actuation_spec(action_spec: Composite, key: NestedKey, actuation_dim: int) -> TensorSpec:
    """The spec of the environment's own action, (*batch, n).

    Raises:
        KeyError: if there is no such action.
        TypeError: if it is not continuous.
        ValueError: if its width is not the map's.
    """
    keys = list(action_spec.keys(True, True))
    if key not in keys:
        raise KeyError(f"the environment has no action {key!r}; it has {keys}.")
    spec = action_spec[key]
    if not spec.dtype.is_floating_point:
        raise TypeError(
            f"the environment's action {key!r} is not continuous: {type(spec).__name__} of {spec.dtype}."
        )
    if not spec.shape or spec.shape[-1] != actuation_dim:
        raise ValueError(
            f"the map drives {actuation_dim} actuators, "
            f"the environment's action {key!r} has the shape {tuple(spec.shape)}."
        )
    return spec


def limits(spec: TensorSpec, batch_dims: int) -> tuple[Tensor, Tensor]:
    """Lowest and highest actuation, infinite if unbounded: of one copy, or of all copies if their limits differ."""
    if isinstance(spec, Stacked):
        lows, highs = zip(*(limits(part, 0) for part in spec.unbind(spec.stack_dim)), strict=True)
        return torch.stack(lows, spec.stack_dim), torch.stack(highs, spec.stack_dim)
    if isinstance(spec, Unbounded):
        high = torch.full(spec.shape[batch_dims:], torch.inf, dtype=spec.dtype, device=spec.device)
        return -high, high
    low, high = spec.space.low, spec.space.high
    first = (0,) * batch_dims
    if low.equal(low[first].expand_as(low)) and high.equal(high[first].expand_as(high)):
        low, high = low[first], high[first]  # these fit any batch, such as that of a masked step
    return low.clone(), high.clone()
