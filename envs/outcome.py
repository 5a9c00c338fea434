"""What a step of N copies brought."""

from __future__ import annotations

from dataclasses import dataclass

from nht.envs.arrays import Array, Flags


@dataclass(frozen=True)
class Outcome:
    """What one environment step brought, a row per copy; every array is the caller's own.

    ``truncated`` is the time limit, ``terminated`` an end that belongs to the task; they are never merged.
    ``diverged`` marks copies whose actuation or physics was not finite: they failed and wait for a reset.
    """

    reward: Array
    terminated: Flags
    truncated: Flags
    success: Flags
    failure: Flags
    diverged: Flags


OUTCOME_FLAGS = ("terminated", "truncated", "success", "failure", "diverged")

INFO_FLAGS = ("success", "failure", "diverged")
"""Those that Gymnasium's ``info`` and TorchRL's TensorDict have beside ``terminated`` and ``truncated``."""
