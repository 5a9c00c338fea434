"""Rewards and returns: their bounds, the cost of a failure, and n-step targets."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import overload

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data.postprocs import MultiStep
from torchrl.envs import EnvBase, TransformedEnv

from nht.recipes.agents.settings import Setting, beside, largest

Range = tuple[float, float]
"""Smallest and largest value."""
UNBOUNDED: Range = (-math.inf, math.inf)


def reward_range(env: EnvBase) -> Range:
    """Smallest and largest reward of a step, as the simulation behind ``env`` knows it; infinite where unknown."""
    base = env.base_env if isinstance(env, TransformedEnv) else env
    found: Range = getattr(getattr(base, "task", None), "reward_range", UNBOUNDED)
    return found


@overload
def return_range(reward_range: Range, gamma: float, steps: float = math.inf) -> Range: ...
@overload
def return_range(reward_range: Range, gamma: Setting, steps: float = math.inf) -> tuple[Setting, Setting]: ...
def return_range(reward_range: Range, gamma: Setting, steps: float = math.inf) -> tuple[Setting, Setting]:
    """The lowest and the highest discounted return of rewards in this range, over 0 to ``steps`` steps."""
    if isinstance(gamma, Tensor):
        ranges = [return_range(reward_range, each, steps) for each in gamma.tolist()]
        lows, highs = (torch.tensor(ends, device=gamma.device) for ends in zip(*ranges, strict=True))
        return lows, highs
    low, high = reward_range
    most = steps if gamma == 1.0 else (1.0 - gamma**steps) / (1.0 - gamma)
    return min(low, 0.0) * most, max(high, 0.0) * most


def charge_failure(
    tensordict: TensorDictBase, gamma: Setting, reward_range: Range, steps: float = math.inf
) -> TensorDictBase:
    """Charge the lowest possible return, if there is one, where a failure ends an episode: failing early never pays."""
    if math.isfinite(reward_range[0]):
        lowest, _ = return_range(reward_range, gamma, steps)
        outcome = tensordict["next"]
        fatal = outcome["failure"] & outcome["terminated"]
        outcome["reward"] = torch.where(fatal, beside(lowest, outcome["reward"]), outcome["reward"])
    return tensordict


def n_step_returns(gamma: Setting, steps: int) -> Callable[[TensorDictBase], TensorDictBase]:
    """TorchRL's ``MultiStep``, which turns steps ``(*batch, T)`` into transitions with up to ``steps`` rewards.

    On its own it moves observations ahead but not the flags that belong to them, so that a target would add the
    critic's value even after a failure.
    """
    if isinstance(gamma, Tensor) and steps > 1:  # each learner has its own
        own = [n_step_returns(each, steps) for each in gamma.tolist()]
        return lambda data: torch.stack([look(part) for look, part in zip(own, data, strict=True)])
    multi_step = MultiStep(largest(gamma), steps)
    multi_step.done_keys = ()
    return multi_step
