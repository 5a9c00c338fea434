"""TD3 (Fujimoto, van Hoof & Meger 2018): its settings, networks and loss."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import TD3Loss

from nht.recipes.agents.cloning import ClonedDemosConfig, Cloning
from nht.recipes.agents.critics import CriticPair, critic_network
from nht.recipes.agents.off_policy import OffPolicyConfig
from nht.recipes.agents.perceptrons import normaliser, perceptron
from nht.recipes.agents.returns import UNBOUNDED, Range, return_range
from nht.recipes.agents.table import Algorithm
from nht.recipes.sections import Training


@dataclass
class TD3Config(OffPolicyConfig):
    """TD3's settings; the defaults are those that its authors publish for locomotion."""

    actor_learning_rate: float = 3e-4  # of Adam
    critic_learning_rate: float = 3e-4  # of Adam
    policy_noise: float = 0.2  # standard deviation of what smooths the target's action
    noise_clip: float = 0.5  # largest absolute value of it
    policy_delay: int = 2  # updates of the critics for each of the actor and the target networks
    exploration_noise: float = 0.1  # standard deviation; actions lie in [-1, 1]
    noise_memory: float = 1.0  # steps after which the noise has forgotten itself; 1 is white noise
    random_action: float = 0.0  # probability of a uniform action instead
    demos: ClonedDemosConfig = field(default_factory=ClonedDemosConfig)  # to learn from, too

    def __post_init__(self) -> None:
        """Raise ValueError for a value outside its range."""
        super().__post_init__()
        self._check_unit("random_action")
        self._check_positive("actor_learning_rate", "critic_learning_rate")
        self._check_least(0, "policy_noise", "noise_clip", "exploration_noise")
        self._check_least(1, "policy_delay", "noise_memory")


@dataclass
class TD3(Training):
    """``python -m nht.recipes.td3``."""

    algo: TD3Config = field(default_factory=TD3Config)


def networks(env: EnvBase, algo: TD3Config) -> tuple[TensorDictModule, TensorDictModule, TensorDictModule]:
    """Normaliser, actor and critic for ``env``.

    Returns:
        the normaliser, ``"observation"`` to ``"features"``; the actor, features to an ``"action"`` in [-1, 1]^k; and
        one critic, features and action to a ``"state_action_value"``.
    """
    size, action_dim = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    mean = perceptron(algo, size, action_dim, env.device, normed=algo.layer_norm == "all")
    return (
        normaliser(env, algo),
        TensorDictModule(nn.Sequential(mean, nn.Tanh()), in_keys=["features"], out_keys=["action"]),
        critic_network(env, algo),
    )


class DirectTD3Loss(TD3Loss):
    """``TD3Loss`` that calls the networks as they are: the same numbers in less time.

    Parameters, targets and their updaters are TorchRL's. With pi' and Q'_i the target networks, the critics descend on

        sum_i mean (Q_i(s, a) - y)^2,   y = r + gamma (1 - terminated) min_i Q'_i(s', clip(pi'(s') + e, -1, 1)),

    where e is Gaussian noise of deviation ``policy_noise``, clipped to ``noise_clip``; the actor on
    -mean Q_1(s, pi(s)). Where rewards have bounds, targets keep to the returns that these allow.

    Args:
        actor_network: ``"features"`` to an ``"action"`` in [-1, 1]^k.
        qvalue_network: one critic, an ``MLP`` from features and action to a ``"state_action_value"``.
        gamma: discount factor.
        policy_noise: deviation of the noise on the target's action.
        noise_clip: largest absolute value of that noise.
        reward_range: smallest and largest reward of a step, infinite where unknown.
        cloning: a further term of the actor's loss, of demonstrated steps; None is none.
        draw: returns standard normal noise in the shape of a tensor.
    """

    reports: ClassVar[tuple[str, ...]] = ("loss_actor", "loss_qvalue")

    def __init__(
        self,
        actor_network: TensorDictModule,
        qvalue_network: TensorDictModule,
        *,
        gamma: float,
        policy_noise: float = 0.2,
        noise_clip: float = 0.5,
        reward_range: Range = UNBOUNDED,
        cloning: Cloning | None = None,
        draw: Callable[[Tensor], Tensor] = torch.randn_like,
    ) -> None:
        super().__init__(
            actor_network,
            qvalue_network,
            bounds=(-1.0, 1.0),
            policy_noise=policy_noise,
            noise_clip=noise_clip,
            loss_function="l2",
        )
        self._discount, self._draw = gamma, draw
        self.__dict__["_cloning"] = cloning
        self._returns = return_range(reward_range, gamma)
        parts = dict(self.named_children())
        actor, critic = actor_network.module, qvalue_network.module
        target_actor = deepcopy(actor)
        parts["target_actor_network_params"]["module"].to_module(target_actor)
        # Not submodules: the loss has their parameters.
        self.__dict__["_actors"] = actor, target_actor
        self.__dict__["_critics"] = CriticPair(critic, parts["qvalue_network_params"])
        self.__dict__["_target_critics"] = CriticPair(critic, parts["target_qvalue_network_params"])

    def forward(self, batch: TensorDictBase, *, actor: bool = True) -> TensorDictBase:
        """``"loss_actor"``, 0 unless ``actor``; ``"loss_qvalue"`` and its ``"target_value"``, of a batch ``(B,)``."""
        loss_actor = self.actor_loss(batch)[0] if actor else batch["action"].new_zeros(())
        loss_qvalue, more = self.value_loss(batch)
        return TensorDict({"loss_actor": loss_actor, "loss_qvalue": loss_qvalue} | more)

    def value_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The critics' loss, a scalar, and the ``"target_value"`` ``(B,)`` of a batch ``(B,)``."""
        target = self._target(tensordict)
        errors = self._critics(tensordict["features"], tensordict["action"]) - target
        return errors.square().mean(-1).sum(), {"target_value": target}

    @torch.no_grad()
    def _target(self, batch: TensorDictBase) -> Tensor:
        outcome = batch["next"]
        noise = self._draw(batch["action"]) * self.policy_noise
        action = self._actors[1](outcome["features"]) + noise.clamp_(-self.noise_clip, self.noise_clip)
        later = self._target_critics(outcome["features"], action.clamp_(-1.0, 1.0)).amin(0)
        discount = self._discount ** batch["steps_to_next_obs"]
        going_on = ~outcome["terminated"].squeeze(-1)
        return (outcome["reward"].squeeze(-1) + discount * going_on * later).clamp_(*self._returns)

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss, a scalar; its gradient leaves the critics alone."""
        features = tensordict["features"]
        action = self._actors[0](features)
        value = self._critics.fixed(features, action, critics=1)
        loss = -value.mean()
        if self._cloning is not None:
            loss = loss + self._cloning.loss(
                tensordict, action, value[0], lambda shown: self._critics.fixed(features, shown, critics=1)[0]
            )
        return loss, {"state_action_value_actor": value.detach()}


def policy(env: EnvBase, algo: TD3Config) -> TensorDictModule:
    """The policy, untrained: observations to actions, without exploration."""
    features, actor, _ = networks(env, algo)
    return TensorDictSequential(features, actor)


ALGORITHM = Algorithm(main="nht.recipes.td3:main", schema=TD3, policy=policy)
