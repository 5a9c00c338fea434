"""Lipschitz constants of actuations (Eq. 22), within the motors' limits and at them.

Let L be the certificate of Q(c), L0 that of u0(c), and M the largest |a|. Unlimited actuations obey

    |u(c) - u(c')| <= (L M + L0) |c - c'|.

``clip`` brings no two actuations further apart: the statement holds as it is.

``scale`` draws the actuation r + d towards the rest r, onto the box K of the limits: f(r, d) = r + d / max(1, p).
Here p is the gauge of K seen from r, the largest of |d_i| / room_i. Where motor i alone is at its limit, both
derivatives are, but for a factor 1 / p <= 1 of that in d, the oblique projection I - x e_i^T / x_i, with x = d / p on
the facet i of K, |x_i| = room_i. Its norm is |x| / room_i. So

    |f(c) - f(c')| <= S (L M + L0) |c - c'|,   S = max over facets i of  max |x| / room_i,

with |x| <= |d| too. S is 1 if no action reaches a limit, sqrt(n) at most for a symmetric cube around the rest, the
ratio of the box's long half diagonal to its shortest room in general; and without bound where the rest may touch a
limit. The cut that is left to do where a rest lies beyond a limit changes nothing then, as S is infinite.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from nht.action_map import ActionMap
from nht.alignment import Aligned
from nht.linear_map import LinearActionMap
from nht.lipschitz import certificate, offset_certificate
from nht.offset import ConstantOffset, NetworkOffset
from nht.residual import Residual

BOUNDED = ("sigmoid", "tanh")  # activations within [-1, 1]


@torch.no_grad()
def actuation_certificate(
    map: ActionMap,
    largest_action: float | None = None,
    low: Tensor | None = None,
    high: Tensor | None = None,
) -> float:
    """A proven Lipschitz constant of actuations (Eq. 22): |u(c) - u(c')| <= it times |c - c'| for the same action.

    It is that of ``decode`` with these limits and the map's saturation; without limits, that of the map itself.

    Args:
        map: any action map.
        largest_action: M, the largest Euclidean norm of an action in the map's own units. Default: that of a corner of
            the policy's box, action_scale sqrt(k).
        low: the smallest actuations that the motors take, (n,); None, or -infinity, where there is no limit.
        high: the largest ones, likewise.

    Returns:
        Infinity where no constant is known: for a map that is not linear in the action; with ``scale``, if the rest is
        not known to stay within the limits in all contexts.

    Raises:
        ValueError: if ``largest_action`` is negative or NaN.
    """
    if largest_action is None:
        largest_action = float(map.action_scale) * math.sqrt(map.action_dim)
    if not largest_action >= 0:
        raise ValueError(f"largest_action must be a number of 0 or more, got {largest_action}.")
    turning = certificate(map)
    constant = (turning * largest_action if turning else 0.0) + offset_certificate(map)
    if map.saturation == "clip" or (low is None and high is None) or not constant < math.inf:
        return constant
    return constant * _stretch(map, largest_action, low, high)


def _stretch(map: ActionMap, largest_action: float, low: Tensor | None, high: Tensor | None) -> float:
    """S: the largest factor by which scaling into the limits can increase the distance between two actuations."""
    least, most = _rest_range(map)
    unlimited = torch.full((map.actuation_dim,), torch.inf, dtype=torch.float64)
    up = unlimited if high is None else torch.as_tensor(high).double().cpu().expand(map.actuation_dim)
    down = -unlimited if low is None else torch.as_tensor(low).double().cpu().expand(map.actuation_dim)
    norm = _basis_norm(map)
    reach = norm * largest_action if largest_action else 0.0  # of |d|
    # A facet is met no closer than ``nearest``; beside it x may be as long as the other motors' largest rooms allow.
    longest = torch.maximum(up - least, most - down).square()
    largest = 1.0
    for nearest in (up - most, least - down):
        for i, room in enumerate(nearest.tolist()):
            if room >= reach:
                continue  # no action gets there
            if room <= 0:
                return math.inf
            others = float(longest.sum() - longest[i]) if longest.isfinite().all() else math.inf
            largest = max(largest, min(math.sqrt(1 + others / room**2), reach / room))
    return largest


def _rest_range(map: ActionMap) -> tuple[Tensor, Tensor]:
    """Bounds of the rest over all contexts, (n,) each."""
    inner = map.map if isinstance(map, Residual) else map
    inner = inner.map if isinstance(inner, Aligned) else inner
    model = inner.offset_model if isinstance(inner, LinearActionMap) else None
    zero = torch.zeros(map.actuation_dim, dtype=torch.float64)
    if model is None:
        return zero, zero
    if isinstance(model, ConstantOffset):
        value = model.value.double().cpu()
        return value, value
    if (
        isinstance(model, NetworkOffset)
        and len(model.network.layers) > 1
        and model.network.activation in BOUNDED
    ):
        last = model.network.linear(-1)
        centre, radius = last.bias.double().cpu(), last.weight.double().cpu().abs().sum(-1)
        return centre - radius, centre + radius
    return zero - torch.inf, zero + torch.inf


def _basis_norm(map: ActionMap) -> float:
    """A bound on |Q(c)|; for a Residual, on the norm of Q(c) with the columns of its corrections appended."""
    if isinstance(map, Residual):
        return math.hypot(_basis_norm(map.map), map.scale)
    return map.basis_norm() if isinstance(map, LinearActionMap) else math.inf
