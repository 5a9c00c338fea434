"""The simulators behind copies of another library's environment: saved, loaded and drawn."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nht.envs.simulation import DEFAULT_SIZE, CopyRenderer

LONGEST_EPISODE = 1_000
"""Environment steps after which an episode is truncated where the environment itself knows no limit."""


class ForeignCopy(ABC):
    """The simulator behind one copy of an environment."""

    time_per_step: float
    """Simulated time of one environment step [s]."""
    max_episode_steps: float = math.inf
    """Environment steps in an episode; infinity where the environment has no limit, and then it gets one."""
    longest_episode: int | None = None
    """The limit that it gets; None is ``LONGEST_EPISODE``."""
    reward_range: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and largest reward of a step."""
    aside: Sequence[str] = ()
    """Observations that are not part of ``"observation"``."""
    resume_obstacle: str = ""
    """Why the copy cannot be saved completely, as a clause; ``""`` where it can."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step and the next reset depend on, as far as it can be saved."""

    @abstractmethod
    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""

    @abstractmethod
    def renderer(self, width: int, height: int, camera: str | int | None) -> CopyRenderer:
        """Takes pictures of this copy, of this size [pixel].

        Raises:
            RuntimeError: if it cannot be drawn; the message says why.
        """


class ForeignTask:
    """The simulators of all copies as one ``Simulation``; the counterpart of ``BatchedTask``."""

    def __init__(self, copies: Sequence[ForeignCopy], observation_sizes: dict[str, int]) -> None:
        self.copies = list(copies)
        self.observation_sizes = observation_sizes
        self.num_envs = len(copies)
        self.time_per_step = copies[0].time_per_step
        self.reward_range = copies[0].reward_range
        limit = copies[0].max_episode_steps
        self.max_episode_steps = longest(copies[0]) if math.isinf(limit) else round(limit)

    @property
    def can_resume(self) -> bool:
        """Whether a loaded state goes on bit for bit."""
        return not self.resume_obstacle

    @property
    def resume_obstacle(self) -> str:
        """Why it does not, as a clause; ``""`` where it does."""
        return self.copies[0].resume_obstacle

    def state_dict(self) -> dict[str, Any]:
        """Everything a later ``load_state_dict`` needs to go on bit for bit, as far as it can be saved."""
        return {f"copy{i}": copy.state_dict() for i, copy in enumerate(self.copies)}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        for i, copy in enumerate(self.copies):
            copy.load_state_dict(saved.get(f"copy{i}", {}))

    def renderer(
        self, width: int = DEFAULT_SIZE[0], height: int = DEFAULT_SIZE[1], camera: str | int | None = None
    ) -> ForeignRenderer:
        """Takes pictures of the copies, of this size [pixel]; None is the first camera.

        Raises:
            RuntimeError: if the environment, or this machine, cannot draw; the message says what is missing.
        """
        return ForeignRenderer(self, width, height, camera)


class ForeignRenderer:
    """Renders copies of an environment of another library, each on its own: their models may differ.

    Args:
        task: the simulators to look at.
        width: picture width [pixel].
        height: picture height [pixel].
        camera: name or number of a camera, where there is a choice; None is the first one.

    Raises:
        RuntimeError: if the environment, or this machine, cannot draw; the message says what is missing.
        ValueError: if there is no such camera.
    """

    def __init__(self, task: ForeignTask, width: int, height: int, camera: str | int | None) -> None:
        self._renderers = [copy.renderer(width, height, camera) for copy in task.copies]

    def frame(self, row: int = 0, trail: NDArray[np.float64] | None = None) -> NDArray[np.uint8]:
        """The copy ``row`` as it stands now; as of ``Renderer``."""
        return self._renderers[row].frame(trail)

    def close(self) -> None:
        """Release the renderers of all copies."""
        for renderer in self._renderers:
            renderer.close()


def longest(copy: ForeignCopy) -> int:
    """Environment steps after which an episode is truncated where the environment itself knows no limit."""
    return LONGEST_EPISODE if copy.longest_episode is None else copy.longest_episode
