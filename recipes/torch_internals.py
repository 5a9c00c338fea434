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
    """The layout versions that modules store with a state dictionary, in ``_metadata``; None if there are none."""
    return getattr(state, "_metadata", None)


def set_layout_versions(state: dict[Any, Any], versions: Any) -> None:
    """Store layout versions with a state dictionary again: ``load_state_dict`` reads ``_metadata``."""
    state._metadata = versions  # type: ignore[attr-defined]
