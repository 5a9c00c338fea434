"""Offscreen pictures of one copy of a task, through MuJoCo's renderer."""

from __future__ import annotations

import atexit
import importlib
import os
import sys
import weakref
from itertools import pairwise

import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context
from numpy.typing import NDArray

from nht.envs.foreign import ForeignTask
from nht.envs.task import Array, BatchedTask

LINE = np.array([0.15, 0.35, 0.85, 0.9], dtype=np.float32)  # red, green, blue, opacity


class SceneRenderer:
    """Renders a copy of a task with what the task adds to the scene (goal, marks).

    Args:
        task: the task to look at.
        width: picture width [pixel].
        height: picture height [pixel].
        camera: name of a camera in the model.

    Raises:
        RuntimeError: if this machine has no OpenGL for offscreen rendering; the message says what to install.
    """

    def __init__(self, task: BatchedTask, width: int = 640, height: int = 480, camera: str | int = 0) -> None:
        self.task = task
        self.camera = camera
        self._data = mujoco.MjData(task.model)
        self._renderer = _open_renderer(task.model, width, height)

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


class ForeignRenderer:
    """Renders copies of an environment of another library, each with its own model: they may differ.

    Args:
        task: the simulators to look at.
        width: picture width [pixel].
        height: picture height [pixel].

    Raises:
        RuntimeError: if this machine has no OpenGL for offscreen rendering; the message says what to install.
    """

    def __init__(self, task: ForeignTask, width: int = 640, height: int = 480) -> None:
        self.task = task
        self._renderers = [_open_renderer(copy.model, width, height) for copy in task.copies]

    def frame(self, row: int = 0, trail: Array | None = None) -> NDArray[np.uint8]:
        """The copy ``row`` as it stands now, through the model's first camera; else as of ``SceneRenderer``."""
        copy, renderer = self.task.copies[row], self._renderers[row]
        renderer.update_scene(copy.data, camera=0 if copy.model.ncam else -1)
        if trail is not None:
            _draw_line(renderer.scene, trail)
        return renderer.render()

    def close(self) -> None:
        """Release the OpenGL contexts."""
        for renderer in self._renderers:
            renderer.close()


def _draw_line(scene: mujoco.MjvScene, points: Array, width: float = 3.0) -> None:
    """Add a line [pixels wide] to the scene; of more points than it has room for, the last ones."""
    room = scene.maxgeom - scene.ngeom
    for start, end in list(pairwise(points))[-room:]:
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(
            geom, mujoco.mjtGeom.mjGEOM_LINE, np.zeros(3), np.zeros(3), np.eye(3).ravel(), LINE
        )
        mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_LINE, width, start, end)
        scene.ngeom += 1


def _open_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    _prefer_offscreen_platform()
    try:
        renderer = mujoco.Renderer(model, height, width)
    except Exception as error:
        raise RuntimeError(
            "offscreen rendering needs OpenGL: install EGL (Debian: libegl1 libgl1-mesa-dri), or OSMesa "
            "(libosmesa6) and set MUJOCO_GL=osmesa before Python starts."
        ) from error
    # At exit MuJoCo ends EGL; what the collector frees after that prints a traceback.
    atexit.register(_close, weakref.ref(renderer))
    return renderer


def _close(renderer: weakref.ref[mujoco.Renderer]) -> None:
    if (still_there := renderer()) is not None:
        still_there.close()


def _prefer_offscreen_platform() -> None:
    """Let MuJoCo render through EGL where there is no display and nothing else was asked for.

    MuJoCo chooses at its import, often before anyone could tell it (TorchRL imports it), so it has to choose again.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY") and not os.environ.get("MUJOCO_GL"):
        os.environ["MUJOCO_GL"] = "egl"
        importlib.reload(gl_context)
