"""The private parts of PyTorch that the recipes rely on; tests fail by name when an upgrade breaks one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor


def lerp_all(values: Sequence[Tensor], ends: Sequence[Tensor], weight: float) -> None:
    """Move each of many tensors towards its end, in place, in one call: ``torch._foreach_lerp_``."""
    torch._foreach_lerp_(list(values), list(ends), weight)


def layout_versions(state: Mapping[Any, Any]) -> Any:
    """The versions of their layouts that modules put beside a state dictionary, in ``_metadata``; None without."""
    return getattr(state, "_metadata", None)


def set_layout_versions(state: dict[Any, Any], versions: Any) -> None:
    """Put them there again: ``load_state_dict`` looks at ``_metadata``."""
    state._metadata = versions  # type: ignore[attr-defined]
