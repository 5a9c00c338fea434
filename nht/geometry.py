"""Householder geometry: from tangent vectors to an orthonormal frame, as pure functions of tensors.

Equation numbers are those of "Contextual Subspace Approximation with Neural Householder Transforms" (ICLR 2023).
With k unit vectors v_1 ... v_k in R^n, Q = H(v_1) ... H(v_k) is an orthogonal n x n matrix (Eq. 8) and its first k
columns are the basis (Eq. 7). No function here forms an n x n matrix: a reflection costs a dot product and an addition.
"""

import torch
from torch import Tensor
from torch.nn import functional


def sphere_exp(tangent: Tensor) -> Tensor:
    """Exponential map of the unit sphere at e_1 (Eq. 10 and its footnote): v = [cos r, (sin r / r) xi], r = |xi|.

    Args:
        tangent: xi, (*batch, n - 1), any length.

    Returns:
        Unit vectors, (*batch, n). Exact, with the right first and second derivatives, at xi = 0 too.
    """
    squared = tangent.square().sum(-1, keepdim=True)
    # The root has no derivative at 0. Below a length of eps both sinc and its derivative are those at eps, to rounding.
    half = squared.clamp_min(torch.finfo(tangent.dtype).eps ** 2).sqrt() / 2
    sinc_half = half.sin() / half
    # Through the half angle, cos r = 1 - 2 sin^2(r/2) and sin r = 2 sin(r/2) cos(r/2), the clamp costs no curvature.
    return torch.cat([1 - squared / 2 * sinc_half.square(), tangent * (sinc_half * half.cos())], dim=-1)


def reflect(reflectors: Tensor, vector: Tensor) -> Tensor:
    """H(v_1) ... H(v_k) x with H(v) = I - 2 v v^T (Eq. 8, 9).

    Args:
        reflectors: unit vectors v_1 ... v_k, (*batch, k, n).
        vector: x, (*batch, n).

    Returns:
        (*batch, n), as long as x. With `reflectors.flip(-2)` it is the inverse, for a reflection is its own.
    """
    for reflector in reversed(reflectors.unbind(-2)):
        along = (reflector * vector).sum(-1, keepdim=True)
        vector = torch.addcmul(vector, reflector, along, value=-2)
    return vector


def householder_apply(reflectors: Tensor, action: Tensor) -> Tensor:
    """u = Q [a; 0], the basis times an action (Eq. 7): (*batch, k, n), (*batch, k) -> (*batch, n)."""
    actuation_dim, action_dim = reflectors.shape[-1], action.shape[-1]
    return reflect(reflectors, functional.pad(action, (0, actuation_dim - action_dim)))


def householder_coordinates(reflectors: Tensor, actuation: Tensor) -> Tensor:
    """Q^T u: (*batch, k, n), (*batch, n) -> (*batch, n).

    The first k entries are the action a* of Eq. 5; the other n - k are what the basis misses, so that their squared
    length is |u - Q Q^T u|^2, the error of Eq. 6.
    """
    return reflect(reflectors.flip(-2), actuation)


def householder_frame(reflectors: Tensor) -> Tensor:
    """The basis itself, the first k columns of Q (Eq. 7): (*batch, k, n) -> (*batch, n, k). For looking and for tests."""
    action_dim, actuation_dim = reflectors.shape[-2:]
    columns = torch.eye(action_dim, actuation_dim, dtype=reflectors.dtype, device=reflectors.device)
    return reflect(reflectors.unsqueeze(-3), columns).mT
