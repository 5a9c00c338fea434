"""The private parts of TorchRL that the recipes rely on; tests fail by name when an upgrade breaks one."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.collectors import BaseCollector, Collector, MultiAsyncCollector
from torchrl.objectives import SoftUpdate


class FirstComeCollector(MultiAsyncCollector):
    """``MultiAsyncCollector`` that tells from which worker the latest batch came.

    Relies on ``_get_from_queue``, which gives a worker's number first.

    Attributes:
        latest: number of that worker.
    """

    latest = 0

    def _get_from_queue(self, timeout: float | None = None) -> Any:
        received = super()._get_from_queue(timeout)
        self.latest = received[0]
        return received


def counted_frames(collector: BaseCollector) -> int:
    """How many steps a collector has counted, by which it ends its random ones: ``_frames``."""
    return int(collector._frames)


def count_frames_from(collector: BaseCollector, frames: int) -> None:
    """Let a collector go on counting from ``frames``."""
    collector._frames = frames


def carrier(collector: Collector) -> TensorDictBase:
    """What the next step of a collector starts from, observation and state of the exploration: ``_carrier``."""
    found: TensorDictBase = collector._carrier
    return found


def ended_workers(collector: BaseCollector) -> dict[int, int]:
    """The workers of a parallel collector that have ended, by number, with their exit codes.

    Relies on ``procs``, the workers' processes in order; TorchRL closes the others of one that it finds dead.
    """
    ended = {}
    for number, process in enumerate(collector.procs):
        with contextlib.suppress(ValueError):  # a closed one
            if not process.is_alive():
                ended[number] = process.exitcode
    return ended


def kill_workers(collector: BaseCollector) -> None:
    """End all workers of a parallel collector at once: ``procs``."""
    for process in collector.procs:
        with contextlib.suppress(ValueError):
            process.kill()


def followed_pairs(updater: SoftUpdate) -> Iterator[tuple[Tensor, Tensor]]:
    """The leaves that target networks follow, each with its target: ``_sources`` and ``_targets``."""
    for name in updater._sources.keys():  # noqa: SIM118 - a TensorDict iterates over its rows
        sources = updater._sources[name].values(True, True)
        targets = updater._targets[f"target_{name}"].values(True, True)
        yield from zip(sources, targets, strict=True)
