"""What the paper's DDPG adds to TorchRL's loss."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.objectives import DDPGLoss
from torchrl.objectives.value import TD0Estimator


class ClippedTD0Estimator(TD0Estimator):
    """One-step targets, held within the returns that rewards in [-1, 0] can add up to: [-1 / (1 - gamma), 0]."""

    def value_estimate(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> Tensor:
        """Clipped targets ``(*batch, 1)``."""
        return (
            super().value_estimate(tensordict, *args, **kwargs).clamp(lowest_return(float(self.gamma)), 0.0)
        )


class PaperDDPGLoss(DDPGLoss):
    """``DDPGLoss`` with both target networks, clipped targets, and an actor that pays for large actions.

    Args:
        actor_network: ``"features"`` to an ``"action"`` in [-1, 1]^k.
        value_network: features and action to a ``"state_action_value"``.
        gamma: discount factor.
        action_l2: weight of the mean squared action in the actor's loss.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule,
        *,
        gamma: float,
        action_l2: float,
    ) -> None:
        super().__init__(actor_network, value_network, delay_actor=True, delay_value=True)
        self.action_l2 = action_l2
        estimator = ClippedTD0Estimator(gamma=gamma, value_network=self.actor_critic)
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


def lowest_return(gamma: float) -> float:
    """Discounted return of -1 a step for ever."""
    return -1.0 / (1.0 - gamma)


def charge_failure(tensordict: TensorDictBase, gamma: float) -> TensorDictBase:
    """Let an episode that failure ended cost what going on at -1 for ever would: failing early never pays."""
    outcome = tensordict["next"]
    fatal = outcome["failure"] & outcome["terminated"]
    outcome["reward"] = torch.where(fatal, lowest_return(gamma), outcome["reward"])
    return tensordict
