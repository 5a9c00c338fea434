"""Pictures of all copies of a simulation, as environments give them when asked to render."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from nht.envs.simulation import DEFAULT_SIZE, Renderer, Simulation

View = tuple[int, int, str | int | None]
"""Width and height [pixel], and the camera."""


class Pictures:
    """Takes pictures of a simulation's copies; makes a renderer for every view that is asked for, and keeps it.

    A copied or pickled one starts without renderers.

    Args:
        task: what to look at.
    """

    def __init__(self, task: Simulation) -> None:
        self._task = task
        self._renderers: dict[View, Renderer] = {}

    def take(
        self,
        width: int = DEFAULT_SIZE[0],
        height: int = DEFAULT_SIZE[1],
        camera: str | int | None = None,
    ) -> NDArray[np.uint8]:
        """Every copy as it stands now, ``(N, height, width, 3)``; as of ``Simulation.renderer``."""
        view = (width, height, camera)
        if view not in self._renderers:
            self._renderers[view] = self._task.renderer(*view)
        return np.stack([self._renderers[view].frame(row) for row in range(self._task.num_envs)])

    def close(self) -> None:
        """Release the renderers; another ``take`` makes new ones."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers = {}

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_renderers": {}}


def check_mode(mode: str) -> None:
    """Raise ValueError for a render mode other than ``"rgb_array"``."""
    if mode != "rgb_array":
        raise ValueError(f"mode must be 'rgb_array', got {mode!r}.")
