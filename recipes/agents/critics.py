"""Critics: one, two of one shape that are called at once, and what several quantiles of a return learn by."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TypeAlias

import torch
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import MLP

from nht.recipes.agents.off_policy import OffPolicyConfig
from nht.recipes.agents.perceptrons import HalfPrecisionMLP, perceptron
from nht.recipes.agents.returns import return_range, reward_range
from nht.recipes.agents.stacking import stacked_linear, stacked_norm


def critic_network(env: EnvBase, algo: OffPolicyConfig, quantiles: int = 1) -> TensorDictModule:
    """A critic, features and action to a ``"state_action_value"``; a loss makes two of it, with weights of their own.

    The value has an entry for each of the ``quantiles`` of the return. It starts near ``pessimism`` times the lowest
    possible return, or near 0 if rewards have no bound.
    """
    size, action_dim = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    normed = algo.layer_norm != "none"
    critic = perceptron(algo, size + action_dim, quantiles, env.device, normed=normed)
    lowest, _ = return_range(reward_range(env), algo.gamma)
    nn.init.constant_(critic[-1].bias, algo.pessimism * lowest if math.isfinite(lowest) else 0.0)
    return TensorDictModule(critic, in_keys=["features", "action"], out_keys=["state_action_value"])


def quantile_loss(found: Tensor, target: Tensor) -> Tensor:
    """The quantile Huber loss (Dabney et al. 2018) of each pair of a predicted quantile and a target.

        |tau_i - 1{d < 0}| H(d),   d = y_j - q_i,   tau_i = (i - 1/2) / N,   H(d) = d^2 / 2 or, beyond 1, |d| - 1/2.

    Args:
        found: quantiles q, ``(*batch, N)``.
        target: samples y, ``(*batch, M)``, without a gradient.

    Returns:
        ``(*batch, N, M)``, of which the mean is to be taken.
    """
    count = found.shape[-1]
    levels = ((torch.arange(count, device=found.device) + 0.5) / count).unsqueeze(-1)
    error = target.unsqueeze(-2) - found.unsqueeze(-1)
    huber = torch.nn.functional.huber_loss(error, torch.zeros_like(error), reduction="none")
    return (levels - (error.detach() < 0).float()).abs() * huber


class CriticPair:
    """Two critics whose parameters a TorchRL loss keeps stacked: one batched product per layer computes both.

    TorchRL puts stacked parameters into one module under ``vmap`` before every call, which takes longer than the
    arithmetic of networks as small as ours. The numbers are the same.

    Args:
        critic: module of one critic, an ``MLP`` with ReLU, normalised or not; its precision is used.
        parameters: of both critics, ``(2, ...)`` each, as ``convert_to_functional`` stacks them.

    Raises:
        TypeError: if the critic is another kind of network.
    """

    def __init__(self, critic: nn.Module, parameters: TensorDictParams) -> None:
        known = nn.Linear | nn.LayerNorm | nn.ReLU
        if not isinstance(critic, MLP) or not all(isinstance(layer, known) for layer in critic):
            raise TypeError(
                f"a pair of critics needs an MLP of Linear, LayerNorm and ReLU layers, got {critic}."
            )
        self._layers: list[Layer] = []
        for name, layer in critic.named_children():
            own = () if isinstance(layer, nn.ReLU) else ("weight", "bias")
            self._layers.append((type(layer), tuple(parameters["module", name, part] for part in own)))
        self._half = isinstance(critic, HalfPrecisionMLP)

    def __call__(self, features: Tensor, action: Tensor) -> Tensor:
        """Values ``(2, B)`` of features ``(B, size)`` and actions ``(B, k)``."""
        return self._values(self._layers, features, action)

    def fixed(self, features: Tensor, action: Tensor, critics: int = 2) -> Tensor:
        """Values ``(critics, B)`` of the first ``critics``, whose gradient leaves the critics' weights alone."""
        layers = [(kind, tuple(part[:critics].detach() for part in own)) for kind, own in self._layers]
        return self._values(layers, features, action)

    def _values(self, layers: list[Layer], features: Tensor, action: Tensor) -> Tensor:
        *hidden_layers, (_, last) = layers
        inputs = torch.cat([features, action], -1)
        hidden = inputs.expand(len(last[0]), *inputs.shape)
        with torch.autocast(inputs.device.type, torch.bfloat16, enabled=self._half):
            for kind, own in hidden_layers:
                hidden = CALLS[kind](hidden, *own)
        return stacked_linear(hidden.float(), *last).squeeze(-1)


Layer: TypeAlias = tuple[type[nn.Module], tuple[Tensor, ...]]
"""Its kind, and its parameters for each critic."""

CALLS: dict[type[nn.Module], Callable[..., Tensor]] = {
    nn.Linear: stacked_linear,
    nn.LayerNorm: stacked_norm,
    nn.ReLU: torch.relu,
}
