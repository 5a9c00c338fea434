"""Runs many jobs at a time with Ray, on this machine or on a cluster."""

from __future__ import annotations

import logging
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")

try:
    import ray
    from ray.exceptions import OutOfMemoryError, RayError, RayTaskError, WorkerCrashedError
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy
except ImportError as error:
    raise ImportError("searches need Ray: pip install 'nht[search]'.") from error

from nht.reading import shortened
from nht.recipes.study.jobs import Ending, Job
from nht.recipes.study.packs import Pack

Work = TypeVar("Work", Job, Pack)

ANSWER = 15.0
"""Seconds within which a cluster must answer."""


class Cluster:
    """Ray, started on this machine or connected to.

    Args:
        address: of a cluster, ``host:port`` or ``auto``; None starts Ray here.
        num_workers: number of jobs at a time if Ray is started here; None is one for each core.
        tasks_per_gpu: how many share a GPU, if they train on one.

    Raises:
        ConnectionError: if nothing answers at ``address``.
        ImportError: if a machine of the cluster lacks this package, or has another version of it.
    """

    def __init__(
        self, address: str | None = None, num_workers: int | None = None, tasks_per_gpu: int = 1
    ) -> None:
        self._tasks_per_gpu = tasks_per_gpu
        if address is None:
            ray.init(
                num_cpus=num_workers,
                include_dashboard=False,
                log_to_driver=False,
                logging_level=logging.ERROR,
            )
        else:
            _check_answer(address)
            ray.init(address, log_to_driver=False, logging_level=logging.ERROR)
        try:
            _check_machines()
        except BaseException:
            self.close()
            raise

    def run(
        self, work: Callable[[Work, Path], object], tasks: Sequence[Work], folder: Path
    ) -> Iterator[Work]:
        """Do ``work(task, folder)`` for all tasks, and yield each task once it is done.

        A task gets as many cores as its ``env.num_threads``, as far as a machine has them, and with ``device=cuda`` its
        share of a GPU. If its worker dies, it is tried again, three times; then its runs are recorded as failed.

        Raises:
            RuntimeError: if Ray itself fails, or a run can be neither begun nor recorded, which is not the run's own
                failure.
        """
        most = max(int(node["Resources"].get("CPU", 1)) for node in ray.nodes())
        # All tasks of a stage have the same device and as many threads.
        told = tasks[0].jobs[0].overrides if tasks else []
        cpus, gpus = resources(told, self._tasks_per_gpu, most)
        remote = ray.remote(num_cpus=cpus, num_gpus=gpus, max_retries=3)(work)
        waiting = {remote.remote(task, folder): task for task in tasks}
        while waiting:
            (ready,), _ = ray.wait(list(waiting), num_returns=1)
            task = waiting.pop(ready)
            try:
                ray.get(ready)
            except (WorkerCrashedError, OutOfMemoryError) as error:
                for job in task.jobs:
                    if Ending.read(folder / job.name) is None:  # it may have died after its work was done
                        Ending("failed", _reason(error)).write(folder / job.name)
            except RayError as error:
                raise RuntimeError(
                    f"{folder}: the {'run' if len(task.jobs) == 1 else 'pack'} {task.name} is not finished: "
                    f"{_reason(error)}. Start the same command again: what was finished is kept."
                ) from error
            yield task

    def close(self) -> None:
        """End the workers of this machine, or leave the cluster."""
        ray.shutdown()


def resources(overrides: Sequence[str], tasks_per_gpu: int, most_cpus: int) -> tuple[int, float]:
    """How many cores and GPUs Ray is to reserve for a task.

    Args:
        overrides: of a run, as on a command line.
        tasks_per_gpu: how many share a GPU.
        most_cpus: that a machine has.
    """
    told = dict(word.split("=", 1) for word in overrides if "=" in word)
    threads = told.get("env.num_threads", "1")
    on_gpu = told.get("device", "cpu").startswith("cuda")
    cpus = max(1, min(int(threads), most_cpus)) if threads.isdigit() else 1
    return cpus, 1 / tasks_per_gpu if on_gpu else 0.0


def _reason(error: RayError) -> str:
    cause = error.cause if isinstance(error, RayTaskError) else error
    return f"{type(cause).__name__}: {shortened(cause)}"


def _check_answer(address: str) -> None:
    if address == "auto":
        return  # Ray itself says at once if there is none
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        socket.create_connection((host, int(port)), timeout=ANSWER).close()
    except (OSError, ValueError) as error:
        raise ConnectionError(
            f"no Ray cluster answers at ray_address={address}: {shortened(error)}."
        ) from error


def _check_machines() -> None:
    """Check that every machine has this package, with a function that does not need the package itself."""

    def installed() -> str | None:
        from importlib.metadata import PackageNotFoundError, version

        try:
            return version("nht")
        except PackageNotFoundError:
            return None

    look = ray.remote(num_cpus=0)(installed)
    nodes = [node for node in ray.nodes() if node["Alive"]]
    found = ray.get(
        [
            look.options(
                scheduling_strategy=NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            ).remote()
            for node in nodes
        ]
    )
    for node, there in zip(nodes, found, strict=True):
        if there != version("nht"):
            has = "has no nht" if there is None else f"has nht {there}"
            raise ImportError(
                f"{node['NodeManagerHostname']} {has}, this machine has {version('nht')}: install the same there "
                "(pip install 'nht[search]'), then start again. What was finished is kept."
            )
