"""The offset u0(c) of an affine map: the actuation at action 0, for robots that do not rest at zero."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, cast, get_args

import torch
from torch import Tensor, nn

from nht.networks import Activation, ContextNetwork, check_choice

OffsetKind = Literal["none", "constant", "contextual"]


class ConstantOffset(nn.Module):
    """The same u0 in every context, a parameter.

    Args:
        actuation_dim: n.
    """

    def __init__(self, actuation_dim: int) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.zeros(actuation_dim))

    def forward(self, context: Tensor) -> Tensor:
        """u0: (*batch, context_dim) -> (*batch, n)."""
        return self.value.expand(*context.shape[:-1], -1)

    @torch.no_grad()
    def fit(self, context: Tensor, actuation: Tensor, *, normalise: bool = False) -> None:
        """Set u0 to the mean of actuations (T, n)."""
        self.value.copy_(actuation.mean(0))


class NetworkOffset(nn.Module):
    """u0(c) from a network of its own.

    Args:
        context_dim: width of the context.
        actuation_dim: n.
        hidden: widths of the hidden layers.
        activation: "relu", "sigmoid" or "tanh".
        seed: of the initial weights.
    """

    def __init__(
        self, context_dim: int, actuation_dim: int, hidden: Sequence[int], activation: Activation, seed: int
    ) -> None:
        super().__init__()
        self.network = ContextNetwork(context_dim, actuation_dim, hidden, activation, seed)
        self.network.start_from(torch.zeros(actuation_dim))

    def forward(self, context: Tensor) -> Tensor:
        """u0(c): (*batch, context_dim) -> (*batch, n)."""
        return cast(Tensor, self.network(context))

    def fit(self, context: Tensor, actuation: Tensor, *, normalise: bool = False) -> None:
        """Set u0 to the mean of actuations (T, n) in every context, and, if asked, the normaliser from contexts."""
        if normalise:
            self.network.normalise(context)
        self.network.start_from(actuation.mean(0))


class LinearOffset(nn.Module):
    """u0(c) = A c + b, in closed form. Nothing here is trained by gradients.

    Args:
        context_dim: width of the context.
        actuation_dim: n.
    """

    slope: Tensor
    value: Tensor

    def __init__(self, context_dim: int, actuation_dim: int) -> None:
        super().__init__()
        self.register_buffer("slope", torch.zeros(actuation_dim, context_dim))
        self.register_buffer("value", torch.zeros(actuation_dim))

    def forward(self, context: Tensor) -> Tensor:
        """u0(c): (*batch, context_dim) -> (*batch, n)."""
        return context @ self.slope.mT + self.value

    @torch.no_grad()
    def fit(self, context: Tensor, actuation: Tensor, *, normalise: bool = False) -> None:
        """Fit A and b by least squares to contexts (T, context_dim) and actuations (T, n)."""
        context, actuation = context.double(), actuation.double()
        centre, mean = context.mean(0), actuation.mean(0)
        slope = (
            torch.linalg.pinv(context - centre) @ (actuation - mean)
        ).mT  # what is left open gets no slope
        self.slope.copy_(slope)
        self.value.copy_(mean - slope @ centre)


Offset = ConstantOffset | NetworkOffset | LinearOffset


def check_offset(kind: str, context_dim: int) -> None:
    """Raise ValueError for an offset that does not exist, or a contextual one without a context."""
    check_choice("offset", kind, get_args(OffsetKind))
    if kind == "contextual" and context_dim < 1:
        raise ValueError(f"offset='contextual' needs a context, got context_dim={context_dim}.")


def trained_offset(
    kind: OffsetKind,
    context_dim: int,
    actuation_dim: int,
    hidden: Sequence[int],
    activation: Activation,
    seed: int,
) -> ConstantOffset | NetworkOffset | None:
    """The offset of a map that is trained by gradients; None for ``"none"``."""
    check_offset(kind, context_dim)
    if kind == "none":
        return None
    if kind == "constant":
        return ConstantOffset(actuation_dim)
    return NetworkOffset(context_dim, actuation_dim, hidden, activation, seed)
