"""Parts of Gymnasium that are not public, each with what it relies on; the only place that uses them."""

from __future__ import annotations

from typing import Any

import gymnasium
from gymnasium.wrappers import TimeLimit

GENERATOR = "_np_random"
"""The attribute behind ``gymnasium.Env.np_random``; None until that is first read."""


class EpisodeClock:
    """The clock of an environment's ``TimeLimit``, if there is one among its wrappers.

    Relies on ``TimeLimit._max_episode_steps`` and ``TimeLimit._elapsed_steps``.
    """

    def __init__(self, env: gymnasium.Env[Any, Any]) -> None:
        while isinstance(env, gymnasium.Wrapper) and not isinstance(env, TimeLimit):
            env = env.env
        self._wrapper: Any = env if isinstance(env, TimeLimit) else None

    @property
    def limit(self) -> int | None:
        """Steps after which an episode is truncated, or None."""
        return None if self._wrapper is None else self._wrapper._max_episode_steps

    @property
    def steps(self) -> int | None:
        """Steps since the last reset; None before the first one, and without a time limit."""
        return None if self._wrapper is None else self._wrapper._elapsed_steps

    @steps.setter
    def steps(self, steps: int | None) -> None:
        if self._wrapper is not None:
            self._wrapper._elapsed_steps = steps
