"""Runs in processes that can be killed, and that start fast: forked from one that has imported everything."""

import multiprocessing
import os
import signal
import tempfile
import time

import tiny_runs
from nht.recipes.run import checkpoints

CONTEXT = multiprocessing.get_context("forkserver")
CONTEXT.set_forkserver_preload(["killed_runs", "killed_ranks", "nht.recipes.ddpg", "nht.recipes.ppo"])


def train(algorithm, folder, overrides, barrier=None):
    """What a process does; its words go to a file beside the run's folder."""
    if barrier is not None:
        barrier.wait()
    speak_into(folder.with_suffix(".log"))
    tempfile.tempdir = str(folder.parent)  # where a test sees what is left
    tiny_runs.start(algorithm, folder, "run.resume=auto", *overrides)


def speak_into(file):
    """Let this process write what it says into a file, behind what stands there."""
    log = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)


def start(algorithm, folder, overrides, barrier=None):
    """The process, started; it begins when as many as ``barrier`` is for have come there."""
    process = CONTEXT.Process(target=train, args=(algorithm, folder, overrides, barrier))
    process.start()
    return process


def kill_at_checkpoint(number, algorithm, folder, overrides):
    """Kill it at the moment when its first, second ... checkpoint is written but not yet in its place."""
    process = CONTEXT.Process(target=_train_to_checkpoint, args=(number, algorithm, folder, overrides))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL, words(folder)


def _train_to_checkpoint(number, algorithm, folder, overrides):
    publish, written = checkpoints.publish, []

    def kill(*paths):
        written.append(paths)
        if len(written) == number:
            os.kill(os.getpid(), signal.SIGKILL)
        return publish(*paths)

    checkpoints.publish = kill
    train(algorithm, folder, overrides)


def finish(algorithm, folder, overrides):
    """Let it run to its end; the seconds that took."""
    began = time.monotonic()
    process = start(algorithm, folder, overrides)
    process.join()
    assert process.exitcode == 0, words(folder)
    return time.monotonic() - began


def kill_after(seconds, algorithm, folder, overrides, since=None):
    """Kill it so long after its start, or after it has written the file ``since``; whether it was still running."""
    before = written(folder, since)
    process = start(algorithm, folder, overrides)
    while since is not None and process.is_alive() and written(folder, since) == before:
        time.sleep(0.005)
    process.join(seconds)
    process.kill()
    process.join()
    assert process.exitcode in (0, -9), words(folder)
    return process.exitcode != 0


def written(folder, name):
    """When the newest file of that name beneath a folder was written [ns]; 0 if there is none."""
    return max((file.stat().st_mtime_ns for file in folder.rglob(name or "")), default=0)


def words(folder):
    """What the processes of a run have said."""
    return folder.with_suffix(".log").read_text()
