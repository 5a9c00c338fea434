"""What becomes of an actuation beyond the limits of the motors, as pure functions of tensors.

``clip`` cuts motor by motor: every motor does as much as it can of what was asked, and the actuation turns out of what
the map spans. ``scale`` shortens the whole actuation, measured from the map's rest, until it fits: it keeps its
direction, so it stays within what the map spans around its rest.
"""

from __future__ import annotations

from functools import reduce
from typing import Literal

import torch
from torch import Tensor

Saturation = Literal["scale", "clip"]

DEFAULT_SATURATION: Saturation = "clip"
"""What a new map does."""


def saturate(
    actuation: Tensor,
    low: Tensor | None = None,
    high: Tensor | None = None,
    *,
    kind: Saturation,
    rest: Tensor | None = None,
) -> Tensor:
    """The actuation within ``[low, high]``, in the precision of these; as it is, where there are none.

    Args:
        actuation: (*batch, n).
        low: smallest actuations, (n,) or anything that broadcasts; -infinity where there is no limit.
        high: largest ones, likewise.
        kind: ``"scale"`` or ``"clip"``.
        rest: the actuation of no action, from which ``scale`` measures, (*batch, n). None for zero.

    Returns:
        (*batch, n). A row with a NaN keeps it, so that whoever executes it can see that something diverged.

    Raises:
        ValueError: on another ``kind``.
    """
    limits = [limit for limit in (low, high) if limit is not None]
    if not limits:
        return actuation
    actuation = actuation.to(reduce(torch.promote_types, [limit.dtype for limit in limits]))
    if kind == "clip":
        return actuation.clamp(low, high)
    if kind == "scale":
        return scale_into(actuation, low, high, rest)
    raise ValueError(f"saturation must be 'scale' or 'clip', got {kind!r}.")


def scale_into(
    actuation: Tensor, low: Tensor | None, high: Tensor | None, rest: Tensor | None = None
) -> Tensor:
    """``rest + t (actuation - rest)`` with, per row, the largest t in [0, 1] that stays within the limits.

    Where the rest is beyond a limit itself, no t would do: this limit then shortens nothing, and what is left beyond
    it is cut off. Where the rest lies on a limit, nothing moves that would pass it. An infinite actuation counts as
    the largest finite one.

    Args:
        actuation: (*batch, n).
        low: smallest actuations, or None.
        high: largest ones, or None.
        rest: (*batch, n), or None for zero.
    """
    given = actuation.dtype
    # Half precision has no room for the quotients below.
    working = torch.promote_types(given, torch.float32)
    wide = actuation.to(working)
    start = torch.zeros_like(wide) if rest is None else rest.to(working)
    largest = torch.finfo(working).max
    away = (wide - start).clamp(-largest, largest)
    # 1 / t: how often the longest way of a motor exceeds what there is room for.
    excess = torch.ones_like(away[..., :1])
    if high is not None:
        excess = torch.maximum(excess, _excess(away, high.to(working) - start))
    if low is not None:
        excess = torch.maximum(excess, _excess(-away, start - low.to(working)))
    fitting = torch.where(excess == 1, wide, start + away / excess)
    return fitting.to(given).clamp(low, high)


def _excess(way: Tensor, room: Tensor) -> Tensor:
    """The largest way per room for it, (*batch, 1); ways of no or negative length, and negative room, count as 0."""
    least = (
        torch.finfo(room.dtype).tiny ** 0.5
    )  # instead of no room at all, for quotient and slope to stay finite
    share = torch.where(room < 0, torch.zeros_like(room), way / room.clamp_min(least))
    return share.amax(-1, keepdim=True)
