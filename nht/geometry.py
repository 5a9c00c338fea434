"""Householder geometry: from tangent vectors to an orthonormal frame, as pure functions of tensors.

And least squares, for bases that are not orthonormal.

Equation numbers are those of "Contextual Subspace Approximation with Neural Householder Transforms".
With k unit vectors v_1 ... v_k in R^n, Q = H(v_1) ... H(v_k) is an orthogonal n x n matrix (Eq.
8) and its first k columns are the basis (Eq. 7). No function here forms an n x n matrix: a reflection costs
one dot product and one addition.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

# On the CPU, not compiled, from so many reflectors on and up to so large a batch, all reflections at once are 1.2 to
# 1.8 times as fast as one by one, for k calls take longer than their arithmetic. Elsewhere one by one is the fastest
# of all that are exact to 1e-6, up to 10 times ahead: benchmarks/speed/householder.py.
MANY_REFLECTORS, SMALL_BATCH = 12, 8


def sphere_exp(tangent: Tensor) -> Tensor:
    """Exponential map of the unit sphere at e_1 (Eq. 10, footnote 2): v = [cos r, (sin r / r) xi], r = |xi|.

    Args:
        tangent: xi, (*batch, n - 1), of any length.

    Returns:
        Unit vectors, (*batch, n). Exact, with the right first and second derivatives, at xi = 0 too.
    """
    squared = tangent.square().sum(-1, keepdim=True)
    # A root has no derivative at 0, so take none below eps, where sin(r) / r and its slope no longer change ...
    clamped = squared.clamp_min(torch.finfo(tangent.dtype).eps ** 2)
    length = clamped.sqrt()
    # ... and give the cosine its parabola back: nothing in value, the whole slope and curvature at 0.
    cosine = length.cos() - (squared - clamped) / 2
    return torch.cat([cosine, tangent * (length.sin() / length)], dim=-1)


def sphere_log(point: Tensor) -> Tensor:
    """The tangent that ``sphere_exp`` turns into a unit vector: (*batch, n) -> (*batch, n - 1); 0 for -e_1, too."""
    height, side = point[..., :1], point[..., 1:]
    length = torch.linalg.vector_norm(side, dim=-1, keepdim=True)
    angle = torch.atan2(length, height)
    return side * torch.where(length > 0, angle / length.clamp_min(torch.finfo(point.dtype).tiny), 1)


def reflect(reflectors: Tensor, vector: Tensor) -> Tensor:
    """Apply H(v_1) ... H(v_k), where H(v) = I - 2 v v^T (Eq. 8, 9).

    One by one, or, where that is faster (many reflectors, small batch), all at once: the same but for rounding.

    Args:
        reflectors: unit vectors v_1 ... v_k, (*batch, k, n).
        vector: (*batch, n).

    Returns:
        (*batch, n). With ``reflectors.flip(-2)`` the inverse, for every reflection is its own.
    """
    if _calls_outweigh_arithmetic(reflectors):
        return _reflect_at_once(reflectors, vector)
    for reflector in reversed(reflectors.unbind(-2)):
        along = (reflector * vector).sum(-1, keepdim=True)
        vector = torch.addcmul(vector, reflector, along, value=-2)
    return vector


def _calls_outweigh_arithmetic(reflectors: Tensor) -> bool:
    # Compilers fuse the calls. They are asked about first, for the batch that they see may be symbolic.
    return (
        reflectors.shape[-2] >= MANY_REFLECTORS
        and not torch.compiler.is_compiling()
        and reflectors.shape[:-2].numel() <= SMALL_BATCH
        and reflectors.is_cpu
    )


def _reflect_at_once(reflectors: Tensor, vector: Tensor) -> Tensor:
    """Compact WY form: H(v_1) ... H(v_k) = I - 2 V^T T V, row i of V being v_i, with T^-1 = I + 2 striu(V V^T).

    In double precision, for T magnifies the roundings of V V^T: beyond 1e-6 in single. So half precision works too.
    """
    rows, row = reflectors.double(), vector.double().unsqueeze(-2)
    doubled = 2 * rows
    # Transposed, for the row vector. Only the entries under the diagonal of the first product are read.
    along = torch.linalg.solve_triangular(
        rows @ doubled.mT, row @ doubled.mT, upper=False, left=False, unitriangular=True
    )
    return (row - along @ rows).squeeze(-2).to(vector.dtype)


def householder_apply(reflectors: Tensor, action: Tensor) -> Tensor:
    """Actuation u = Q [a; 0], the basis times the action: (*batch, k, n), (*batch, k) -> (*batch, n)."""
    missing = reflectors.shape[-1] - action.shape[-1]
    return reflect(reflectors, functional.pad(action, (0, missing)))


def householder_coordinates(reflectors: Tensor, actuation: Tensor) -> Tensor:
    """All n coordinates Q^T u of an actuation: (*batch, k, n), (*batch, n) -> (*batch, n).

    The first k are the action a* of Eq. 5. The others are what the basis misses: their squared length is
    |u - Q a*|^2, the error of Eq. 6.
    """
    return reflect(reflectors.flip(-2), actuation)


def householder_frame(reflectors: Tensor) -> Tensor:
    """The basis itself, the first k columns of Q (Eq. 7), to look at: (*batch, k, n) -> (*batch, n, k)."""
    action_dim, actuation_dim = reflectors.shape[-2:]
    columns = torch.eye(action_dim, actuation_dim, dtype=reflectors.dtype, device=reflectors.device)
    return reflect(reflectors.unsqueeze(-3), columns).mT


def spanning_reflectors(frame: Tensor) -> Tensor:
    """Unit vectors v_1 ... v_k whose basis (Eq. 7) has the columns of a given frame, but for their signs.

    H(v) with v along x - y takes a unit vector x to y. So v_1 takes e_1 to the first column; v_2, which is orthogonal
    to e_1 and so leaves it alone, takes e_2 to what v_1 makes of the second column; and so on.

    Args:
        frame: (n, k), orthonormal columns.

    Returns:
        (k, n). Their first entries are not negative: ``sphere_exp`` reaches them within half a turn.
    """
    columns = frame.clone()
    reflectors = []
    for index in range(frame.shape[-1]):
        column = columns[:, index]
        sign = 1.0 if column[index] >= 0 else -1.0  # away from cancellation
        reflector = sign * column
        reflector[index] += 1
        reflector = reflector / torch.linalg.vector_norm(reflector)
        columns = columns - 2 * torch.outer(reflector, reflector @ columns)
        reflectors.append(reflector)
    return torch.stack(reflectors)


def principal_directions(actuation: Tensor, count: int) -> Tensor:
    """The leading right singular vectors, each with its largest entry positive: (T, n) -> (n, count), in float64."""
    few = len(actuation) < actuation.shape[-1]
    rows = torch.linalg.svd(actuation.double(), full_matrices=few).Vh[:count]
    largest = rows.gather(1, rows.abs().argmax(1, keepdim=True))
    return (rows * largest.sign()).mT


def least_squares(basis: Tensor, actuation: Tensor) -> Tensor:
    """The action whose actuation is nearest (Eq. 5), for any basis: (*batch, n, k), (*batch, n) -> (*batch, k).

    Damped by a few roundings of the basis's largest entry: exact to rounding where the columns are clearly
    independent, and finite, in value and gradient, where they are not. What a rank-deficient basis leaves
    open gets about the smallest action.
    """
    if basis.dtype in (torch.float16, torch.bfloat16):  # the damping would count there
        return least_squares(basis.float(), actuation.float()).to(basis.dtype)
    rounding = torch.finfo(basis.dtype).eps
    # Of unit size, lest squaring overflow. A basis below rounding counts as none.
    size = basis.detach().abs().amax((-2, -1), keepdim=True).clamp_min(rounding)
    columns = basis / size
    damping = columns.shape[-2] * columns.shape[-1] * rounding
    identity = torch.eye(columns.shape[-1], dtype=basis.dtype, device=basis.device)
    gram = columns.mT @ columns + damping * identity
    action = torch.linalg.solve_ex(gram, columns.mT @ actuation.unsqueeze(-1)).result
    return (action / size).squeeze(-1)


def solve(matrix: Tensor, right: Tensor) -> Tensor:
    """X of A X = B, unchecked: in single precision where they are of half, for which PyTorch solves no equations."""
    working = torch.promote_types(matrix.dtype, torch.float32)
    return torch.linalg.solve_ex(matrix.to(working), right.to(working)).result.to(matrix.dtype)
