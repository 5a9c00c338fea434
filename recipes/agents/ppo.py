"""PPO: its settings, its networks, its loss."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import MLP
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from nht.recipes.agents.norm import RunningNorm
from nht.recipes.agents.settings import Setting, beside, largest
from nht.recipes.agents.table import Algorithm
from nht.recipes.sections import AlgoConfig, AlgoDemosConfig, Training


@dataclass
class StartDemosConfig(AlgoDemosConfig):
    """Demonstrations that an algorithm without a replay buffer can only start from."""

    def __post_init__(self) -> None:
        """Raise ValueError where nothing would be made of them."""
        super().__post_init__()
        if self.transitions and not self.cloning_start:
            raise ValueError(
                f"ppo replays no demonstrations, its actor may start from them: with algo.demos.transitions="
                f"{self.transitions}, set algo.demos.cloning_start, too."
            )


@dataclass
class PPOConfig(AlgoConfig):
    """PPO's settings; those of OpenAI's ppo2, which the paper ran, are ``algo=ppo_paper``."""

    varies: ClassVar[tuple[str, ...]] = (
        "initial_std",
        "learning_rate",
        "gamma",
        "lmbda",
        "clip",
        "critic_coeff",
        "entropy_coeff",
        "max_grad_norm",
    )

    total_frames: int = 1_003_520
    frames_per_batch: int = 2_048  # steps per update, of all copies together
    num_envs: int = 16  # copies of the task that the settings were found with
    epochs: int = 10  # times that a batch is gone through
    minibatches: int = 16  # gradient steps in an epoch
    hidden: list[int] = field(default_factory=lambda: [256, 256])  # of the actor, and of the critic
    activation: str = "relu"  # or tanh
    initial_std: float = 0.135  # of the actions, of which the task sees those in [-1, 1]
    learning_rate: float = 3e-4  # of Adam
    decay_learning_rate: bool = True  # linearly, to 0 at total_frames
    gamma: float = 0.98  # discount of a step
    lmbda: float = 0.92  # GAE's lambda
    clip: float = 0.1  # of the ratio of probabilities
    clip_value: bool = False  # holds the critic within clip of its old values, too
    critic_coeff: float = 0.58  # weight of the critic's mean squared error
    entropy_coeff: float = 4e-4  # weight of the entropy, which keeps actions various
    max_grad_norm: float = 0.8  # a longer gradient is shortened to this
    observation_clip: float = 10.0  # of the normalised observation
    reward_clip: float = 10.0  # of the reward over the deviation of discounted returns
    demos: StartDemosConfig = field(default_factory=StartDemosConfig)  # to imitate before learning

    def __post_init__(self) -> None:
        """Raise ValueError for a value outside its range."""
        for name in ("gamma", "lmbda"):
            if not 0 < getattr(self, name) <= 1:
                raise ValueError(f"algo.{name} must lie in (0, 1], got {getattr(self, name)}.")
        for name in ("total_frames", "frames_per_batch", "epochs", "minibatches"):
            if getattr(self, name) < 1:
                raise ValueError(f"algo.{name} must be at least 1, got {getattr(self, name)}.")
        for name in ("learning_rate", "clip", "initial_std", "max_grad_norm", "reward_clip"):
            if not getattr(self, name) > 0:
                raise ValueError(f"algo.{name} must be positive, got {getattr(self, name)}.")
        for name in ("critic_coeff", "entropy_coeff"):
            if getattr(self, name) < 0:
                raise ValueError(f"algo.{name} must not be negative, got {getattr(self, name)}.")
        if self.activation not in ("tanh", "relu"):
            raise ValueError(f"algo.activation must be tanh or relu, got {self.activation!r}.")
        if self.frames_per_batch % self.minibatches:
            raise ValueError(
                f"algo.frames_per_batch={self.frames_per_batch} must be a multiple of "
                f"algo.minibatches={self.minibatches}: all minibatches are of one size."
            )
        if self.frames_per_batch == self.minibatches:
            raise ValueError(
                f"algo.minibatches={self.minibatches} must be less than algo.frames_per_batch: "
                "advantages are normalised within a minibatch, which takes two steps at least."
            )


@dataclass
class PPO(Training):
    """``python -m nht.recipes.ppo``."""

    algo: PPOConfig = field(default_factory=PPOConfig)


def networks(env: EnvBase, algo: PPOConfig) -> tuple[TensorDictModule, TensorDictModule, TensorDictModule]:
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
        sample = mean + deviates * self._log_std_beside(mean).exp()
        return sample, self._log_density(deviates), sample.clamp(-1.0, 1.0)

    def log_prob(self, features: Tensor, sample: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probability of samples, ``(*batch,)``, and the entropy, a scalar; of several learners ``(L,)``."""
        deviates = (sample - self.network(features)) * (-self._log_std_beside(sample)).exp()
        entropy = self.log_std.sum(-1) + 0.5 * self.log_std.shape[-1] * math.log(2 * math.pi * math.e)
        return self._log_density(deviates), entropy

    def _log_density(self, deviates: Tensor) -> Tensor:
        constant = 0.5 * self.log_std.shape[-1] * math.log(2 * math.pi)
        return -0.5 * deviates.square().sum(-1) - self._log_std_beside(deviates).sum(-1) - constant

    def _log_std_beside(self, values: Tensor) -> Tensor:
        """``(k,)``; of several learners ``(L, k)``, in the shape that goes with ``(L, *batch, k)``."""
        *learners, size = self.log_std.shape
        return (
            self.log_std.view(*learners, *[1] * (values.ndim - self.log_std.ndim), size)
            if learners
            else self.log_std
        )


class GaussianPPOLoss(ClipPPOLoss):
    """``ClipPPOLoss`` of a Gaussian actor: the same numbers in less time.

    With networks as small as PPO's, TorchRL's loss spends most of its time on looking up keys, swapping parameters
    and building distributions. This one calls the networks and writes the formulas out. Advantages are normalised
    within the minibatch. Of several learners, whose networks are ``stacked``, minibatches are ``(L, B)`` and losses
    ``(L,)``.

    Args:
        actor: its module is a ``GaussianActor``.
        critic: ``"features"`` to a ``"state_value"``.
        clip: how far the ratio of probabilities may move from 1.
        clip_value: whether the critic is held within ``clip`` of its old values, too.
        critic_coeff: weight of the critic's mean squared error.
        entropy_coeff: weight of the entropy.
        add: adds up tensors of all processes that share a minibatch; alone, there is nothing to add.
    """

    reports: ClassVar[tuple[str, ...]] = (
        "loss_objective",
        "loss_critic",
        "entropy",
        "clip_fraction",
        "kl_approx",
    )

    def __init__(
        self,
        actor: TensorDictModule,
        critic: TensorDictModule,
        *,
        clip: Setting,
        clip_value: bool,
        critic_coeff: Setting,
        entropy_coeff: Setting,
        add: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__(
            actor,
            critic,
            clip_epsilon=largest(clip),  # TorchRL has one for all; what counts is kept below
            clip_value=clip_value,
            critic_coeff=largest(critic_coeff),
            entropy_coeff=largest(entropy_coeff),
            normalize_advantage=True,
            loss_critic_type="l2",
            functional=False,
        )
        self._clip, self._clips_value = clip, clip_value
        self._critic_weight, self._entropy_weight = critic_coeff, entropy_coeff
        self._add = add

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        """The ``"loss"`` to descend on, a scalar, the ``reports``, and the critic's target, for a batch ``(B,)``."""
        features = batch["features"]
        log_prob, entropy = self.actor_network.module.log_prob(features, batch["sample"])
        log_ratio = log_prob - batch["sample_log_prob"]
        ratio = log_ratio.exp()
        clip: Any = beside(self._clip, ratio)
        clipped = torch.clamp(ratio, 1.0 - clip, 1.0 + clip)
        advantage = self._normalised(batch["advantage"].squeeze(-1))
        objective = -torch.minimum(ratio * advantage, clipped * advantage).mean(-1)
        critic = self._critic_weight * self._squared_error(self.critic_network.module(features), batch)
        loss = objective + critic - self._entropy_weight * entropy
        with torch.no_grad():
            clipped_share = (clipped != ratio).float().mean(-1)
            reports = (objective, critic, entropy, clipped_share, -log_ratio.mean(-1))
        target = {"target_value": batch["value_target"].squeeze(-1)}
        return TensorDict({"loss": loss} | dict(zip(self.reports, reports, strict=True)) | target)

    def _normalised(self, advantage: Tensor) -> Tensor:
        """Advantages ``(B,)`` with mean 0 and deviation 1 over the minibatch, other processes' parts of it included."""
        if self._add is None:
            mean, deviation = advantage.mean(-1, keepdim=True), advantage.std(-1, keepdim=True)
            return (advantage - mean) / deviation.clamp_min(1e-6)
        count, total = self._add(torch.stack([torch.ones_like(advantage), advantage]).sum(1))
        advantage = advantage - total / count
        variance = self._add(advantage.square().sum()) / (count - 1)
        return advantage / variance.sqrt().clamp_min(1e-6)

    def _squared_error(self, value: Tensor, batch: TensorDictBase) -> Tensor:
        target = batch["value_target"]
        error = (value - target).square()
        if self._clips_value:
            old = batch["state_value"]
            clip: Any = beside(self._clip, target)
            held = old + torch.clamp(value - old, -clip, clip)
            error = torch.maximum(error, (held - target).square())
        return error.squeeze(-1).mean(-1)


def advantage_estimator(gamma: Setting, lmbda: Setting) -> Callable[[TensorDictBase], TensorDictBase]:
    """TorchRL's ``GAE``, which writes into steps ``(*batch, T)``; with numbers of its own for each learner, if told."""
    if not isinstance(gamma, Tensor) and not isinstance(lmbda, Tensor):
        return GAE(gamma=gamma, lmbda=lmbda, value_network=None)
    numbers = zip(*torch.broadcast_tensors(torch.as_tensor(gamma), torch.as_tensor(lmbda)), strict=True)
    own = [GAE(gamma=float(one), lmbda=float(other), value_network=None) for one, other in numbers]
    return lambda data: torch.stack([gae(part) for gae, part in zip(own, data, strict=True)])


@torch.no_grad()
def estimate_advantages(
    data: TensorDictBase,
    features: TensorDictModule,
    critic: TensorDictModule,
    gae: Callable[[TensorDictBase], TensorDictBase],
) -> None:
    """Write ``"state_value"``, ``"advantage"`` and ``"value_target"`` into steps ``(*learners, copies, T)``.

    What follows a step is valued by the observation that it led to: where an episode ran into its time limit, that is
    its own last one, not the first of the next episode. Only ``terminated`` makes it worth nothing.
    """
    features(data["next"])
    critic(data), critic(data["next"])
    data.update(gae(data).select("advantage", "value_target"))


def policy(env: EnvBase, algo: PPOConfig) -> TensorDictModule:
    """The policy, untrained: observations to actions, without exploration."""
    features, actor, _ = networks(env, algo)
    return TensorDictSequential(features, actor)


ALGORITHM = Algorithm(main="nht.recipes.ppo:main", schema=PPO, policy=policy)
