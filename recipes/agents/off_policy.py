"""What algorithms that learn from a replay buffer share: settings, exploration, the buffer, a gradient step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.modules import MLP, EGreedyModule, OrnsteinUhlenbeckProcessModule
from torchrl.objectives import SoftUpdate
from torchrl.objectives.common import LossModule

from nht.recipes.run.ranks import Ranks
from nht.recipes.sections import AlgoConfig
from nht.recipes.torch_internals import lerp_all
from nht.recipes.torchrl_internals import followed_pairs

STORED = (
    "observation",
    "action",
    ("next", "observation"),
    ("next", "reward"),
    ("next", "done"),
    ("next", "terminated"),
    "steps_to_next_obs",
)
"""What the buffer keeps of a step: all that a loss needs once observations are normalised."""


@dataclass
class OffPolicyConfig(AlgoConfig):
    """Settings of algorithms with a replay buffer; the defaults are published practice for locomotion."""

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
    observation_clip: float = 5.0  # of the normalised observation
    bfloat16: bool = False  # the precision of hidden layers' matrix products; weights stay float32

    def __post_init__(self) -> None:
        """Raise ValueError for a value outside its range."""
        if not 0 < self.gamma < 1:
            raise ValueError(f"algo.gamma must lie in (0, 1), got {self.gamma}.")
        self._check_unit("polyak", "pessimism")
        self._check_positive("observation_clip")
        counts = ("total_frames", "frames_per_batch", "n_steps", "batch_size", "buffer_size")
        self._check_least(1, *counts)
        self._check_least(0, "updates_per_batch", "warmup_frames", "random_frames")

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


def replay_buffer(size: int, device: torch.device) -> TensorDictReplayBuffer:
    """An empty buffer of up to ``size`` steps, from which minibatches are drawn uniformly."""
    return TensorDictReplayBuffer(storage=LazyTensorStorage(size, device=device))


def storable(steps: TensorDictBase) -> TensorDictBase:
    """What the buffer keeps of collected steps ``(*batch,)``, flat; without those whose action is not finite."""
    flat = steps.reshape(-1)
    return flat[flat["action"].isfinite().all(-1)].select(*STORED)


def minibatches(
    buffer: TensorDictReplayBuffer,
    updates: int,
    batch_size: int,
    features: TensorDictModule,
    device: torch.device,
) -> Iterator[TensorDictBase]:
    """``updates`` minibatches ``(batch_size,)``, drawn at once and normalised by today's statistics.

    Args:
        buffer: of raw observations.
        updates: number of minibatches.
        batch_size: steps in each.
        features: ``"observation"`` to ``"features"``.
        device: where the networks are.
    """
    if not updates:
        return
    replay = buffer.sample(updates * batch_size).to(device)
    with torch.no_grad():
        features(replay), features(replay["next"])
    yield from replay.split(batch_size)


def descend(losses: Sequence[Tensor], optimiser: torch.optim.Optimizer, ranks: Ranks) -> None:
    """One gradient step on the sum of ``losses``, scalars: on the minibatches of all ranks as if they were one."""
    torch.stack(list(losses)).sum().backward()
    ranks.average_gradients(weight for group in optimiser.param_groups for weight in group["params"])
    optimiser.step()
    optimiser.zero_grad()


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


class JointSoftUpdate(SoftUpdate):
    """``SoftUpdate`` that moves all parameters at once, in a tenth of its time.

    Args:
        loss: with target networks.
        eps: share of the target networks' parameters that stays; the rest comes from the networks.
    """

    def __init__(self, loss: LossModule, *, eps: float) -> None:
        super().__init__(loss, eps=eps)
        pairs = list(followed_pairs(self))
        self._learned = [source.data for source, _ in pairs]
        self._followers = [target.data for _, target in pairs]

    def step(self) -> None:
        """Move the target networks."""
        lerp_all(self._followers, self._learned, 1.0 - self.eps)
