"""A trained basis, turned so that its axes point where a person expects them to.

Training decides which subspace a basis spans; the signs of its axes and their rotation within the subspace are
arbitrary. A policy does not mind, but a person with a joystick does. A constant orthogonal matrix, found after
training, puts it right.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor

from nht.maps import ActionMap, LinearActionMap

UNDETERMINED = 1e-5  # singular values below this share of the contexts' mean agreement are rounding
ORTHOGONAL = 1e-5  # the largest entry of R^T R - I that still counts as rounding


class Aligned(LinearActionMap):
    """Another map with its axes turned or mirrored: u = u0(c) + Q(c) R a, with one orthogonal R for all contexts.

    What the map spans, its offset, its projection error, its orthonormal columns, its certificate: none of them
    changes, for R changes no length. ``action_scale`` is taken over, too, although the largest entry of the turned
    actions may be up to sqrt(k) times larger or smaller.

    There is nothing to learn: wrap a trained map, or let ``align`` do so. Its context keys, bounds and fingerprint are
    taken over.

    Args:
        map: the map that is turned; it is kept, not copied.
        rotation: R, (k, k), orthogonal: a rotation, a reflection, or flipped signs. Default: the identity.

    Raises:
        TypeError: if ``map`` is no linear map, or aligned already.
        ValueError: if ``rotation`` is not an orthogonal matrix of k rows.
    """

    learns = False
    rotation: Tensor

    def __init__(self, map: LinearActionMap, rotation: Tensor | None = None) -> None:
        if isinstance(map, Aligned) or not isinstance(map, LinearActionMap):
            raise TypeError(f"map must be a linear action map, not yet aligned, got {type(map).__name__}.")
        super().__init__(map.context_dim, map.actuation_dim, map.action_dim)
        rotation = torch.eye(map.action_dim) if rotation is None else rotation.detach().clone()
        _check_orthogonal(rotation, map.action_dim)
        self.map = map
        self.register_buffer("rotation", rotation)
        self.take_over(map)

    def basis(self, context: Tensor) -> Tensor:
        """Q(c) R."""
        return self.map.basis(context) @ self.rotation

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """u0(c) + Q(c) R a."""
        return self.map(action @ self.rotation.mT, context)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The action of the map inside, turned back."""
        return self.map.project(actuation, context) @ self.rotation

    def basis_norm(self) -> float:
        """The norm of the wrapped map's basis: R changes no length."""
        return self.map.basis_norm()

    def rest(self, context: Tensor) -> Tensor:
        """The rest of the wrapped map."""
        return self.map.rest(context)

    def fit(self, batch: TensorDictBase) -> bool:
        """Always raise: training the basis would undo the alignment.

        Raises:
            ValueError: always.
        """
        raise ValueError(f"an Aligned learns nothing: train its {type(self.map).__name__}, then align that.")

    def init_args(self) -> dict[str, ActionMap]:
        """The map inside; R is a buffer and comes with the weights."""
        return {"map": self.map}


@torch.no_grad()
def align(map: ActionMap, directions: Tensor, context: Tensor, *, jacobian: Tensor | None = None) -> Aligned:
    """Turn the axes of a trained map towards given directions: orthogonal Procrustes.

    R is the orthogonal matrix (a rotation, possibly with reflections) that minimises the mean over the contexts of
    |Q(c) R - D(c)|^2, the sum of squared entries. With the Jacobian of a tool, it minimises that of |J(c) Q(c) R -
    D(c)|^2: action axis i then moves the tool along the i-th direction, as far as the map can. The lengths of the
    directions weigh the axes and the contexts against each other.

    Args:
        map: any linear map. One that is aligned already is aligned anew.
        directions: D, one column per action axis: (n, k) actuations or, with a Jacobian, (m, k) velocities of the
            tool; or one such matrix per context, (T, n, k) or (T, m, k).
        context: where they shall agree: a reference context, (context_dim,), or many, (T, context_dim), to agree on
            average, say those of the demonstrations.
        jacobian: J, velocity of the tool per actuation, (m, n) or (T, m, n).

    Returns:
        The map inside an ``Aligned``.

    Raises:
        TypeError: if the map is not linear in the action.
        ValueError: on shapes that do not fit, or on directions that leave some rotation of the axes open: they hardly
            agree with what the map spans, are not independent, or cancel between the contexts.
    """
    inner = map.map if isinstance(map, Aligned) else map
    if not isinstance(inner, LinearActionMap):
        raise TypeError(
            f"only a map that is linear in the action has axes to turn, got {type(map).__name__}."
        )
    _check_shapes(inner, directions, context, jacobian)
    basis = inner.basis(context).double()
    wanted = directions.to(basis)
    if jacobian is not None:
        wanted = jacobian.to(basis).mT @ wanted  # tr((J Q R)^T D) = tr((Q R)^T J^T D)
    agreement = (basis.mT @ wanted).reshape(-1, inner.action_dim, inner.action_dim)
    left, singular, right = torch.linalg.svd(agreement.mean(0))
    size = torch.linalg.matrix_norm(agreement, ord=2).mean()
    rank = int((singular > UNDETERMINED * size).sum())
    if rank < inner.action_dim:
        raise ValueError(
            f"the directions determine {rank} of the {inner.action_dim} axes: they must be independent, within what "
            "the map can do, and not cancel between the contexts."
        )
    return Aligned(inner, left @ right)


def _check_orthogonal(rotation: Tensor, size: int) -> None:
    if rotation.shape != (size, size):
        raise ValueError(f"rotation must have shape ({size}, {size}), got {tuple(rotation.shape)}.")
    gap = (rotation.double().mT @ rotation.double() - torch.eye(size).to(rotation.device)).abs().max()
    if not gap <= ORTHOGONAL:
        raise ValueError(f"rotation must be orthogonal, but an entry of R^T R - I is {float(gap):.2g}.")


def _check_shapes(map: LinearActionMap, directions: Tensor, context: Tensor, jacobian: Tensor | None) -> None:
    n, k = map.actuation_dim, map.action_dim
    if context.ndim not in (1, 2) or context.shape[-1] != map.context_dim or not context.shape[:-1].numel():
        raise ValueError(
            f"context must be ({map.context_dim},) or (T, {map.context_dim}), got {tuple(context.shape)}."
        )
    rows = n
    leading = [(), context.shape[:-1]]
    if jacobian is not None:
        if jacobian.ndim < 2 or jacobian.shape[-1] != n or jacobian.shape[:-2] not in leading:
            raise ValueError(
                f"jacobian must be (m, {n}), or one such matrix per context, got {tuple(jacobian.shape)} "
                f"for contexts {tuple(context.shape)}."
            )
        rows = jacobian.shape[-2]
    if directions.shape[-2:] != (rows, k) or directions.shape[:-2] not in leading:
        raise ValueError(
            f"directions must be ({rows}, {k}), or one such matrix per context, got {tuple(directions.shape)} "
            f"for contexts {tuple(context.shape)}."
        )
