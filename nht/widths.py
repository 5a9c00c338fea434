"""Refuses actions, actuations and contexts of a wrong width, whatever the class of the map.

Without this some maps would silently pad or crop them.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from torch import Tensor


def checked_forward(method: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A map's ``forward`` that first checks the last dimensions of action and context."""

    @functools.wraps(method)
    def forward(self: Any, action: Tensor, context: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        _check(self, "an action", action, self.action_dim)
        _check(self, "a context", context, self.context_dim)
        return method(self, action, context, *args, **kwargs)

    return forward


def checked_project(method: Callable[..., Tensor]) -> Callable[..., Tensor]:
    """A map's ``project`` that first checks the last dimensions of actuation and context."""

    @functools.wraps(method)
    def project(self: Any, actuation: Tensor, context: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        _check(self, "an actuation", actuation, self.actuation_dim)
        _check(self, "a context", context, self.context_dim)
        return method(self, actuation, context, *args, **kwargs)

    return project


def _check(map: Any, what: str, given: Tensor, expected: int) -> None:
    if given.ndim < 1 or given.shape[-1] != expected:
        raise ValueError(
            f"{type(map).__name__} takes {what} of width {expected}, got one of shape {tuple(given.shape)}."
        )
