"""The private parts of PyTorch that the recipes rely on; tests fail by name when an upgrade breaks one."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def lerp_all(values: Sequence[Tensor], ends: Sequence[Tensor], weight: float) -> None:
    """Move each of many tensors towards its end, in place, in one call: ``torch._foreach_lerp_``."""
    torch._foreach_lerp_(list(values), list(ends), weight)
