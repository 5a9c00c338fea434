"""Action maps that are linear in the action, or affine: u = u0(c) + Q(c) a."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import Literal, get_args

import torch
from torch import Tensor

from nht.action_map import ActionMap
from nht.geometry import least_squares
from nht.networks import ContextNetwork, check_choice
from nht.offset import NetworkOffset, Offset

NormKind = Literal["spectral", "frobenius"]


class LinearActionMap(ActionMap):
    """An action map that is linear in the action, u = Q(c) a; or affine, u = u0(c) + Q(c) a.

    Args:
        context_dim: width of the context.
        actuation_dim: n.
        action_dim: k, in 1 ... n.
        lipschitz: Lipschitz constant that training keeps to, of Q(c) and, apart from it, of u0(c).
        lipschitz_norm: which norm of the layers' matrices is limited for it.

    Attributes:
        network: what turns the context into a description of the basis; None if the basis is always the same.
        network_gain: a Lipschitz constant, in the spectral norm, from the network's output to the basis; without
            a network, from the context to the basis.
        offset_model: gives u0(c); None for u0 = 0.
        lipschitz: as given; None for no limit.
        lipschitz_norm: as given.
    """

    network: ContextNetwork | None
    offset_model: Offset | None

    def __init__(
        self,
        context_dim: int,
        actuation_dim: int,
        action_dim: int,
        lipschitz: float | None = None,
        lipschitz_norm: NormKind = "spectral",
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        if lipschitz is not None and not 0 < lipschitz < torch.inf:
            raise ValueError(f"lipschitz must be a positive number or None, got {lipschitz}.")
        check_choice("lipschitz_norm", lipschitz_norm, get_args(NormKind))
        self.network = None
        self.network_gain = 0.0
        self.offset_model = None
        self.lipschitz = lipschitz
        self.lipschitz_norm = lipschitz_norm

    @abstractmethod
    def basis(self, context: Tensor) -> Tensor:
        """Q(c): (*batch, context_dim) -> (*batch, n, k)."""

    def basis_norm(self) -> float:
        """A bound on the spectral norm of Q(c), for all contexts; infinity where none is known."""
        return math.inf

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """u0(c) + Q(c) a."""
        return self.from_rest((self.basis(context) @ action.unsqueeze(-1)).squeeze(-1), context)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Least squares: the action whose actuation is nearest (Eq. 5), of u - u0(c)."""
        return least_squares(self.basis(context), self.to_rest(actuation, context))

    def rest(self, context: Tensor) -> Tensor:
        """u0(c), the actuation at action 0, (*batch, n)."""
        return super().rest(context) if self.offset_model is None else self.offset_model(context)

    def from_rest(self, way: Tensor, context: Tensor) -> Tensor:
        """The actuation u0(c) + way, (*batch, n)."""
        return way if self.offset_model is None else self.offset_model(context) + way

    def to_rest(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The way from rest to an actuation, u - u0(c), (*batch, n)."""
        return actuation if self.offset_model is None else actuation - self.offset_model(context)

    def offset_losses(self, way: Tensor) -> Tensor | float:
        """An extra loss term that trains a contextual u0: it has the gradient of |u - u0(c)|^2 and the value 0.

        The loss leaves u0 open within the span of Q(c), where an action has the same effect. The conditional mean of
        the actuations, given the context, is an optimal u0 outside the span, whatever Q(c) is; within the span, it
        makes the mean action 0.

        Args:
            way: u - u0(c), (batch, n).

        Returns:
            That of each transition, (batch,).
        """
        if not isinstance(self.offset_model, NetworkOffset):
            return 0.0
        pull = way.square().sum(-1)
        return pull - pull.detach()
