"""The result of one environment step of N copies."""

from __future__ import annotations

from dataclasses import dataclass

from nht.envs.arrays import Array, Flags


@dataclass(frozen=True)
class Outcome:
    """The result of one environment step, a row per copy; the caller owns the arrays.

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
"""Flags that Gymnasium's ``info`` and TorchRL's TensorDict have beside ``terminated`` and ``truncated``."""
