"""SAC (Haarnoja et al. 2018, with a learned temperature): its settings, networks and loss."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

import torch
import torch.nn.functional as F
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.modules import TanhNormal
from torchrl.objectives import SACLoss

from nht.recipes.agents.critics import CriticPair, critic_network
from nht.recipes.agents.off_policy import OffPolicyConfig
from nht.recipes.agents.perceptrons import normaliser, perceptron
from nht.recipes.agents.table import Algorithm
from nht.recipes.sections import Training

LOG_STD = (-10.0, 2.0)
"""Smallest and largest logarithm of the standard deviation, before tanh."""


@dataclass
class SACConfig(OffPolicyConfig):
    """SAC's settings; the defaults are those that its authors publish for locomotion."""

    actor_learning_rate: float = 3e-4  # of Adam
    critic_learning_rate: float = 3e-4  # of Adam
    temperature_learning_rate: float = 3e-4  # of Adam; 0 keeps the temperature
    initial_temperature: float = 1.0  # weight of the entropy, which is learned from here
    target_entropy: float | None = None  # of the policy; None is minus the number of actions

    def __post_init__(self) -> None:
        """Raise ValueError for a value outside its range."""
        super().__post_init__()
        self._check_positive("actor_learning_rate", "critic_learning_rate", "initial_temperature")
        self._check_least(0, "temperature_learning_rate")


@dataclass
class SAC(Training):
    """``python -m nht.recipes.sac``."""

    algo: SACConfig = field(default_factory=SACConfig)


class GaussianHead(nn.Module):
    """From features to mean and deviation of a Gaussian, whose samples tanh turns into actions in [-1, 1]^k.

    Args:
        network: features ``(*batch, size)`` to ``(*batch, 2 k)``: means, and logarithms of deviations.
    """

    def __init__(self, network: nn.Module) -> None:
        super().__init__()
        self.network = network

    def forward(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and deviation, ``(*batch, k)`` each."""
        mean, log_std = self.network(features).chunk(2, -1)
        return mean, log_std.clamp(*LOG_STD).exp()


def networks(
    env: EnvBase, algo: SACConfig
) -> tuple[TensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule]:
    """Normaliser, actor and critic for ``env``.

    Returns:
        the normaliser, ``"observation"`` to ``"features"``; the actor, features to a random ``"action"`` in
        [-1, 1]^k, or to the tanh of the mean where exploration is off; and one critic, features and action to a
        ``"state_action_value"``.
    """
    size, action_dim = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    head = perceptron(algo, size, 2 * action_dim, env.device, normed=algo.layer_norm == "all")
    return (
        normaliser(env, algo),
        tanh_gaussian(GaussianHead(head)),
        critic_network(env, algo),
    )


def tanh_gaussian(head: GaussianHead) -> ProbabilisticTensorDictSequential:
    """The actor with this head: ``"features"`` to ``"loc"``, ``"scale"`` and an ``"action"``."""
    return ProbabilisticTensorDictSequential(
        TensorDictModule(head, in_keys=["features"], out_keys=["loc", "scale"]),
        ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"], out_keys=["action"], distribution_class=TanhNormal
        ),
    )


class DirectSACLoss(SACLoss):
    """``SACLoss`` that calls the networks as they are: the same numbers in less time.

    Parameters, targets and their updaters are TorchRL's. With a' and a_pi drawn from the policy pi, and Q'_i the target
    networks, the critics descend on

        sum_i mean (Q_i(s, a) - y)^2,   y = r + gamma (1 - terminated) (min_i Q'_i(s', a') - alpha log pi(a' | s')),

    the actor on mean (alpha log pi(a_pi | s) - min_i Q_i(s, a_pi)), and the logarithm of the temperature alpha on
    -log alpha mean (log pi(a_pi | s) + target entropy).

    Args:
        actor_network: as ``tanh_gaussian`` makes it.
        qvalue_network: one critic, an ``MLP`` from features and action to a ``"state_action_value"``.
        gamma: discount factor.
        target_entropy: the entropy that the temperature keeps the policy at.
        initial_temperature: alpha to start from.
        draw: returns standard normal noise in the shape of a tensor.
    """

    reports: ClassVar[tuple[str, ...]] = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy")

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential,
        qvalue_network: TensorDictModule,
        *,
        gamma: float,
        target_entropy: float,
        initial_temperature: float = 1.0,
        draw: Callable[[Tensor], Tensor] = torch.randn_like,
    ) -> None:
        super().__init__(
            actor_network,
            qvalue_network,
            loss_function="l2",
            alpha_init=initial_temperature,
            target_entropy=target_entropy,
        )
        self._discount, self._draw, self._entropy_goal = gamma, draw, target_entropy
        parts = dict(self.named_children())
        critic = qvalue_network.module
        # Not submodules: the loss has their parameters.
        self.__dict__["_head"] = actor_network[0].module
        self.__dict__["_critics"] = CriticPair(critic, parts["qvalue_network_params"])
        self.__dict__["_target_critics"] = CriticPair(critic, parts["target_qvalue_network_params"])

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        """The three losses of a batch ``(B,)``, the temperature ``"alpha"`` and the ``"entropy"``, all scalars.

        With the ``"target_value"`` ``(B,)`` of the critics.
        """
        loss_qvalue, more = self.qvalue_v2_loss(batch)
        loss_actor, drawn = self.actor_loss(batch)
        entropy = -drawn["log_prob"].mean()
        loss_alpha = self.log_alpha * (entropy - self._entropy_goal)
        values = (loss_actor, loss_qvalue, loss_alpha, self.log_alpha.detach().exp(), entropy)
        return TensorDict(dict(zip(self.reports, values, strict=True)) | more)

    def qvalue_v2_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The critics' loss, a scalar, and the ``"target_value"`` ``(B,)`` of a batch ``(B,)``."""
        target = self._target(tensordict)
        errors = self._critics(tensordict["features"], tensordict["action"]) - target
        return errors.square().mean(-1).sum(), {"target_value": target}

    @torch.no_grad()
    def _target(self, batch: TensorDictBase) -> Tensor:
        outcome = batch["next"]
        action, log_prob = self._sample(outcome["features"])
        later = self._target_critics(outcome["features"], action).amin(0) - self.log_alpha.exp() * log_prob
        discount = self._discount ** batch["steps_to_next_obs"]
        going_on = ~outcome["terminated"].squeeze(-1)
        return outcome["reward"].squeeze(-1) + discount * going_on * later

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss, a scalar, whose gradient leaves the critics alone; and the ``"log_prob"`` ``(B,)``."""
        features = tensordict["features"]
        action, log_prob = self._sample(features)
        value = self._critics.fixed(features, action).amin(0)
        return (self.log_alpha.detach().exp() * log_prob - value).mean(), {"log_prob": log_prob.detach()}

    def _sample(self, features: Tensor) -> tuple[Tensor, Tensor]:
        """Actions ``(B, k)`` with a gradient to the actor, and their log-probabilities ``(B,)``."""
        mean, std = self._head(features)
        deviates = self._draw(mean)
        before_tanh = mean + std * deviates
        gaussian = -0.5 * deviates.square() - std.log() - 0.5 * math.log(2.0 * math.pi)
        # log (1 - tanh(u)^2), exact for large u, too
        stretch = 2.0 * (math.log(2.0) - before_tanh - F.softplus(-2.0 * before_tanh))
        return before_tanh.tanh(), (gaussian - stretch).sum(-1)


def policy(env: EnvBase, algo: SACConfig) -> TensorDictModule:
    """The policy, untrained: observations to actions, without exploration."""
    features, actor, _ = networks(env, algo)
    return TensorDictSequential(features, actor)


ALGORITHM = Algorithm(main="nht.recipes.sac:main", schema=SAC, policy=policy)
