"""What the recipes add to TorchRL's losses."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import deepcopy
from typing import ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.data.postprocs import MultiStep
from torchrl.envs import EnvBase
from torchrl.objectives import ClipPPOLoss, DDPGLoss, LossModule, SoftUpdate
from torchrl.objectives.value import GAE

Range = tuple[float, float]


class PaperDDPGLoss(DDPGLoss):
    """``DDPGLoss`` with both target networks, targets clipped if asked for, and an actor that pays for large actions.

    Parameters, targets and their updaters are TorchRL's. The networks are called as they are, where TorchRL puts
    parameters into one module before every call: that costs a third of an update of networks as small as ours.

    Args:
        actor_network: ``"features"`` to an ``"action"`` in [-1, 1]^k.
        value_network: features and action to a ``"state_action_value"``.
        gamma: discount factor.
        action_l2: weight of the mean squared action in the actor's loss.
        reward_range: smallest and largest reward of a step, infinite where unknown.
    """

    def __init__(
        self,
        actor_network: TensorDictModule,
        value_network: TensorDictModule,
        *,
        gamma: float,
        action_l2: float,
        reward_range: Range = (-1.0, 0.0),
    ) -> None:
        super().__init__(actor_network, value_network, delay_actor=True, delay_value=True)
        self.gamma, self.action_l2 = gamma, action_l2
        self.returns = return_range(reward_range, gamma)
        actor, critic = actor_network.module, value_network.module
        target_actor, target_critic = deepcopy(actor), deepcopy(critic)
        self.target_actor_network_params["module"].to_module(target_actor)
        self.target_value_network_params["module"].to_module(target_critic)
        # Not submodules: whose parameters they share are.
        self.__dict__["_networks"] = actor, critic, target_actor, target_critic

    def loss_value(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The critic's loss, a scalar, and the ``"target_value"`` ``(B,)`` of a batch ``(B,)``."""
        _, critic, target_actor, target_critic = self._networks
        outcome = tensordict["next"]
        with torch.no_grad():
            later = target_critic(outcome["features"], target_actor(outcome["features"]))
            discount = self.gamma ** tensordict["steps_to_next_obs"].unsqueeze(-1)
            target = outcome["reward"] + discount * ~outcome["terminated"] * later
            target.clamp_(*self.returns)
        error = critic(tensordict["features"], tensordict["action"]) - target
        return error.square().mean(), {"target_value": target.squeeze(-1)}

    def loss_actor(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The actor's loss, a scalar; its gradient leaves the critic alone."""
        actor, critic, _, _ = self._networks
        action = actor(tensordict["features"])
        critic.requires_grad_(False)
        value = critic(tensordict["features"], action)
        critic.requires_grad_(True)
        return self.action_l2 * action.square().mean() - value.mean(), {}


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


def reward_range(env: EnvBase) -> Range:
    """Smallest and largest reward of a step, as the environment's spec has it; infinite where it knows none."""
    space = env.reward_spec.space
    # TorchRL writes "unbounded" as the largest numbers of the type.
    low, high = float(space.low.min()), float(space.high.max())
    largest = torch.finfo(env.reward_spec.dtype).max
    return (low if low > -largest else -math.inf), (high if high < largest else math.inf)


def return_range(reward_range: Range, gamma: float, steps: float = math.inf) -> Range:
    """The lowest and the highest discounted return that such rewards can add up to, over no step to ``steps``."""
    low, high = reward_range
    most = steps if gamma == 1.0 else (1.0 - gamma**steps) / (1.0 - gamma)
    return min(low, 0.0) * most, max(high, 0.0) * most


def charge_failure(
    tensordict: TensorDictBase, gamma: float, reward_range: Range = (-1.0, 0.0), steps: float = math.inf
) -> TensorDictBase:
    """Let an episode that failure ended be worth the lowest return, where there is one: failing early never pays."""
    lowest, _ = return_range(reward_range, gamma, steps)
    if math.isfinite(lowest):
        outcome = tensordict["next"]
        fatal = outcome["failure"] & outcome["terminated"]
        outcome["reward"] = torch.where(fatal, lowest, outcome["reward"])
    return tensordict


def n_step_returns(gamma: float, steps: int) -> MultiStep:
    """TorchRL's ``MultiStep``, which turns collected steps ``(copies, T)`` into ones of up to ``steps`` rewards.

    Left as it is, it moves observations ahead but not the flags of their ends, and a target that meets a failure would
    go on to the critic's value of what it led to.
    """
    multi_step = MultiStep(gamma, steps)
    multi_step.done_keys = ()
    return multi_step


class GaussianPPOLoss(ClipPPOLoss):
    """``ClipPPOLoss`` of a Gaussian actor: the same numbers in less time.

    With networks as small as PPO's, TorchRL's loss spends most of its time on looking up keys, swapping parameters
    and building distributions. This one calls the networks and writes the formulas out. Advantages are normalised
    within the minibatch.

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
        clip: float,
        clip_value: bool,
        critic_coeff: float,
        entropy_coeff: float,
        add: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__(
            actor,
            critic,
            clip_epsilon=clip,
            clip_value=clip_value,
            critic_coeff=critic_coeff,
            entropy_coeff=entropy_coeff,
            normalize_advantage=True,
            loss_critic_type="l2",
            functional=False,
        )
        self._clip, self._clips_value = clip, clip_value
        self._critic_weight, self._entropy_weight = critic_coeff, entropy_coeff
        self._add = add

    def forward(self, batch: TensorDictBase) -> TensorDictBase:
        """The ``"loss"`` to descend on, a scalar, and the ``reports``, for a minibatch ``(B,)``."""
        features = batch["features"]
        log_prob, entropy = self.actor_network.module.log_prob(features, batch["sample"])
        log_ratio = log_prob - batch["sample_log_prob"]
        ratio = log_ratio.exp()
        clipped = ratio.clamp(1.0 - self._clip, 1.0 + self._clip)
        advantage = self._normalised(batch["advantage"].squeeze(-1))
        objective = -torch.minimum(ratio * advantage, clipped * advantage).mean()
        critic = self._critic_weight * self._squared_error(self.critic_network.module(features), batch)
        loss = objective + critic - self._entropy_weight * entropy
        with torch.no_grad():
            reports = (objective, critic, entropy, (clipped != ratio).float().mean(), -log_ratio.mean())
        return TensorDict({"loss": loss} | dict(zip(self.reports, reports, strict=True)))

    def _normalised(self, advantage: Tensor) -> Tensor:
        """Advantages ``(B,)`` with mean 0 and deviation 1 over the minibatch, other processes' parts of it included."""
        if self._add is None:
            return (advantage - advantage.mean()) / advantage.std().clamp_min(1e-6)
        count, total = self._add(torch.stack([torch.ones_like(advantage), advantage]).sum(1))
        advantage = advantage - total / count
        variance = self._add(advantage.square().sum()) / (count - 1)
        return advantage / variance.sqrt().clamp_min(1e-6)

    def _squared_error(self, value: Tensor, batch: TensorDictBase) -> Tensor:
        target = batch["value_target"]
        error = (value - target).square()
        if self._clips_value:
            old = batch["state_value"]
            held = old + (value - old).clamp(-self._clip, self._clip)
            error = torch.maximum(error, (held - target).square())
        return error.mean()


@torch.no_grad()
def estimate_advantages(
    data: TensorDictBase, features: TensorDictModule, critic: TensorDictModule, gae: GAE
) -> None:
    """Write ``"state_value"``, ``"advantage"`` and ``"value_target"`` into collected steps ``(copies, steps)``.

    What follows a step is valued by the observation that it led to: where an episode ran into its time limit, that is
    its own last one, not the first of the next episode. Only ``terminated`` makes it worth nothing.
    """
    features(data["next"])
    critic(data), critic(data["next"])
    gae(data)
