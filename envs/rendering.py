"""Pictures of one copy of a task or of another simulator, through MuJoCo's renderer."""

from __future__ import annotations

from itertools import pairwise
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array
from nht.envs.offscreen import open_renderer
from nht.envs.simulation import DEFAULT_SIZE

LINE = np.array([0.15, 0.35, 0.85, 0.9], dtype=np.float32)  # red, green, blue, opacity


class Scene(Protocol):
    """Copies that share a model, each a row of one state array, such as a ``BatchedTask``: they can be drawn."""

    model: mujoco.MjModel
    state: Array

    def decorate(self, scene: mujoco.MjvScene, row: int) -> None:
        """Add what the model does not hold (goals, marks) of copy ``row``."""


class SceneRenderer:
    """Renders a copy of a task with what the task adds to the scene (goal, marks).

    Args:
        task: the task to look at.
        width: picture width [pixel].
        height: picture height [pixel].
        camera: name or number of a camera of the model.

    Raises:
        RuntimeError: if this machine has no OpenGL for offscreen rendering; the message says what to install.
        ValueError: if the model has no such camera.
    """

    def __init__(
        self,
        task: Scene,
        width: int = DEFAULT_SIZE[0],
        height: int = DEFAULT_SIZE[1],
        camera: str | int = 0,
    ) -> None:
        self.task = task
        self.camera = _checked_camera(task.model, camera)
        self._data = mujoco.MjData(task.model)
        self._renderer = open_renderer(task.model, width, height)

    def frame(self, row: int = 0, trail: Array | None = None) -> NDArray[np.uint8]:
        """The copy ``row`` as it stands now, ``(height, width, 3)``.

        Args:
            row: which copy.
            trail: points ``(T, 3)`` to draw a line through, for example where the tool has been.
        """
        full_physics = mujoco.mjtState.mjSTATE_FULLPHYSICS
        mujoco.mj_setState(self.task.model, self._data, self.task.state[row], full_physics)
        mujoco.mj_forward(self.task.model, self._data)
        self._renderer.update_scene(self._data, camera=self.camera)
        self.task.decorate(self._renderer.scene, row)
        if trail is not None:
            _draw_line(self._renderer.scene, trail)
        return self._renderer.render()

    def close(self) -> None:
        """Release the OpenGL context."""
        self._renderer.close()


class MujocoRenderer:
    """Renders a simulator of MuJoCo, whoever steps it, through the model's first camera or another one of its own.

    Args:
        model: of the simulator.
        data: the state to draw.
        width: picture width [pixel].
        height: picture height [pixel].
        camera: name or number of a camera of the model; None is the first one, or the free one if it has none.

    Raises:
        RuntimeError: if this machine has no OpenGL for offscreen rendering; the message says what to install.
        ValueError: if the model has no such camera.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        width: int,
        height: int,
        camera: str | int | None = None,
    ) -> None:
        self.camera = (0 if model.ncam else -1) if camera is None else _checked_camera(model, camera)
        self._data = data
        self._renderer = open_renderer(model, width, height)

    def frame(self, trail: Array | None = None) -> NDArray[np.uint8]:
        """The simulator as it stands now, ``(height, width, 3)``."""
        self._renderer.update_scene(self._data, camera=self.camera)
        if trail is not None:
            _draw_line(self._renderer.scene, trail)
        return self._renderer.render()

    def close(self) -> None:
        """Release the OpenGL context."""
        self._renderer.close()


class NativeRenderer:
    """Renders the one copy of a task of ours that Gymnasium made.

    Args:
        renderer: of the task.
    """

    def __init__(self, renderer: SceneRenderer) -> None:
        self._renderer = renderer

    def frame(self, trail: Array | None = None) -> NDArray[np.uint8]:
        """The copy as it stands now, ``(height, width, 3)``."""
        return self._renderer.frame(0, trail)

    def close(self) -> None:
        """Release the OpenGL context."""
        self._renderer.close()


def _checked_camera(model: mujoco.MjModel, camera: str | int) -> str | int:
    names = [model.camera(i).name for i in range(model.ncam)]
    known = camera in names if isinstance(camera, str) else -1 <= camera < max(model.ncam, 1)
    if not known:
        raise ValueError(
            f"the model has no camera {camera!r}: choose from {names}, or a number below {model.ncam}."
        )
    return camera if model.ncam or isinstance(camera, str) else -1


def _draw_line(scene: mujoco.MjvScene, points: Array, width: float = 3.0) -> None:
    """Add a line [width in pixels] to the scene: through the last points if it has no room for all."""
    room = scene.maxgeom - scene.ngeom
    for start, end in list(pairwise(points))[-room:]:
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_LINE, np.zeros(3), np.zeros(3), np.eye(3).ravel(), LINE
        )
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_LINE, width, start, end)
        scene.ngeom += 1
