"""Pictures that an environment draws itself, brought to one size."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array


class OwnRenderer:
    """Takes the pictures that an environment draws itself, and brings them to one size. Trails are left out.

    Args:
        draw: draws the environment as it stands now, ``(h, w, 3)``.
        width: picture width [pixel].
        height: picture height [pixel].
        camera: there is no choice: None, or 0.

    Raises:
        ValueError: for another camera.
    """

    def __init__(
        self, draw: Callable[[], Any], width: int, height: int, camera: str | int | None = None
    ) -> None:
        if camera not in (None, 0):
            raise ValueError(f"the environment draws itself, through no other camera, got {camera!r}.")
        self._draw = draw
        self._size = (height, width)

    def frame(self, trail: Array | None = None) -> NDArray[np.uint8]:
        """The environment as it stands now, ``(height, width, 3)``.

        Raises:
            RuntimeError: if it draws something else, or lacks a package for it; the message says what is missing.
        """
        try:
            picture = self._draw()
        except gymnasium.error.DependencyNotInstalled as error:
            reason = str(error).removesuffix(".")
            raise RuntimeError(f"the environment cannot be drawn: {reason}.") from error
        picture = np.asarray(picture)
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise RuntimeError(
                f"the environment drew no picture (height, width, 3), but {picture.shape} of {picture.dtype}."
            )
        return resized(picture, self._size)

    def close(self) -> None:
        """Nothing to release: the environment's own drawing ends with it."""


def resized(picture: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """A picture ``(h, w, 3)`` brought to another height and width, each pixel an average."""
    if picture.shape[:2] == size:
        return picture.copy()
    import torch

    colours = torch.from_numpy(picture.copy()).permute(2, 0, 1)[None].float()
    drawn = torch.nn.functional.interpolate(colours, size=size, mode="bilinear", antialias=True)
    return drawn[0].permute(1, 2, 0).round().clamp(0, 255).to(torch.uint8).numpy()
