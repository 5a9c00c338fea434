"""A map of one's own: a basis for each side of a plane."""

import torch
from torch import nn

import nht


class TwoSided(nht.LinearActionMap):
    """One basis where the first entry of the context is positive, another where it is not."""

    def __init__(self, context_dim: int, actuation_dim: int, action_dim: int, size: float = 1.0) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        self.network_gain = torch.inf  # it jumps: there is no Lipschitz constant to certify
        self.size = size
        self.bases = nn.Parameter(size * torch.eye(actuation_dim, action_dim).repeat(2, 1, 1))

    def basis(self, context: torch.Tensor) -> torch.Tensor:
        """The basis of the side, (*batch, n, k)."""
        return self.bases[(context[..., 0] > 0).long()]
