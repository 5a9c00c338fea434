"""Two critics of one shape, called at once."""

from __future__ import annotations

import math

import torch
from tensordict.nn import TensorDictModule, TensorDictParams
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import MLP

from nht.recipes.agents.off_policy import HalfPrecisionMLP, OffPolicyConfig
from nht.recipes.agents.returns import return_range, reward_range


def critic_network(env: EnvBase, algo: OffPolicyConfig) -> TensorDictModule:
    """A critic, features and action to a ``"state_action_value"``; a loss makes two of it, with weights of their own.

    It starts near ``pessimism`` times the lowest possible return, or near 0 if rewards have no bound.
    """
    size, action_dim = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    network = HalfPrecisionMLP if algo.bfloat16 else MLP
    critic = network(
        size + action_dim, 1, num_cells=list(algo.hidden), activation_class=nn.ReLU, device=env.device
    )
    lowest, _ = return_range(reward_range(env), algo.gamma)
    nn.init.constant_(critic[-1].bias, algo.pessimism * lowest if math.isfinite(lowest) else 0.0)
    return TensorDictModule(critic, in_keys=["features", "action"], out_keys=["state_action_value"])


class CriticPair:
    """Two critics whose parameters a TorchRL loss keeps stacked: one batched product per layer computes both.

    TorchRL puts stacked parameters into one module under ``vmap`` before every call, which takes longer than the
    arithmetic of networks as small as ours. The numbers are the same.

    Args:
        critic: module of one critic, an ``MLP`` with ReLU; its precision is used.
        parameters: of both critics, ``(2, ...)`` each, as ``convert_to_functional`` stacks them.

    Raises:
        TypeError: if the critic is another kind of network.
    """

    def __init__(self, critic: nn.Module, parameters: TensorDictParams) -> None:
        if not isinstance(critic, MLP) or not all(isinstance(layer, nn.Linear | nn.ReLU) for layer in critic):
            raise TypeError(f"a pair of critics needs an MLP of Linear and ReLU layers, got {critic}.")
        names = [name for name, layer in critic.named_children() if isinstance(layer, nn.Linear)]
        self._layers = [
            (parameters["module", name, "weight"], parameters["module", name, "bias"]) for name in names
        ]
        self._half = isinstance(critic, HalfPrecisionMLP)

    def __call__(self, features: Tensor, action: Tensor) -> Tensor:
        """Values ``(2, B)`` of features ``(B, size)`` and actions ``(B, k)``."""
        return self._values(self._layers, features, action)

    def fixed(self, features: Tensor, action: Tensor, critics: int = 2) -> Tensor:
        """Values ``(critics, B)`` of the first ``critics``, whose gradient leaves the critics' weights alone."""
        layers = [(weight[:critics].detach(), bias[:critics].detach()) for weight, bias in self._layers]
        return self._values(layers, features, action)

    def _values(self, layers: list[tuple[Tensor, Tensor]], features: Tensor, action: Tensor) -> Tensor:
        *hidden_layers, last = layers
        inputs = torch.cat([features, action], -1)
        hidden = inputs.expand(len(last[0]), *inputs.shape)
        with torch.autocast(inputs.device.type, torch.bfloat16, enabled=self._half):
            for layer in hidden_layers:
                hidden = _linear(layer, hidden).relu()
        return _linear(last, hidden.float()).squeeze(-1)


def _linear(layer: tuple[Tensor, Tensor], inputs: Tensor) -> Tensor:
    """``(critics, B, in)`` to ``(critics, B, out)``."""
    weight, bias = layer
    return torch.baddbmm(bias.unsqueeze(1), inputs, weight.mT)
