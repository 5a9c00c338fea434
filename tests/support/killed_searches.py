"""Searches on Ray that can be killed, whole or one of their workers."""

import os
import signal
import time
from pathlib import Path

import killed_ranks
import killed_runs

WORKER = b"ray::"  # how Ray calls a process of its own


def run(folder, overrides):
    """What a process does."""
    from nht.recipes import search
    from nht.recipes.config import Search
    from nht.recipes.launch import configure

    killed_runs.speak_into(folder.with_suffix(".log"))
    search.POLL = 0.5
    search.main(configure(Search, "search", [f"folder={folder}", "num_workers=1", *overrides]))


def start(folder, overrides):
    """The search, started."""
    process = killed_runs.CONTEXT.Process(target=run, args=(folder, overrides))
    process.start()
    return process


def finish(folder, overrides):
    """Let it run to its end; the seconds that took."""
    began = time.monotonic()
    process = start(folder, overrides)
    process.join()
    assert process.exitcode == 0, killed_runs.words(folder)
    return time.monotonic() - began


def kill_after(seconds, victim, folder, overrides, training):
    """Kill the ``search``, or once all processes of Ray's that work for it; whether there was anything to kill.

    Nobody is waited for: what the search has started may outlive it for a while.

    Args:
        seconds: after its start, or, if ``training``, after a run has begun or gone on.
        victim: ``"search"`` or ``"worker"``.
        folder: of the search.
        overrides: that it is told.
        training: whether runs are to be at it.
    """
    before = killed_runs.written(folder, "train.log")
    process = start(folder, overrides)
    while training and process.is_alive() and killed_runs.written(folder, "train.log") == before:
        time.sleep(0.02)
    process.join(seconds)
    if not process.is_alive():
        return False
    if victim == "search":
        process.kill()
        process.join()
        return True
    found = workers(process.pid)
    for number in found:
        os.kill(number, signal.SIGKILL)
    process.join()
    if process.exitcode != 0:  # where Ray has not outlived it, it says so
        assert "Start the same command again" in killed_runs.words(folder), killed_runs.words(folder)
    return bool(found)


def workers(number):
    """The processes of Ray that do a search's work, among all that a process has started."""
    left, found = [number], []
    while left:
        children = killed_ranks.children(left.pop())
        left += children
        found += [child for child in children if named(child).startswith(WORKER)]
    return found


def named(number):
    """How a process calls itself."""
    try:
        return Path(f"/proc/{number}/cmdline").read_bytes()
    except (FileNotFoundError, ProcessLookupError):
        return b""
