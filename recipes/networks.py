"""The networks of the recipes, as TensorDict modules."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import torch
from safetensors.torch import load_file, save_file
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import MLP, EGreedyModule, OrnsteinUhlenbeckProcessModule

from nht.recipes.config import AlgoConfig, DDPGConfig, PPOConfig
from nht.recipes.losses import return_range, reward_range

Reduction = Callable[[Tensor], Tensor]
"""Adds up a tensor over processes."""


def alone(values: Tensor) -> Tensor:
    """The sum over one process."""
    return values


class RunningNorm(nn.Module):
    """Normalises by the mean and deviation of everything it was shown, and clips.

    Unlike TorchRL's ``VecNorm`` it stands before the networks instead of in the environment, so that the replay
    buffer holds raw observations and old ones are normalised by today's statistics.

    Args:
        size: width of the observation.
        clip: largest absolute value put out.
        floor: smallest deviation divided by.
    """

    count: Tensor
    mean: Tensor
    squares: Tensor
    shift: Tensor
    scale: Tensor

    def __init__(self, size: int, clip: float = 5.0, floor: float = 0.01) -> None:
        super().__init__()
        self.clip, self.floor = clip, floor
        self.register_buffer("count", torch.zeros((), dtype=torch.float64))
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("squares", torch.zeros(size, dtype=torch.float64))  # summed squared deviations
        self.register_buffer("shift", torch.zeros(size))
        self.register_buffer("scale", torch.ones(size))

    @torch.no_grad()
    def update(self, observation: Tensor, add: Reduction = alone) -> None:
        """Take ``(*batch, size)`` observations into the statistics (Chan et al.'s pairwise update).

        Args:
            observation: of this process.
            add: adds up tensors of all processes that share the statistics, which then stay the same in all of them.
        """
        rows = observation.reshape(-1, observation.shape[-1]).double() - self.mean
        count, first, second = add(torch.stack([torch.ones_like(rows), rows, rows.square()]).sum(1))
        deviation = first / count
        total = self.count + count
        self.squares += second - count * deviation**2 + deviation**2 * self.count * count / total
        self.mean += deviation * count / total
        self.count.copy_(total[0])
        self.shift.copy_(self.mean)
        self.scale.copy_((self.squares / total).sqrt().clamp_min(self.floor))

    def forward(self, observation: Tensor) -> Tensor:
        """Normalised observations of the same shape."""
        return ((observation - self.shift) / self.scale).clamp(-self.clip, self.clip)


class ReturnNorm(nn.Module):
    """Divides rewards by the deviation of the discounted returns so far, and clips, as OpenAI's baselines do.

    Args:
        num_envs: number of copies of the environment.
        gamma: discount factor.
        clip: largest absolute reward put out.
    """

    returns: Tensor

    def __init__(self, num_envs: int, gamma: float, clip: float = 10.0) -> None:
        super().__init__()
        self.gamma, self.clip = gamma, clip
        self.statistics = RunningNorm(1, floor=1e-4)
        self.register_buffer(
            "returns", torch.zeros(num_envs)
        )  # of the rewards up to now, of each copy's episode

    @torch.no_grad()
    def forward(
        self, data: TensorDictBase, copies: slice = slice(None), add: Reduction = alone
    ) -> TensorDictBase:
        """Take rewards into the statistics, then normalise them in place.

        Args:
            data: steps ``(len(copies), steps)``.
            copies: those that made these steps, of the ``num_envs``.
            add: adds up tensors of all processes that share the statistics.
        """
        outcome = data["next"]
        reward, going_on = outcome["reward"].squeeze(-1), ~outcome["done"].squeeze(-1)
        returns, last = torch.empty_like(reward), self.returns[copies]
        for step in range(reward.shape[-1]):
            returns[:, step] = self.gamma * last + reward[:, step]
            torch.mul(returns[:, step], going_on[:, step], out=last)
        self.statistics.update(returns.unsqueeze(-1), add)
        outcome["reward"] = (outcome["reward"] / self.statistics.scale).clamp(-self.clip, self.clip)
        return data


class GaussianActor(nn.Module):
    """Features to a Gaussian action whose deviation does not depend on them.

    Samples are not bounded; the environment gets them clipped to [-1, 1].

    Args:
        network: features ``(*batch, size)`` to the mean ``(*batch, action_dim)``.
        action_dim: number of actions k.
        initial_std: deviation to start from.
    """

    def __init__(self, network: nn.Module, action_dim: int, initial_std: float) -> None:
        super().__init__()
        self.network = network
        self.log_std = nn.Parameter(torch.full((action_dim,), math.log(initial_std)))

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Sample ``(*batch, k)``, its log-probability ``(*batch,)``, and the action ``(*batch, k)``."""
        mean = self.network(features)
        deviates = torch.zeros_like(mean)
        if exploration_type() is not ExplorationType.DETERMINISTIC:
            deviates.normal_()
        sample = mean + deviates * self.log_std.exp()
        return sample, self._log_density(deviates), sample.clamp(-1.0, 1.0)

    def log_prob(self, features: Tensor, sample: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probability of samples, ``(*batch,)``, and the entropy, a scalar."""
        deviates = (sample - self.network(features)) * (-self.log_std).exp()
        entropy = self.log_std.sum() + 0.5 * len(self.log_std) * math.log(2 * math.pi * math.e)
        return self._log_density(deviates), entropy

    def _log_density(self, deviates: Tensor) -> Tensor:
        constant = 0.5 * len(self.log_std) * math.log(2 * math.pi)
        return -0.5 * deviates.square().sum(-1) - self.log_std.sum() - constant


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


def ppo_networks(
    env: EnvBase, algo: PPOConfig
) -> tuple[TensorDictModule, TensorDictModule, TensorDictModule]:
    """Normaliser, actor and critic for ``env``, separate networks with orthogonal weights as ppo2 starts them.

    Returns:
        the normaliser, ``"observation"`` to ``"features"``; the actor, features to a ``"sample"``, its
        ``"sample_log_prob"`` and an ``"action"`` in [-1, 1]^k; and the critic, features to a ``"state_value"``.
    """
    size, action_dim = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    norm = RunningNorm(size, algo.observation_clip).to(env.device)
    activation = {"tanh": nn.Tanh, "relu": nn.ReLU}[algo.activation]
    hidden = {"num_cells": list(algo.hidden), "activation_class": activation}
    mean = orthogonal(MLP(size, action_dim, **hidden), last_gain=0.01)
    actor = GaussianActor(mean, action_dim, algo.initial_std).to(env.device)
    critic = orthogonal(MLP(size, 1, **hidden), last_gain=1.0).to(env.device)
    return (
        TensorDictModule(norm, in_keys=["observation"], out_keys=["features"]),
        TensorDictModule(actor, in_keys=["features"], out_keys=["sample", "sample_log_prob", "action"]),
        TensorDictModule(critic, in_keys=["features"], out_keys=["state_value"]),
    )


def orthogonal(network: MLP, last_gain: float) -> MLP:
    """Orthogonal weights of gain sqrt(2), of another gain in the last layer, and biases of 0."""
    layers = [layer for layer in network if isinstance(layer, nn.Linear)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, last_gain if layer is layers[-1] else math.sqrt(2))
        nn.init.zeros_(layer.bias)
    return network


def ddpg_networks(
    env: EnvBase, algo: DDPGConfig
) -> tuple[TensorDictModule, TensorDictModule, TensorDictModule]:
    """Normaliser, actor and critic for ``env``.

    Returns:
        the normaliser, ``"observation"`` to ``"features"``; the actor, features to an ``"action"`` in [-1, 1]^k; and
        the critic, features and action to a ``"state_action_value"`` that starts near ``pessimism`` times
        the lowest return that is possible, or near 0 where rewards know no bound.
    """
    size, action_dim = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    norm = RunningNorm(size, algo.observation_clip).to(env.device)
    hidden = {"num_cells": list(algo.hidden), "activation_class": nn.ReLU, "device": env.device}
    network = HalfPrecisionMLP if algo.bfloat16 else MLP
    actor = nn.Sequential(network(size, action_dim, **hidden), nn.Tanh())
    critic = network(size + action_dim, 1, **hidden)
    lowest, _ = return_range(reward_range(env), algo.gamma)
    nn.init.constant_(critic[-1].bias, algo.pessimism * lowest if math.isfinite(lowest) else 0.0)
    return (
        TensorDictModule(norm, in_keys=["observation"], out_keys=["features"]),
        TensorDictModule(actor, in_keys=["features"], out_keys=["action"]),
        TensorDictModule(critic, in_keys=["features", "action"], out_keys=["state_action_value"]),
    )


class Exploration(Protocol):
    """Settings of the noise on a deterministic policy's actions."""

    exploration_noise: float
    noise_memory: float
    random_action: float


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


def save_policy(policy: nn.Module, folder: Path) -> None:
    """Write the deterministic policy, its normaliser included, to ``policy.safetensors``."""
    save_file(policy.state_dict(), folder / "policy.safetensors")


def load_policy(folder: Path, env: EnvBase, algo: AlgoConfig) -> TensorDictSequential:
    """The policy of a finished run, for an environment like the run's.

    Raises:
        FileNotFoundError: if the run has not finished.
        RuntimeError: if the policy does not fit the environment.
        TypeError: if the algorithm is none of ours.
    """
    from nht.recipes.agents.sac import SACConfig, sac_networks  # which import this module
    from nht.recipes.agents.td3 import TD3Config, td3_networks

    match algo:
        case TD3Config():
            features, actor, _ = td3_networks(env, algo)
        case SACConfig():
            features, actor, _ = sac_networks(env, algo)
        case DDPGConfig():
            features, actor, _ = ddpg_networks(env, algo)
        case PPOConfig():
            features, actor, _ = ppo_networks(env, algo)
        case _:
            raise TypeError(f"no networks for {type(algo).__name__}.")
    policy = TensorDictSequential(features, actor)
    policy.load_state_dict(load_file(folder / "policy.safetensors"))
    return policy
