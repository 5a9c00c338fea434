"""Opens MuJoCo's renderer where there is no window: through EGL if no display answers."""

from __future__ import annotations

import atexit
import importlib
import os
import sys
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import mujoco
from mujoco.rendering.classic import gl_context

from nht.envs.display import display_answers

_most_shadow: ContextVar[int | None] = ContextVar("_most_shadow", default=None)


@contextmanager
def coarse_shadows(width: int) -> Iterator[None]:
    """Within, renderers are opened with shadow maps of at most ``width`` pixels: in software they are half of the work.

    Models ask for shadow maps of up to 4,096 pixels a side; in small pictures a quarter of that looks the same.
    """
    before = _most_shadow.set(width)
    try:
        yield
    finally:
        _most_shadow.reset(before)


def open_renderer(model: mujoco.MjModel, width: int, height: int) -> mujoco.Renderer:
    """MuJoCo's renderer for pictures of this size [pixel].

    Raises:
        RuntimeError: if this machine has no OpenGL for offscreen rendering; the message says what to install.
    """
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
    """Within, the model asks for a buffer of the picture's size, and for no finer shadows than are wanted."""
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

    MuJoCo chooses when it is imported, often before this package is (TorchRL imports it), so it has to choose again.
    """
    if sys.platform == "linux" and not os.environ.get("MUJOCO_GL") and not display_answers():
        os.environ["MUJOCO_GL"] = "egl"
        importlib.reload(gl_context)
