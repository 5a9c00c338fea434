"""Settings that may differ between the learners of a population."""

from __future__ import annotations

from typing import TypeAlias

from torch import Tensor

Setting: TypeAlias = float | Tensor
"""A number for one learner or for all, or a tensor ``(L,)`` with a number for each of L learners."""


def beside(setting: Setting, values: Tensor) -> Setting:
    """The setting in a shape that broadcasts with values ``(L, *batch)``."""
    return setting.view(-1, *[1] * (values.ndim - 1)) if isinstance(setting, Tensor) else setting


def largest(setting: Setting) -> float:
    """The setting, or its largest value over the learners."""
    return float(setting.max()) if isinstance(setting, Tensor) else setting
