"""Lipschitz constants of linear and affine action maps: a limit kept in training, and a certificate afterwards.

A layer s(W x + b) has the constant m |W|, with |W| the spectral norm of its matrix and m the largest slope of
the activation. The constants of a composition multiply. From the network's output to the basis the map's
``network_gain`` comes on top, 2 sqrt(k) for NHT (Theorem 1 of the paper, A.3), 1 for SCL. The normaliser, which divides
the context by its deviations, is counted with the first layer, so that every statement is about the raw
context. Heads side by side have the constant of the largest.

What this says of actuations, and of what ``decode`` makes of them at the motors' limits, is in
``nht.actuation_lipschitz``.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from nht.alignment import Aligned
from nht.maps import ActionMap, LinearActionMap
from nht.networks import ACTIVATION_SLOPES, ContextNetwork
from nht.offset import LinearOffset, NetworkOffset
from nht.residual import Residual

ROUNDING = 1e-6  # a limit is undercut by this share, lest rounding a scaled matrix to float32 exceed it


@torch.no_grad()
def certificate(map: ActionMap) -> float:
    """A proven Lipschitz constant of the basis: |Q(c) - Q(c')| <= certificate |c - c'| for all raw contexts.

    The matrix norm is the spectral one, computed exactly and in float64. It holds for any weights, whether
    training kept to a limit or not.

    Returns:
        The constant of the wrapped map for a Residual, whose corrections do not depend on the context, and for an
        Aligned, whose rotation changes no norm. 0 for a basis that ignores the context; infinity where none is known,
        as for a map that is not linear in the action.
    """
    if isinstance(map, Aligned | Residual):
        return certificate(map.map)
    if not isinstance(map, LinearActionMap):
        return math.inf
    if map.network is None:
        return map.network_gain
    return map.network_gain * _constant(map.network)


@torch.no_grad()
def offset_certificate(map: ActionMap) -> float:
    """A proven Lipschitz constant of the offset: |u0(c) - u0(c')| <= offset_certificate |c - c'| for all raw contexts.

    Returns:
        0 for a map without an offset, or with a constant one; infinity where none is known.
    """
    if isinstance(map, Aligned | Residual):
        return offset_certificate(map.map)
    if not isinstance(map, LinearActionMap):
        return math.inf
    model = map.offset_model
    if isinstance(model, LinearOffset):
        return float(torch.linalg.matrix_norm(model.slope.double(), ord=2))
    return _constant(model.network) if isinstance(model, NetworkOffset) else 0.0


class LipschitzProjection:
    """Keeps a map within its ``lipschitz`` limit by scaling down its layers (Gouk et al., 2018).

    The limit is that of Q(c), and that of u0(c) where a network gives it: u0 counts like one more column, whose action
    is always 1. Actuations of actions up to M then have the constant lipschitz (M + 1).

    Raises:
        ValueError: if the map has no network or no limit.
    """

    def __init__(self, map: LinearActionMap) -> None:
        if map.network is None or map.lipschitz is None:
            raise ValueError(
                f"{type(map).__name__} has no network to limit, or no limit: lipschitz={map.lipschitz}."
            )
        frobenius = map.lipschitz_norm == "frobenius"
        self.networks = [
            NetworkProjection(map.network, map.lipschitz / map.network_gain, frobenius=frobenius)
        ]
        if isinstance(map.offset_model, NetworkOffset):
            self.networks.append(
                NetworkProjection(map.offset_model.network, map.lipschitz, frobenius=frobenius)
            )

    @property
    def limits(self) -> list[float]:
        """The largest norm that each layer's matrix in the basis's network may have."""
        return self.networks[0].limits

    def step(self) -> None:
        """After an optimiser step."""
        for network in self.networks:
            network.step()

    def exact(self) -> None:
        """Call it before weights are kept: then ``certificate`` and ``offset_certificate`` are at most the limit."""
        for network in self.networks:
            network.exact()


class NetworkProjection:
    """Keeps a network within a Lipschitz constant.

    Each layer may have the constant limit^(1 / layers). The exact spectral norm is too expensive for every step:
    ``step`` estimates it by one power iteration, which continues the last one and may be a little low; ``exact``
    computes it. The Frobenius norm, never smaller than the spectral one, is exact in both.

    Args:
        network: whose layers are scaled.
        limit: of the network, from raw contexts to its output.
        frobenius: limit the Frobenius norm of the matrices instead of the spectral norm.
    """

    def __init__(self, network: ContextNetwork, limit: float, *, frobenius: bool) -> None:
        self.network, self.frobenius = network, frobenius
        slopes = _slopes(network)
        per_layer = limit ** (1 / len(slopes)) * (1 - ROUNDING)
        self.limits = [per_layer / slope for slope in slopes]
        self.directions: list[
            Tensor
        ] = []  # of each matrix, close to its leading right singular vector, a column
        self.exact()

    @torch.no_grad()
    def step(self) -> None:
        """After an optimiser step."""
        for i, matrix in enumerate(_matrices(self.network)):
            if self.frobenius:
                norm = torch.linalg.matrix_norm(matrix, keepdim=True)
            else:
                image = matrix.mT @ (matrix @ self.directions[i])
                # A matrix of zeros, as the last one is at the start, has no direction to follow yet.
                moved = torch.linalg.vector_norm(image, dim=-2, keepdim=True) > 0
                self.directions[i] = torch.where(
                    moved, functional.normalize(image, dim=-2), self.directions[i]
                )
                norm = torch.linalg.vector_norm(matrix @ self.directions[i], dim=-2, keepdim=True)
            self._scale(i, norm)

    @torch.no_grad()
    def exact(self) -> None:
        """Before weights are kept. Weights that are not finite, which nobody will keep, stay as they are."""
        matrices = _matrices(self.network)
        if not all(bool(matrix.isfinite().all()) for matrix in matrices):
            return
        self.directions = []
        for i, matrix in enumerate(matrices):
            _, singular, right = torch.linalg.svd(matrix.double(), full_matrices=False)
            self.directions.append(right[..., :1, :].mT.to(matrix.dtype))
            norm = torch.linalg.vector_norm(singular, dim=-1) if self.frobenius else singular[..., 0]
            self._scale(i, norm[..., None, None])

    def _scale(self, index: int, norm: Tensor) -> None:
        self.network.linear(index).weight.mul_((self.limits[index] / norm).clamp_max(1))


def _constant(network: ContextNetwork) -> float:
    """A Lipschitz constant from raw contexts to the output: the product of those of layers and activations."""
    norms = [torch.linalg.matrix_norm(matrix.double(), ord=2).max() for matrix in _matrices(network)]
    return math.prod(_slopes(network)) * math.prod(float(norm) for norm in norms)


def _matrices(network: ContextNetwork) -> list[Tensor]:
    """The matrix of each layer, or of each head of it; the first acts on the raw context."""
    weights = [network.linear(i).weight for i in range(len(network.layers))]
    return [weights[0] / network.context_std, *weights[1:]]


def _slopes(network: ContextNetwork) -> list[float]:
    """The largest slope of the activation after each layer; 1 after the last, which has none."""
    return [ACTIVATION_SLOPES[network.activation]] * (len(network.layers) - 1) + [1.0]
