"""Keeps processes from outliving the one that started them, and leaves signals to it."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable

PARENT_CHECK_EVERY = 0.5
"""Seconds between two checks whether the parent still lives."""


def follow(parent: int, then: Callable[[], object]) -> None:
    """Call ``then``, in a thread, as soon as process ``parent`` has died: then this process has another parent.

    Args:
        parent: number of the process that started this one.
        then: called without arguments.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(PARENT_CHECK_EVERY)
        then()

    threading.Thread(target=watch, name="follow-parent", daemon=True).start()


def serve(parent: int) -> None:
    """Make this process a worker of ``parent``: it ends when that dies, and ignores SIGTERM and SIGINT until then.

    Batch systems send these to the whole group of processes: the parent then needs its workers for a last batch, and
    ends them itself. To be called in the main thread.
    """
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, signal.SIG_IGN)
    follow(parent, lambda: os._exit(1))


def end_with(parent: int, patience: float) -> None:
    """Send this process SIGTERM as soon as ``parent`` has died, and kill it ``patience`` seconds later.

    Args:
        parent: number of the process that started this one.
        patience: time for a last checkpoint [s].
    """

    def end() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(patience)
        os.kill(os.getpid(), signal.SIGKILL)

    follow(parent, end)
