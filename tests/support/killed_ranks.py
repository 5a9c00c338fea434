"""Runs of two ranks, under torchrun's own agent, whose launcher or one of whose ranks is killed."""

import os
import signal
import time
from pathlib import Path

from torch.distributed.launcher.api import LaunchConfig, elastic_launch

import killed_runs
import tiny_runs

PATIENCE = 100.0  # seconds that ranks have to end once their launcher is dead


def rank(algorithm, folder, overrides):
    """What each of the two does."""
    tiny_runs.train(algorithm, folder, "run.resume=auto", *overrides)


def launch(algorithm, folder, overrides, restarts):
    """What torchrun does; ranks are forked, so that they need not import everything again."""
    killed_runs.speak_into(folder.with_suffix(".log"))
    config = LaunchConfig(
        min_nodes=1,
        max_nodes=1,
        nproc_per_node=2,
        run_id="killed",
        rdzv_backend="c10d",
        rdzv_endpoint="localhost:0",
        max_restarts=restarts,
        monitor_interval=0.1,
        start_method="fork",
    )
    elastic_launch(config, rank)(algorithm, folder, overrides)


def start(algorithm, folder, overrides, restarts=0):
    """The launcher, started."""
    process = killed_runs.CONTEXT.Process(target=launch, args=(algorithm, folder, overrides, restarts))
    process.start()
    return process


def finish(algorithm, folder, overrides):
    """Let it run to its end; the seconds that took."""
    began = time.monotonic()
    process = start(algorithm, folder, overrides)
    process.join()
    assert process.exitcode == 0, killed_runs.words(folder)
    return time.monotonic() - began


def kill_after(seconds, victim, algorithm, folder, overrides, restarts):
    """Kill the launcher, or a rank, and wait until all are gone; whether there was somebody to kill.

    Args:
        seconds: after the launcher's start.
        victim: ``"launcher"``, or 0 or 1 for a rank.
        restarts: how often torchrun starts the ranks again when one of them has died.
    """
    process = start(algorithm, folder, overrides, restarts)
    process.join(seconds)
    ranks = children(process.pid)
    if not process.is_alive() or (victim != "launcher" and victim >= len(ranks)):
        process.join()
        return False
    os.kill(process.pid if victim == "launcher" else ranks[victim], signal.SIGKILL)
    process.join(PATIENCE)
    until = time.monotonic() + PATIENCE
    while process.is_alive() or any(map(runs, ranks)):
        assert time.monotonic() < until, f"{ranks} still run: {killed_runs.words(folder)}"
        time.sleep(0.05)
    return True


def children(number):
    """The processes that a process has started."""
    try:
        tasks = list(Path(f"/proc/{number}/task").iterdir())
        return sorted(int(child) for task in tasks for child in (task / "children").read_text().split())
    except FileNotFoundError:
        return []


def runs(number):
    """Whether a process is there, and no mere zombie."""
    try:
        return " Z " not in Path(f"/proc/{number}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return False
