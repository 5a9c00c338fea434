"""What an expert would do where something else moves the robot: demonstrations beside the expert's own way."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

import nht
from nht.envs.experts import Expert
from nht.envs.task import BatchedTask

EXPERT_ACTION = "expert_action"
"""The key of what the expert would do."""
MEMORY = 10
"""Steps after which a disturbance has forgotten itself."""

Controller = Callable[[TensorDictBase], TensorDictBase]
"""Writes ``"action"`` into the environment's observations."""


def answering(expert: Expert, task: BatchedTask) -> Controller:
    """Writes what an expert would do, ``(N, n)``, under ``EXPERT_ACTION``."""

    def answer(current: TensorDictBase) -> TensorDictBase:
        observation = {key: current[key].numpy() for key in task.observation_sizes}
        return current.set(EXPERT_ACTION, torch.from_numpy(expert(observation)).float())

    return answer


class Disturbance:
    """Noise on actuations that changes slowly: an Ornstein-Uhlenbeck process of ``MEMORY`` steps.

    Args:
        deviation: its standard deviation, in units of actuation.
        seed: of its draws.
    """

    def __init__(self, deviation: float, seed: int) -> None:
        self._deviation = deviation
        self._rng = np.random.default_rng(seed)
        self._noise: np.ndarray | float = 0.0

    def __call__(self, actuation: Tensor) -> Tensor:
        """``(N, n)`` with noise added."""
        stays = 1.0 - 1.0 / MEMORY
        fresh = self._deviation * math.sqrt(1.0 - stays**2) * self._rng.standard_normal(actuation.shape)
        self._noise = stays * self._noise + fresh
        return actuation + torch.from_numpy(self._noise).float()


def shared_driving(
    expert: Expert, policy: Controller, map: nht.ActionMap, keys: Sequence[NestedKey], task: BatchedTask
) -> Controller:
    """A policy drives every other copy through its map, the expert the others; it answers in all of them.

    Args:
        expert: of the task.
        policy: gives actions ``(N, k)`` of the map.
        map: of the policy.
        keys: of its context.
        task: what is simulated, without a map.
    """
    low, high = (torch.as_tensor(bound) for bound in task.actuation_bounds)
    answer = answering(expert, task)

    def act(current: TensorDictBase) -> TensorDictBase:
        current = answer(current)
        action = policy(current.clone(recurse=False))["action"]
        context = torch.cat([action[:, :0], *(current[key] for key in keys)], dim=-1)
        driven = map.decode(action, context, low, high)
        own = torch.arange(len(action)).unsqueeze(-1) % 2 == 1
        return current.set("action", torch.where(own, current[EXPERT_ACTION], driven))

    return act
