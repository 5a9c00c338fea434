"""Brings actuations within the limits of the motors, as pure functions of tensors.

``clip`` limits each motor on its own: every motor does as much as it can of what was asked, and the actuation leaves
the map's span. ``scale`` shortens the whole actuation, measured from the map's rest, until it fits: it keeps its
direction, so it stays in the map's span around its rest.
"""

from __future__ import annotations

from functools import reduce
from typing import Literal

import torch
from torch import Tensor

Saturation = Literal["scale", "clip"]

DEFAULT_SATURATION: Saturation = "scale"
"""The saturation of a new map with k < n. With k = n nothing can leave the span, and ``clip`` is the default.

Measured (``benchmarks/learning/saturation.py``), three seeds each, one map for both kinds, success at the end: DDPG
through NHT on WAMWipe at an action scale of 4, 1.00, 1.00, 1.00 with ``scale`` and 0.90, 0.62, 0.72 with ``clip``; on
WAMGrasp at 6, 0.22, 0.66, 0.78 and 0.16, 0.10, 0.04. PPO on HalfCheetah, whose motors want to be at their limits, ends
at returns of 6,053 and 6,153: no difference that three seeds could show. In a later study
(``half_cheetah_interfaces.py``, five seeds) NHT ends at 5,335 with ``scale``, L = 0.03, and at 6,760 with ``clip``,
L = 0.3, and in five of seven pairs of trials ``clip`` is ahead.
"""


def saturate(
    actuation: Tensor,
    low: Tensor | None = None,
    high: Tensor | None = None,
    *,
    kind: Saturation,
    rest: Tensor | None = None,
) -> Tensor:
    """The actuation brought within ``[low, high]``, in the precision of the limits; unchanged without limits.

    Args:
        actuation: (*batch, n).
        low: smallest actuations, (n,) or anything that broadcasts; -infinity where there is no limit.
        high: largest ones, likewise.
        kind: ``"scale"`` or ``"clip"``.
        rest: the actuation from which ``scale`` measures, (*batch, n). None for zero.

    Returns:
        (*batch, n). A row with a NaN keeps it, so that divergence is noticed where the actuation is executed.

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

    A limit that the rest itself exceeds does not shorten the actuation; what remains beyond it is clipped. Where the
    rest lies on a limit, an actuation beyond that limit is shortened to the rest. An infinite actuation counts as the
    largest finite one.

    Args:
        actuation: (*batch, n).
        low: smallest actuations, or None.
        high: largest ones, or None.
        rest: (*batch, n), or None for zero.
    """
    given = actuation.dtype
    working = torch.promote_types(given, torch.float32)  # half precision has no room for the quotient below
    wide = actuation.to(working)
    start = torch.zeros_like(wide) if rest is None else rest.to(working)
    largest = torch.finfo(working).max
    way = (wide - start).clamp(-largest, largest)
    above = torch.inf if high is None else high.to(working) - start
    below = torch.inf if low is None else start - low.to(working)
    room = torch.where(way > 0, above, below)
    # 1 / t, how often the way of a motor exceeds its room; instead of no room the least that leaves the slope finite.
    least = torch.finfo(working).tiny ** 0.5
    excess = torch.where(room < 0, 0, way.abs() / room.clamp_min(least)).amax(-1, keepdim=True).clamp_min(1)
    fitting = torch.where(excess == 1, wide, start + way / excess)
    return fitting.to(given).clamp(low, high)
