"""Lipschitz constants of linear action maps: a limit kept in training, and a certificate afterwards.

A layer x -> s(W x + b), where the slope of s is at most m, has the constant m |W|, |W| the spectral norm. Constants
of a composition multiply; the step from the network's output to the basis adds `network_gain`, 2 sqrt(k) for NHT
(Theorem 1 of the paper). The normaliser divides the context by its deviations: it is counted with the first layer.
"""

import math

import torch
from torch import Tensor, nn

from nht.maps import ACTIVATION_SLOPES, ActionMap, ContextNetwork, LinearActionMap, NormKind

ROUNDING = 1e-6  # a limit is undercut by this share, lest rounding the scaled weights to float32 exceed it


@torch.no_grad()
def certificate(map: ActionMap) -> float:
    """A proven Lipschitz constant of the basis: |Q(c) - Q(c')| <= certificate * |c - c'| for all raw contexts.

    Spectral norms are exact, in float64. It holds for any weights, trained with a limit or not.

    Returns:
        0 for a basis that ignores the context; infinity for a map that has no basis (not linear in the action).
    """
    if not isinstance(map, LinearActionMap):
        return math.inf
    if map.network is None:
        return 0.0
    layers = range(len(map.network.layers))
    return map.network_gain * math.prod(
        _slope(map.network, i) * float(_norm(_weight(map.network, i), "spectral")) for i in layers
    )


class LipschitzProjection:
    """Keeps a map within its `lipschitz` limit by scaling layers down, as Gouk et al. (2018) do.

    Each layer may have the constant (L / network_gain)^(1 / layers), so that the whole has L. Exact spectral norms
    are too dear for every step: `step` follows them by one round of power iteration, warm-started and therefore close
    but, for a moment, possibly a little low; `exact` leaves nothing to chance. With "frobenius" both are exact.
    """

    def __init__(self, map: LinearActionMap) -> None:
        if map.network is None or map.lipschitz is None:
            raise ValueError(
                f"{type(map).__name__} has no network or no limit to keep: lipschitz={map.lipschitz}"
            )
        self.network = map.network
        self.kind: NormKind = map.lipschitz_norm
        per_layer = (map.lipschitz / map.network_gain) ** (1 / len(self.network.layers))
        self.limits = [per_layer / _slope(self.network, i) for i in range(len(self.network.layers))]
        self.directions: list[Tensor] = []
        self.exact()

    @torch.no_grad()
    def step(self) -> None:
        """After an optimiser step."""
        for i, limit in enumerate(self.limits):
            weight = _weight(self.network, i)
            if self.kind == "spectral":
                left = weight @ self.directions[i]
                self.directions[i] = nn.functional.normalize(weight.mT @ left, dim=0)
                norm = torch.linalg.vector_norm(weight @ self.directions[i])
            else:
                norm = _norm(weight, self.kind)
            self._scale(i, norm, limit)

    @torch.no_grad()
    def exact(self) -> None:
        """Before weights are kept: afterwards `certificate(map) <= map.lipschitz`."""
        self.directions = []
        for i, limit in enumerate(self.limits):
            weight = _weight(self.network, i).double()
            self._scale(i, _norm(weight, self.kind), limit)
            leading = torch.linalg.svd(weight, full_matrices=False).Vh[0]
            self.directions.append(leading.to(self.network.layers[i].weight.dtype))

    def _scale(self, index: int, norm: Tensor, limit: float) -> None:
        self.network.layers[index].weight.mul_((limit * (1 - ROUNDING) / norm).clamp_max(1))


def _weight(network: ContextNetwork, index: int) -> Tensor:
    """A layer's matrix; the first one's as it acts on the raw context."""
    weight = network.layers[index].weight
    return weight / network.context_std if index == 0 else weight


def _slope(network: ContextNetwork, index: int) -> float:
    """The largest slope of what follows a layer: nothing follows the last one."""
    return 1.0 if index == len(network.layers) - 1 else ACTIVATION_SLOPES[network.activation]


def _norm(weight: Tensor, kind: NormKind) -> Tensor:
    return torch.linalg.matrix_norm(weight.double(), ord=2 if kind == "spectral" else "fro")
