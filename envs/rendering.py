"""Offscreen pictures of one copy of a task, through MuJoCo's renderer."""

from __future__ import annotations

import atexit
import importlib
import os
import socket
import sys
import weakref
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import pairwise
from typing import Any, Protocol

import gymnasium
import mujoco
import numpy as np
from mujoco.rendering.classic import gl_context
from numpy.typing import NDArray

from nht.envs.arrays import Array
from nht.envs.simulation import DEFAULT_SIZE

LINE = np.array([0.15, 0.35, 0.85, 0.9], dtype=np.float32)  # red, green, blue, opacity

_most_shadow: ContextVar[int | None] = ContextVar("_most_shadow", default=None)


@contextmanager
def coarse_shadows(width: int) -> Iterator[None]:
    """Renderers that are opened within draw shadows no finer than ``width`` pixels: in software half of all the work.

    Models ask for shadow maps of up to 4,096 pixels a side; in small pictures a quarter of that looks the same.
    """
    before = _most_shadow.set(width)
    try:
        yield
    finally:
        _most_shadow.reset(before)


class Scene(Protocol):
    """What is drawn: copies that share a model, each a row of one state array. ``BatchedTask`` is one."""

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
        self._renderer = _open_renderer(model, width, height)

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


def _checked_camera(model: mujoco.MjModel, camera: str | int) -> str | int:
    names = [model.camera(i).name for i in range(model.ncam)]
    known = camera in names if isinstance(camera, str) else -1 <= camera < max(model.ncam, 1)
    if not known:
        raise ValueError(
            f"the model has no camera {camera!r}: choose from {names}, or a number below {model.ncam}."
        )
    return camera if model.ncam or isinstance(camera, str) else -1


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
        with _visual_settings(model, width, height):
            renderer = mujoco.Renderer(model, height, width)
    except Exception as error:
        raise RuntimeError(
            "offscreen rendering needs OpenGL: install EGL (Debian: libegl1 libgl1-mesa-dri), or OSMesa "
            "(libosmesa6) and set MUJOCO_GL=osmesa before Python starts."
        ) from error
    # At exit MuJoCo ends EGL; what the collector frees after that prints a traceback.
    atexit.register(_close, weakref.ref(renderer))
    return renderer


@contextmanager
def _visual_settings(model: mujoco.MjModel, width: int, height: int) -> Iterator[None]:
    """Within, the model asks for a buffer of just the picture's size, and for no finer shadows than are wanted."""
    screen, quality, most = model.vis.global_, model.vis.quality, _most_shadow.get()
    before = screen.offwidth, screen.offheight, quality.shadowsize
    screen.offwidth, screen.offheight = width, height
    quality.shadowsize = before[2] if most is None else min(before[2], most)
    try:
        yield
    finally:
        screen.offwidth, screen.offheight, quality.shadowsize = before


def _close(renderer: weakref.ref[mujoco.Renderer]) -> None:
    if (still_there := renderer()) is not None:
        still_there.close()


def _prefer_offscreen_platform() -> None:
    """Let MuJoCo render through EGL where no display answers and nothing else was asked for.

    MuJoCo chooses at its import, often before anyone could tell it (TorchRL imports it), so it has to choose again.
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL") and not display_answers():
        os.environ["MUJOCO_GL"] = "egl"
        importlib.reload(gl_context)


def display_answers(seconds: float = 2.0) -> bool:
    """Whether somebody serves the display that ``DISPLAY`` names: often nobody does, over ssh, in tmux, under cron."""
    host, _, number = os.environ.get("DISPLAY", "").rpartition(":")
    screen = number.partition(".")[0]
    if not screen.isdecimal():
        return False
    if host in ("", "unix"):
        # Abstract first, as X clients do.
        return any(
            _connects(socket.AF_UNIX, f"{root}/tmp/.X11-unix/X{screen}", seconds) for root in ("\0", "")
        )
    return any(
        _connects(family, address[:2], seconds)
        for family, _, _, _, address in _addresses(host, 6000 + int(screen))
        if family in (socket.AF_INET, socket.AF_INET6)
    )


def _addresses(host: str, port: int) -> list[Any]:
    try:
        return socket.getaddrinfo(host.partition("/")[0], port, type=socket.SOCK_STREAM)
    except OSError:
        return []


def _connects(family: int, address: Any, seconds: float) -> bool:
    with socket.socket(family, socket.SOCK_STREAM) as client:
        client.settimeout(seconds)
        try:
            client.connect(address)
        except OSError:
            return False
    return True
