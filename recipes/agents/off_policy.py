"""Parts that algorithms with a replay buffer share: settings, exploration, a gradient step, target networks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.modules import EGreedyModule, OrnsteinUhlenbeckProcessModule
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

from nht.recipes.agents.settings import Setting, beside, largest
from nht.recipes.run.ranks import Ranks
from nht.recipes.sections import AlgoConfig, ReplayDemosConfig
from nht.recipes.torch_internals import lerp_all
from nht.recipes.torchrl_internals import followed_pairs


@dataclass
class OffPolicyConfig(AlgoConfig):
    """Settings of algorithms with a replay buffer; the defaults are published practice for locomotion."""

    varies: ClassVar[tuple[str, ...]] = ("batch_size", "gamma", "polyak", "pessimism")

    frames_per_batch: int = 100
    updates_per_batch: int = 100  # gradient steps after each batch of environment steps
    warmup_frames: int = 10_000  # collected before the first update
    random_frames: int = 10_000  # the first ones, whose actions are uniform
    batch_size: int = 256  # steps in a gradient step
    buffer_size: int = 1_000_000  # steps that are kept, the latest
    hidden: list[int] = field(default_factory=lambda: [256, 256])  # of the actor, and of each critic
    gamma: float = 0.99  # discount of a step
    n_steps: int = 1  # rewards that a target adds up before it trusts the critics, within a collected batch
    polyak: float = 0.995  # share of the old target network that stays at each move
    pessimism: float = 0.8  # the critics start at this times the lowest return that is possible
    observation_norm: bool = True  # networks see observations in units of their running deviation
    observation_clip: float = 5.0  # of the normalised observation
    layer_norm: str = "none"  # of hidden layers, before each ReLU: none, critic or all
    bfloat16: bool = False  # the precision of hidden layers' matrix products; weights stay float32
    demos: ReplayDemosConfig = field(default_factory=ReplayDemosConfig)  # demonstrations to learn from, too

    def __post_init__(self) -> None:
        """Raise ValueError for a value outside its range."""
        if not 0 < self.gamma < 1:
            raise ValueError(f"algo.gamma must lie in (0, 1), got {self.gamma}.")
        self._check_unit("polyak", "pessimism")
        self._check_positive("observation_clip")
        counts = ("total_frames", "frames_per_batch", "n_steps", "batch_size", "buffer_size")
        self._check_least(1, *counts)
        self._check_least(0, "updates_per_batch", "warmup_frames", "random_frames")
        if self.layer_norm not in ("none", "critic", "all"):
            raise ValueError(f"algo.layer_norm must be none, critic or all, got {self.layer_norm!r}.")
        self._check_demos()

    def _check_demos(self) -> None:
        transitions, share = self.demos.transitions, self.demos.share
        if share and not 0 < round(share * self.batch_size) < self.batch_size:
            raise ValueError(
                f"algo.demos.share={share} of algo.batch_size={self.batch_size} leaves demonstrations or collected "
                "steps without a place."
            )
        if not share and transitions > self.buffer_size:
            raise ValueError(
                f"algo.demos.transitions={transitions} must be at most algo.buffer_size={self.buffer_size}, which they "
                "go into unless algo.demos.share is set."
            )

    def _check_unit(self, *names: str) -> None:
        for name in names:
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"algo.{name} must lie in [0, 1], got {getattr(self, name)}.")

    def _check_positive(self, *names: str) -> None:
        for name in names:
            if not getattr(self, name) > 0:
                raise ValueError(f"algo.{name} must be positive, got {getattr(self, name)}.")

    def _check_least(self, least: float, *names: str) -> None:
        for name in names:
            if not getattr(self, name) >= least:
                raise ValueError(f"algo.{name} must be at least {least}, got {getattr(self, name)}.")


def mean_over(batch: TensorDictBase, values: Tensor) -> Tensor:
    """The mean of ``(B, ...)`` over a minibatch, a scalar; of ``(L, B, ...)``, that of each learner ``(L,)``."""
    if batch.ndim == 1:
        return values.mean()
    of_steps = values.flatten(2).mean(-1)
    weight = batch.get("weight", None)
    return of_steps.mean(-1) if weight is None else (of_steps * weight).sum(-1)


def descend(losses: Sequence[Tensor], optimiser: torch.optim.Optimizer, ranks: Ranks) -> None:
    """One gradient step on the sum of ``losses``: on the minibatches of all ranks as if they were one."""
    torch.stack(list(losses)).sum().backward()
    ranks.average_gradients(weight for group in optimiser.param_groups for weight in group["params"])
    optimiser.step()
    optimiser.zero_grad()


class Exploration(Protocol):
    """Settings of the noise that an algorithm explores with."""

    @property
    def exploration_noise(self) -> Setting:
        """Standard deviation; actions lie in [-1, 1]."""

    @property
    def noise_memory(self) -> Setting:
        """Correlation time of the noise in steps; 1 is white noise."""

    @property
    def random_action(self) -> Setting:
        """Probability of a uniform action instead."""


def exploring(policy: TensorDictModule, env: EnvBase, algo: Exploration) -> TensorDictSequential:
    """The policy with noise added to its actions, or, at times, a uniform action instead.

    The noise is an Ornstein-Uhlenbeck process of deviation ``exploration_noise`` whose autocorrelation falls by
    ``1 / noise_memory`` a step; with a memory of 1 it is white.
    """
    rate = 1.0 / algo.noise_memory
    sigma = algo.exploration_noise * (rate * (2.0 - rate)) ** 0.5
    theta, sigma = (beside(value, env.action_spec.zero()) for value in (rate, sigma))
    noise = OrnsteinUhlenbeckProcessModule(
        env.action_spec, eps_init=1.0, eps_end=1.0, theta=theta, sigma=sigma, dt=1.0, device=env.device
    )
    random = algo.random_action
    if isinstance(random, Tensor):
        uniform = EGreedyModule(env.action_spec, 1.0, 1.0, device=env.device)
        uniform.eps = random.view(-1, 1)
    else:
        uniform = EGreedyModule(env.action_spec, random, random, device=env.device)
    return TensorDictSequential(policy, noise, uniform)


class JointSoftUpdate(SoftUpdate):
    """``SoftUpdate`` that moves all parameters at once, in a tenth of its time.

    Args:
        loss: with target networks.
        eps: share of the target networks' parameters that stays; the rest comes from the networks. Learners of a
            population may have one each.
    """

    def __init__(self, loss: LossModule, *, eps: Setting) -> None:
        super().__init__(loss, eps=largest(eps))
        pairs = list(followed_pairs(self))
        self._learned = [source.data for source, _ in pairs]
        self._followers = [target.data for _, target in pairs]
        self._way = 1.0 - eps

    def step(self) -> None:
        """Move the target networks."""
        if not isinstance(self._way, Tensor):
            lerp_all(self._followers, self._learned, self._way)
            return
        for follower, learned in zip(self._followers, self._learned, strict=True):
            follower.lerp_(learned, beside(self._way, learned))
