"""Sends MuJoCo's warnings to Python's logging: MuJoCo itself writes them to the console and into the working folder."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager

import mujoco

LOGGER = logging.getLogger(__name__)
NUMBER = re.compile(r"-?\d+(\.\d+)?([eE][+-]?\d+)?")
_told: set[tuple[int, str]] = set()
"""Warnings that were logged: the level, and the text without its numbers."""


@contextmanager
def warnings_logged(level: int = logging.WARNING, *, others: bool = False) -> Iterator[None]:
    """Within, MuJoCo's warnings go to this module's logger, and no ``MUJOCO_LOG.TXT`` is written.

    A diverging simulation warns at every step: of warnings that differ in their numbers only, the first is told.
    Serves as a decorator, too.

    Args:
        level: of the log's records.
        others: whether to replace a handler that another library gave MuJoCo, such as dm_control's.
    """
    previous = mujoco.get_mju_user_warning()
    if previous is not None and not others:
        yield
        return

    def tell(text: str) -> None:
        kind = (level, NUMBER.sub("", text))
        if kind not in _told:
            _told.add(kind)
            LOGGER.log(level, "MuJoCo: %s", text.strip())

    mujoco.set_mju_user_warning(tell)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)
