"""The arrays that a row per copy stands in, and what the copies draw from."""

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
"""Of one generator for all copies (None takes a seed that nobody else has), or of several for equal numbers of them."""
