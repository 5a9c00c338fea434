"""Action maps that are linear in the action, or affine: u = u0(c) + Q(c) a."""

from __future__ import annotations

from abc import abstractmethod
from typing import Literal, get_args

import torch
from torch import Tensor

from nht.action_map import ActionMap
from nht.geometry import least_squares
from nht.networks import ContextNetwork, check_choice

NormKind = Literal["spectral", "frobenius"]


class LinearActionMap(ActionMap):
    """An action map that is linear in the action: u = Q(c) a.

    Attributes:
        network: what turns the context into a description of the basis; None if the basis is always the same.
        network_gain: a Lipschitz constant, in the spectral norm, from the network's output to the basis; without
            a network, from the context to the basis.
        lipschitz: the Lipschitz constant of Q(c) that training keeps to; None for no limit.
        lipschitz_norm: the norm of the layers' matrices that is limited to this end.
    """

    network: ContextNetwork | None

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
            raise ValueError(f"lipschitz must be a positive number or None, got {lipschitz}")
        check_choice("lipschitz_norm", lipschitz_norm, get_args(NormKind))
        self.network = None
        self.network_gain = 0.0
        self.lipschitz = lipschitz
        self.lipschitz_norm = lipschitz_norm

    @abstractmethod
    def basis(self, context: Tensor) -> Tensor:
        """Q(c): (*batch, context_dim) -> (*batch, n, k)."""

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """Q(c) a."""
        return (self.basis(context) @ action.unsqueeze(-1)).squeeze(-1)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """Least squares: the action whose actuation is nearest (Eq. 5)."""
        return least_squares(self.basis(context), actuation)
