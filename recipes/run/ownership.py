"""Gives a run's folder or a job one owner at a time: the owner holds a file locked.

The lock is the operating system's: it ends with the process that holds it, however that ends, and depends on no clock.
It also holds between machines that share a file system with locks (NFS, Lustre, Ceph).
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import IO


class OwnedError(FileExistsError):
    """Another process owns the folder or job that this one was to write."""


@contextlib.contextmanager
def claimed(file: Path) -> Iterator[bool]:
    """Claim what ``file`` stands for; True if this process owns it within, False if another one does, on any machine.

    While this process owns it, the file names the process; afterwards the file is removed.

    Raises:
        OSError: if the file system has no locks.
    """
    held = _lock(file)
    if held is None:
        yield False
        return
    with held:
        try:
            yield True
        finally:
            file.unlink(missing_ok=True)


def owner_of(file: Path) -> str:
    """A description of the process that owns ``file``, for messages."""
    try:
        owner = json.loads(file.read_text())
        return f"process {owner['pid']} on {owner['host']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


def _lock(file: Path) -> IO[str] | None:
    """The file, open and locked; None if another process has it."""
    file.parent.mkdir(parents=True, exist_ok=True)
    while True:
        handle = file.open("a+")
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            handle.close()
            return None
        except OSError:
            handle.close()
            raise
        # The last owner may have removed the file after we opened it: then the lock is on nothing that others see.
        if _is_at(handle, file):
            handle.truncate(0)
            json.dump({"host": socket.gethostname(), "pid": os.getpid()}, handle)
            handle.flush()
            return handle
        handle.close()


def _is_at(handle: IO[str], file: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle.fileno()), file.stat())
    except FileNotFoundError:
        return False
