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
    """A ``MultiAsyncCollector`` that knows which worker the latest batch came from.

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
    """Number of steps that a collector has counted, which decides when its random steps end: ``_frames``."""
    return int(collector._frames)


def count_frames_from(collector: BaseCollector, frames: int) -> None:
    """Set the number of steps that a collector has counted."""
    collector._frames = frames


def carrier(collector: Collector) -> TensorDictBase:
    """The data that a collector's next step starts from, observation and state of the exploration: ``_carrier``."""
    found: TensorDictBase = collector._carrier
    return found


def ended_workers(collector: BaseCollector) -> dict[int, int]:
    """The workers of a parallel collector that have ended, by number, with their exit codes.

    Relies on ``procs``, the workers' processes in order; TorchRL closes the others when it finds one dead.
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
    """Pairs of a parameter and the target parameter that follows it: ``_sources`` and ``_targets``."""
    for name in updater._sources.keys():  # noqa: SIM118 - a TensorDict iterates over its rows
        sources = updater._sources[name].values(True, True)
        targets = updater._targets[f"target_{name}"].values(True, True)
        yield from zip(sources, targets, strict=True)
