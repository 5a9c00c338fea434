"""Talks to the workers of a parallel collector, and notices their death wherever TorchRL waits for them."""

from __future__ import annotations

import queue
import signal
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector

from nht.recipes.torchrl_internals import ended_workers, kill_workers

LOOK_EVERY = 0.2
"""Seconds between two checks whether all workers live."""
LAG = 2.0
"""Seconds within which a worker whose pipe has broken is seen to have ended."""


class WorkerEndedError(RuntimeError):
    """A worker of a collector has ended by itself or was killed."""


class Workers:
    """Speaks with the workers of a parallel collector in a thread of its own.

    The death of a worker can leave TorchRL waiting without end: for weights to be acknowledged, for a queue's lock that
    the dead one held, for the rest of a batch. The thread then waits; the caller goes on, with an error.

    Args:
        collector: whose workers. It is to be shut down by the caller.
        device: that the thread computes on.
    """

    def __init__(self, collector: BaseCollector, device: torch.device) -> None:
        self._collector = collector
        self._batches = iter(collector)
        self._calls: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]]] = queue.SimpleQueue()
        threading.Thread(target=self._run, args=(device,), name="workers", daemon=True).start()

    def next(self) -> TensorDictBase:
        """The next batch.

        Raises:
            WorkerEndedError: if a worker has ended; all are killed then.
        """
        batch: TensorDictBase = self._call(lambda: next(self._batches))
        return batch

    def update(self, policy: TensorDictModuleBase) -> None:
        """Send the workers the current policy; raises as ``next`` does."""
        self._call(lambda: self._collector.update_policy_weights_(policy))

    def _call(self, function: Callable[[], Any]) -> Any:
        """What ``function`` returns or raises, unless a worker ends before it does."""
        self._look()
        future: Future[Any] = Future()
        self._calls.put((future, function))
        while not wait([future], timeout=LOOK_EVERY).done:
            self._look()
        if future.exception() is not None:  # of a broken pipe, say: it may be too early to see why
            until = time.monotonic() + LAG
            while time.monotonic() < until:
                self._look()
                time.sleep(LOOK_EVERY)
        return future.result()

    def _look(self) -> None:
        for number, code in ended_workers(self._collector).items():
            kill_workers(self._collector)  # whoever waits for a lock of the dead one would not hear us
            raise WorkerEndedError(f"collector: worker {number} {_how(code)}.")

    def _run(self, device: torch.device) -> None:
        if device.type == "cuda":
            torch.cuda.set_device(device)  # each thread has its own
        while True:
            future, function = self._calls.get()
            try:
                future.set_result(function())
            except BaseException as error:  # noqa: BLE001 - raised again where it is waited for
                future.set_exception(error)


def _how(code: int) -> str:
    if code < 0:
        return f"was killed by {signal.Signals(-code).name}"
    return f"ended with exit code {code}; its own words, if any, stand above"
