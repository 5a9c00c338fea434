"""The protocol that the recipes need of a simulation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

DEFAULT_SIZE = (640, 480)
"""Width and height of a picture [pixel]."""


class Simulation(Protocol):
    """N copies of a task, behind an environment of TorchRL that has it as its ``task``.

    ``BatchedTask`` and ``ForeignTask`` are simulations. To use an environment of another kind in the recipes, give it a
    ``task`` with these members.
    """

    @property
    def num_envs(self) -> int:
        """Number of copies N."""

    @property
    def observation_sizes(self) -> Mapping[str, int]:
        """Length of every observation by its key; ``"observation"`` is what a policy sees."""

    @property
    def max_episode_steps(self) -> int:
        """Environment steps after which an episode is truncated."""

    @property
    def time_per_step(self) -> float:
        """Simulated time of one environment step [s]; it sets the speed of films."""

    @property
    def reward_range(self) -> tuple[float, float]:
        """Smallest and largest reward of a step, infinite where unknown."""

    @property
    def can_resume(self) -> bool:
        """Whether ``state_dict`` holds all that later steps depend on, so that a loaded one goes on bit for bit."""

    @property
    def resume_obstacle(self) -> str:
        """Why it does not, as a clause; ``""`` where it does."""

    def state_dict(self) -> dict[str, Any]:
        """Physics, episodes and generators, as far as they can be saved: numbers, text, arrays, and dicts of them."""

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned; where ``can_resume`` is False, new episodes have to be started."""

    def renderer(
        self, width: int = DEFAULT_SIZE[0], height: int = DEFAULT_SIZE[1], camera: str | int | None = None
    ) -> Renderer:
        """A renderer that takes pictures of the copies.

        Args:
            width: of a picture [pixel].
            height: of a picture [pixel].
            camera: name or number of a camera, where there is a choice; None is the first one.

        Raises:
            RuntimeError: if this simulation, or this machine, cannot draw; the message says what is missing.
        """


class Renderer(Protocol):
    """Takes pictures of the copies of a simulation."""

    def frame(self, row: int = 0, trail: NDArray[np.float64] | None = None) -> NDArray[np.uint8]:
        """The copy ``row`` as it stands now, ``(height, width, 3)``.

        Args:
            row: which copy.
            trail: points ``(T, 3)`` to draw a line through, where the simulation can; else it is left out.
        """

    def close(self) -> None:
        """Release what drawing needs."""


class CopyRenderer(Protocol):
    """Takes pictures of one copy of an environment of another library."""

    def frame(self, trail: NDArray[np.float64] | None = None) -> NDArray[np.uint8]:
        """The copy as it stands now, ``(height, width, 3)``; ``trail`` as of ``Renderer``."""

    def close(self) -> None:
        """Release what drawing needs."""
