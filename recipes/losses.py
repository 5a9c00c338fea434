"""What the paper's DDPG adds to TorchRL's loss."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.objectives import DDPGLoss
from torchrl.objectives.value import TD0Estimator

Range = tuple[float, float]


class ClippedTD0Estimator(TD0Estimator):
    """One-step targets, held within the discounted returns that are possible.

    Args:
        returns: the lowest and the highest one.
        options: those of ``TD0Estimator``.
    """

    def __init__(self, *, returns: Range, **options: Any) -> None:
        super().__init__(**options)
        self.returns = returns

    def value_estimate(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> Tensor:
        """Clipped targets ``(*batch, 1)``."""
        return super().value_estimate(tensordict, *args, **kwargs).clamp(*self.returns)


class PaperDDPGLoss(DDPGLoss):
    """``DDPGLoss`` with both target networks, clipped targets, and an actor that pays for large actions.

    Args:
        actor_network: ``"features"`` to an ``"action"`` in [-1, 1]^k.
        value_network: features and action to a ``"state_action_value"``.
        gamma: discount factor.
        action_l2: weight of the mean squared action in the actor's loss.
        reward_range: smallest and largest reward of a step, infinite where unknown.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule,
        *,
        gamma: float,
        action_l2: float,
        reward_range: Range = (-1.0, 0.0),
    ) -> None:
        super().__init__(actor_network, value_network, delay_actor=True, delay_value=True)
        self.action_l2 = action_l2
        returns = return_range(reward_range, gamma)
        estimator = ClippedTD0Estimator(returns=returns, gamma=gamma, value_network=self.actor_critic)
        estimator.set_keys(value=self.tensor_keys.state_action_value)
        self.make_value_estimator(estimator)

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss, a scalar."""
        state = tensordict.select(*self.actor_in_keys)
        with self.actor_network_params.to_module(self.actor_network):
            state = self.actor_network(state)
        with self.value_network_params.detach().to_module(self.value_network):
            value = self.value_network(state).get(self.tensor_keys.state_action_value)
        return self.action_l2 * state["action"].square().mean() - value.mean(), {}


def reward_range(env: EnvBase) -> Range:
    """Smallest and largest reward of a step, as the environment's spec has it; infinite where it knows none."""
    space = env.reward_spec.space
    # TorchRL writes "unbounded" as the largest numbers of the type.
    low, high = float(space.low.min()), float(space.high.max())
    largest = torch.finfo(env.reward_spec.dtype).max
    return (low if low > -largest else -math.inf), (high if high < largest else math.inf)


def return_range(reward_range: Range, gamma: float) -> Range:
    """The lowest and the highest discounted return that such rewards can add up to: over no step, or for ever."""
    low, high = reward_range
    return min(low, 0.0) / (1.0 - gamma), max(high, 0.0) / (1.0 - gamma)


def charge_failure(
    tensordict: TensorDictBase, gamma: float, reward_range: Range = (-1.0, 0.0)
) -> TensorDictBase:
    """Let an episode that failure ended be worth the lowest return, where there is one: failing early never pays."""
    lowest, _ = return_range(reward_range, gamma)
    if math.isfinite(lowest):
        outcome = tensordict["next"]
        fatal = outcome["failure"] & outcome["terminated"]
        outcome["reward"] = torch.where(fatal, lowest, outcome["reward"])
    return tensordict
