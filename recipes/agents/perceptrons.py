"""The networks of algorithms with a replay buffer: what they see, their layers, precision and normalisation."""

from __future__ import annotations

from typing import Any

import torch
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import MLP

from nht.recipes.agents.norm import NoNorm, RunningNorm
from nht.recipes.agents.off_policy import OffPolicyConfig


class HalfPrecisionMLP(MLP):
    """An ``MLP`` whose hidden layers multiply in bfloat16. The last one adds up in float32: values need more digits."""

    def forward(self, *inputs: Tensor) -> Tensor:
        """``(*batch, size)``, or parts of it, to ``(*batch, out)``."""
        hidden = torch.cat(inputs, -1)
        *layers, last = self
        with torch.autocast(hidden.device.type, torch.bfloat16):
            for layer in layers:
                hidden = layer(hidden)
        return last(hidden.float())


def normaliser(env: EnvBase, algo: OffPolicyConfig) -> TensorDictModule:
    """What networks see of an observation: ``"observation"`` to ``"features"``, of the same width."""
    size = env.observation_spec["observation"].shape[-1]
    norm = RunningNorm(size, algo.observation_clip) if algo.observation_norm else NoNorm()
    return TensorDictModule(norm.to(env.device), in_keys=["observation"], out_keys=["features"])


def perceptron(
    algo: OffPolicyConfig, inputs: int, outputs: int, device: torch.device | None, *, normed: bool
) -> MLP:
    """A network with the hidden layers that the settings ask for.

    Args:
        algo: says how wide they are, and their precision.
        inputs: number of them.
        outputs: number of them.
        device: of its parameters.
        normed: whether each hidden layer is normalised before its ReLU (Ba et al. 2016).
    """
    settings: dict[str, Any] = {"num_cells": list(algo.hidden), "activation_class": nn.ReLU}
    if normed:
        norms = [{"normalized_shape": width} for width in algo.hidden]
        settings |= {"norm_class": nn.LayerNorm, "norm_kwargs": norms}
    network = HalfPrecisionMLP if algo.bfloat16 else MLP
    return network(inputs, outputs, device=device, **settings)
