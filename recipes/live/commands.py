"""What the people at all pads ask for: the last one who moved is heard."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Hashable, Sequence

import torch
from torch import Tensor

HOLD = 0.5
"""Seconds for which a hand counts as on the pad after its last motion to zero: a policy then waits that long."""


class Commands:
    """The latest action that was asked for, from any thread.

    Args:
        action_dim: number of action axes k.

    Attributes:
        on_reached: called with who asked and the stamp of what was asked for, when the motors get it first.
    """

    def __init__(self, action_dim: int) -> None:
        self._lock = threading.Lock()
        self._held_until = 0.0
        self.on_reached: Callable[[Hashable, float], object] | None = None
        self.resize(action_dim)

    def resize(self, action_dim: int) -> None:
        """Ask for nothing, with another number of axes."""
        with self._lock:
            self._action = torch.zeros(1, action_dim)
            self._source: Hashable = None
            self._fresh: tuple[Hashable, float] | None = None

    @property
    def action_dim(self) -> int:
        """Number of action axes k."""
        return self._action.shape[-1]

    def ask(self, action: Sequence[float], source: Hashable = "", stamp: float = 0.0) -> None:
        """Ask for an action, beyond [-1, 1] clipped. One of another width, or not finite, is of no meaning: left out.

        Args:
            action: k numbers.
            source: who asks.
            stamp: when, by the clock of who asks.
        """
        asked = torch.tensor([list(action)], dtype=torch.float32)
        with self._lock:
            if asked.shape != self._action.shape or not asked.isfinite().all():
                return
            self._action, self._source, self._fresh = asked.clamp(-1.0, 1.0), source, (source, stamp)
            self._held_until = time.monotonic() + HOLD

    def drop(self, source: Hashable) -> None:
        """Forget what ``source`` asked for, who has left."""
        with self._lock:
            if source == self._source:
                self._action = torch.zeros_like(self._action)
                self._source = self._fresh = None

    def latest(self) -> Tensor:
        """The action that is asked for, ``(1, k)``."""
        with self._lock:
            return self._action.clone()

    @property
    def held(self) -> bool:
        """Whether somebody's hand is on a pad, or was a moment ago."""
        with self._lock:
            return bool(self._action.any()) or time.monotonic() < self._held_until

    def reached(self) -> None:
        """Tell who asked that the motors get what was asked for."""
        with self._lock:
            fresh, self._fresh = self._fresh, None
        if fresh is not None and self.on_reached is not None:
            self.on_reached(*fresh)
