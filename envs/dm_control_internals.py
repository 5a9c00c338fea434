"""Parts of dm_control that are not public, each with what it relies on; the only place that uses them."""

from __future__ import annotations

from typing import Any


class SuiteClock:
    """The episode's clock of an environment of the suite.

    Relies on ``Environment._step_limit``, ``_step_count`` and ``_reset_next_step`` of ``dm_control.rl.control``.

    Args:
        env: dm_control's own environment.
    """

    def __init__(self, env: Any) -> None:
        self._env = env

    @property
    def limit(self) -> float:
        """Environment steps in an episode, or infinity."""
        return self._env._step_limit

    @property
    def steps(self) -> int:
        """Environment steps since the last reset."""
        return self._env._step_count

    @steps.setter
    def steps(self, steps: int) -> None:
        self._env._step_count = steps

    @property
    def ended(self) -> bool:
        """Whether the next step starts an episode."""
        return self._env._reset_next_step

    @ended.setter
    def ended(self, ended: bool) -> None:
        self._env._reset_next_step = ended
