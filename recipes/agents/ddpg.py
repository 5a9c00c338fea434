"""DDPG: its settings, its networks, its loss."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase
from torchrl.objectives import DDPGLoss

from nht.recipes.agents.cloning import ClonedDemosConfig, Cloning
from nht.recipes.agents.critics import critic_network, quantile_loss
from nht.recipes.agents.off_policy import OffPolicyConfig, mean_over
from nht.recipes.agents.perceptrons import normaliser, perceptron
from nht.recipes.agents.returns import UNBOUNDED, Range, return_range
from nht.recipes.agents.settings import Setting, beside
from nht.recipes.agents.table import Algorithm
from nht.recipes.run.metrics import VALUE
from nht.recipes.sections import Training


@dataclass
class DDPGConfig(OffPolicyConfig):
    """DDPG's settings; those of the paper are ``algo=ddpg_paper``."""

    varies: ClassVar[tuple[str, ...]] = (
        *OffPolicyConfig.varies,
        "actor_learning_rate",
        "critic_learning_rate",
        "action_l2",
        "exploration_noise",
        "noise_memory",
        "random_action",
    )

    frames_per_batch: int = 200
    updates_per_batch: int = 20
    warmup_frames: int = 2_000
    random_frames: int = 0
    gamma: float = 0.98
    polyak: float = 0.96
    actor_learning_rate: float = 1e-3  # of Adam
    critic_learning_rate: float = 1e-3  # of Adam
    target_update_every: int = 1  # gradient steps between two moves of the target networks
    action_l2: float = 0.05  # weight of the mean squared action in the actor's loss
    exploration_noise: float = 0.3  # standard deviation; actions lie in [-1, 1]
    noise_memory: float = 10.0  # steps after which the noise has forgotten itself; 1 is white noise
    random_action: float = 0.1  # probability of a uniform action instead
    quantiles: int = 1  # of the return that the critic predicts; 1 is its mean
    dropped_quantiles: int = 0  # the largest ones, which targets leave out
    demos: ClonedDemosConfig = field(default_factory=ClonedDemosConfig)  # to learn from, too

    def __post_init__(self) -> None:
        """Raise ValueError for a value outside its range."""
        super().__post_init__()
        self._check_unit("random_action")
        self._check_least(1, "target_update_every", "noise_memory", "quantiles")
        self._check_least(0, "action_l2", "exploration_noise", "dropped_quantiles")
        if self.dropped_quantiles >= self.quantiles:
            raise ValueError(
                f"algo.dropped_quantiles must be less than algo.quantiles={self.quantiles}, got "
                f"{self.dropped_quantiles}."
            )


@dataclass
class DDPG(Training):
    """``python -m nht.recipes.ddpg``."""

    algo: DDPGConfig = field(default_factory=DDPGConfig)


def networks(env: EnvBase, algo: DDPGConfig) -> tuple[TensorDictModule, TensorDictModule, TensorDictModule]:
    """Normaliser, actor and critic for ``env``.

    Returns:
        the normaliser, ``"observation"`` to ``"features"``; the actor, features to an ``"action"`` in [-1, 1]^k; and
        the critic, features and action to a ``"state_action_value"`` that starts near ``pessimism`` times
        the lowest return that is possible, or near 0 where rewards know no bound.
    """
    size, action_dim = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]
    layers = perceptron(algo, size, action_dim, env.device, normed=algo.layer_norm == "all")
    actor = nn.Sequential(layers, nn.Tanh())
    return (
        normaliser(env, algo),
        TensorDictModule(actor, in_keys=["features"], out_keys=["action"]),
        critic_network(env, algo, algo.quantiles),
    )


class PaperDDPGLoss(DDPGLoss):
    """``DDPGLoss`` with both target networks, targets clipped if asked for, and an actor penalty on large actions.

    Parameters, targets and their updaters are TorchRL's. The networks are called as they are, where TorchRL puts
    parameters into one module before every call: that costs a third of an update of networks as small as ours.

    Of several learners, whose networks are ``stacked``, minibatches are ``(L, B)`` and losses ``(L,)``: what follows
    says ``(B,)`` and a scalar for both.

    Args:
        actor_network: ``"features"`` to an ``"action"`` in [-1, 1]^k.
        value_network: features and action to a ``"state_action_value"``.
        gamma: discount factor.
        action_l2: weight of the mean squared action in the actor's loss.
        reward_range: smallest and largest reward of a step, infinite where unknown; targets are clipped to the
            returns that these allow.
        cloning: a further term of the actor's loss, of demonstrated steps; None is none.
        dropped: how many of the critic's largest quantiles targets leave out. A critic of several quantiles learns by
            their Huber loss, ``quantile_loss``; its value is their mean.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule,
        *,
        gamma: Setting,
        action_l2: Setting,
        reward_range: Range = UNBOUNDED,
        cloning: Cloning | None = None,
        dropped: int = 0,
    ) -> None:
        super().__init__(actor_network, value_network, delay_actor=True, delay_value=True)
        self.gamma, self.action_l2, self._dropped = gamma, action_l2, dropped
        self.__dict__["_cloning"] = cloning
        self.returns = return_range(reward_range, gamma)
        actor, critic = actor_network.module, value_network.module
        target_actor, target_critic = deepcopy(actor), deepcopy(critic)
        parts = dict(self.named_children())  # as attributes, they warn that nothing moves them yet
        parts["target_actor_network_params"]["module"].to_module(target_actor)
        parts["target_value_network_params"]["module"].to_module(target_critic)
        # Not submodules: whose parameters they share are.
        self.__dict__["_networks"] = actor, critic, target_actor, target_critic

    def loss_value(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The critic's loss, a scalar; the ``"target_value"`` ``(B,)`` of a batch ``(B,)``, and the mean of that."""
        _, critic, target_actor, target_critic = self._networks
        outcome = tensordict["next"]
        with torch.no_grad():
            later = target_critic(outcome["features"], target_actor(outcome["features"]))
            if self._dropped:
                later = later.sort(-1).values[..., : -self._dropped]
            discount = beside(self.gamma, later) ** tensordict["steps_to_next_obs"].unsqueeze(-1)
            target = outcome["reward"] + discount * ~outcome["terminated"] * later
            target.clamp_(*(beside(bound, target) for bound in self.returns))
        found = critic(tensordict["features"], tensordict["action"])
        errors = (found - target).square() if found.shape[-1] == 1 else quantile_loss(found, target)
        told = {"target_value": target.mean(-1), VALUE: mean_over(tensordict, target)}
        return mean_over(tensordict, errors), told

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss, a scalar; its gradient leaves the critic alone."""
        actor, critic, _, _ = self._networks
        features = tensordict["features"]
        action = actor(features)
        critic.requires_grad_(False)
        value = critic(features, action).mean(-1, keepdim=True)
        critic.requires_grad_(True)
        loss = self.action_l2 * mean_over(tensordict, action.square()) - mean_over(tensordict, value)
        if self._cloning is not None:
            loss = loss + self._cloning.loss(
                tensordict, action, value.squeeze(-1), lambda shown: critic(features, shown).mean(-1)
            )
        return loss, {}


def policy(env: EnvBase, algo: DDPGConfig) -> TensorDictModule:
    """The policy, untrained: observations to actions, without exploration."""
    features, actor, _ = networks(env, algo)
    return TensorDictSequential(features, actor)


ALGORITHM = Algorithm(main="nht.recipes.ddpg:main", schema=DDPG, policy=policy)
