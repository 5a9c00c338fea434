"""What DDPG, TD3 and SAC share: what a buffer keeps of a step, exploration noise, networks in half precision."""

from __future__ import annotations

import math
from typing import Protocol

import torch
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import MLP, EGreedyModule, OrnsteinUhlenbeckProcessModule
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

STORED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
    "steps_to_next_obs",
)
"""What a replay buffer keeps of a step."""


class JointSoftUpdate(SoftUpdate):
    """``SoftUpdate`` that moves all parameters at once, in a tenth of its time.

    Args:
        loss: with target networks.
        eps: share of the target networks' parameters that stays; the rest comes from the networks.
    """

    def __init__(self, loss: LossModule, *, eps: float) -> None:
        super().__init__(loss, eps=eps)
        names = list(self._sources.keys())
        self._learned = [leaf.data for name in names for leaf in self._sources[name].values(True, True)]
        self._followers = [
            leaf.data for name in names for leaf in self._targets[f"target_{name}"].values(True, True)
        ]

    def step(self) -> None:
        """Move the target networks."""
        torch._foreach_lerp_(self._followers, self._learned, 1.0 - self.eps)


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


class Exploration(Protocol):
    """Settings of the noise that an algorithm explores with."""

    exploration_noise: float
    """Standard deviation; actions lie in [-1, 1]."""
    noise_memory: float
    """Steps after which the noise has forgotten itself; 1 is white noise."""
    random_action: float
    """Probability of a uniform action instead."""


def exploring(policy: TensorDictModule, env: EnvBase, algo: Exploration) -> TensorDictSequential:
    """The policy with noise added to its actions, or, at times, a uniform action instead.

    The noise is an Ornstein-Uhlenbeck process of deviation ``exploration_noise`` whose autocorrelation falls by
    ``1 / noise_memory`` a step; with a memory of 1 it is white.
    """
    rate = 1.0 / algo.noise_memory
    sigma = algo.exploration_noise * math.sqrt(rate * (2.0 - rate))
    noise = OrnsteinUhlenbeckProcessModule(
        env.action_spec, eps_init=1.0, eps_end=1.0, theta=rate, sigma=sigma, dt=1.0, device=env.device
    )
    uniform = EGreedyModule(env.action_spec, algo.random_action, algo.random_action, device=env.device)
    return TensorDictSequential(policy, noise, uniform)
