"""Deterministic test episodes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from nht.recipes.run.metrics import FAILURE, RETURN, SUCCESS, tested

Policy = Callable[[TensorDictBase], TensorDictBase]


@dataclass(frozen=True)
class Evaluation:
    """Outcome of a number of test episodes, one value each, ``(episodes,)``; of learners, ``(L, episodes)``."""

    success: torch.Tensor
    """Whether the episode was successful at its last step."""
    failure: torch.Tensor
    """Whether it ever failed."""
    episode_return: torch.Tensor
    """Sum of its rewards."""

    def each(self) -> list[Evaluation]:
        """The outcome of every learner."""
        if self.success.ndim == 1:
            return [self]
        parts = zip(self.success, self.failure, self.episode_return, strict=True)
        return [Evaluation(*part) for part in parts]

    def metrics(self) -> dict[str, float]:
        """Means over the episodes."""
        return {
            tested(SUCCESS): float(self.success.double().mean()),
            tested(FAILURE): float(self.failure.double().mean()),
            tested(RETURN): float(self.episode_return.mean()),
        }


@torch.no_grad()
def evaluate(
    env: TransformedEnv, policy: Policy, on_step: Callable[[TensorDictBase], None] | None = None
) -> Evaluation:
    """Run one episode in every copy of ``env`` without exploration.

    Args:
        env: batched environment; its first episode end in each copy is the one that counts.
        policy: reads the observation, writes ``"action"``.
        on_step: called with what the reset and every step brought, before a copy whose episode ended is reset.
    """
    current = env.reset()
    running = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    success, failure = torch.zeros_like(running), torch.zeros_like(running)
    total = torch.zeros(env.batch_size, device=env.device)
    if on_step is not None:
        on_step(current)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while running.any():
            stepped = env.step(policy(current))
            outcome = stepped["next"]
            if on_step is not None:
                on_step(outcome)
            current = env.maybe_reset(step_mdp(stepped))
            success = torch.where(running, outcome[SUCCESS][..., 0], success)
            failure |= running & outcome[FAILURE][..., 0]
            total += running * outcome["reward"][..., 0]
            running &= ~outcome["done"][..., 0]
    return Evaluation(success, failure, total)
