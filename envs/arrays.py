"""Types of a task's arrays, which have a row per copy, and of its seeds."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
Flags: TypeAlias = NDArray[np.bool_]
Rows: TypeAlias = NDArray[np.intp]
"""Indices of copies."""

Seed: TypeAlias = int | Sequence[int] | None
"""One seed for all copies (None takes one from the operating system), or several, each for as many copies."""
