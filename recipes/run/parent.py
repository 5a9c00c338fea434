"""Processes that do not outlive the one that started them, and leave signals to it."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable

LOOK_EVERY = 0.5
"""Seconds between two looks whether the parent still lives."""


def follow(parent: int, then: Callable[[], object]) -> None:
    """Call ``then``, in a thread of its own, as soon as process ``parent`` no longer is this one's parent: it has died.

    Args:
        parent: number of the process that started this one.
        then: what is to be done.
    """

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(LOOK_EVERY)
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
    """Be told to end, by SIGTERM, as soon as ``parent`` has died; be killed ``patience`` seconds later.

    Args:
        parent: number of the process that started this one.
        patience: for a last checkpoint [s].
    """

    def end() -> None:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(patience)
        os.kill(os.getpid(), signal.SIGKILL)

    follow(parent, end)
