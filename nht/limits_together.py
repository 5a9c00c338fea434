"""The Lipschitz limits of several maps, kept after each step in few calls."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nht.lipschitz import LipschitzProjection


class LimitsTogether:
    """What ``LipschitzProjection.step`` does to each of several maps.

    The directions of all matrices are rows of one table, filled up with zeros, which change no norm: only the products
    with a matrix are a call each.

    Args:
        limits: of the maps, on one device.
    """

    def __init__(self, limits: Sequence[LipschitzProjection]) -> None:
        networks = [network for limit in limits for network in limit.networks]
        self._apart = [network for network in networks if network.frobenius]
        self._followed = [network for network in networks if not network.frobenius]
        self._products: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor]] = []
        if self._followed:
            self._lay_out()

    def _lay_out(self) -> None:
        weights = [
            (network, layer, network.network.linear(layer).weight.detach())
            for network in self._followed
            for layer in range(len(network.limits))
        ]
        self._weights = [weight for _, _, weight in weights]
        like, count = self._weights[0], len(weights)
        widest, tallest = (max(weight.shape[side] for weight in self._weights) for side in (1, 0))
        self._limits = torch.tensor([network.limits[layer] for network, layer, _ in weights]).to(like)
        self._directions, self._moves = like.new_zeros(count, widest), like.new_zeros(count, widest)
        self._images = like.new_zeros(count, tallest)
        self._matrices, self._divisions = [], []
        for network, layer, weight in weights:
            matrix, std = weight, network.network.context_std
            if layer == 0 and bool((std != 1).any()):  # as it acts on the raw context
                matrix = torch.empty_like(weight)
                self._divisions.append((weight, std, matrix))
            self._matrices.append(matrix)
        shares = list(zip(self._matrices, self._directions, self._images, self._moves, strict=True))
        self._products = [
            (m, m.mT, d[: m.shape[1], None], i[: m.shape[0], None], r[: m.shape[1], None]) for m, d, i, r in shares
        ]
        self.follow()

    def follow(self) -> None:
        """After ``LipschitzProjection.exact``: go on from the directions that it found."""
        found = [direction for network in self._followed for direction in network.directions]
        for direction, (_, _, own, _, _) in zip(found, self._products, strict=True):
            own.copy_(direction)

    @torch.no_grad()
    def step(self) -> None:
        """After an optimiser step."""
        for network in self._apart:
            network.step()
        if not self._followed:
            return
        for weight, std, matrix in self._divisions:
            torch.div(weight, std, out=matrix)
        for matrix, turned, direction, image, move in self._products:
            torch.mm(matrix, direction, out=image)
            torch.mm(turned, image, out=move)
        length = torch.linalg.vector_norm(self._moves, dim=1, keepdim=True)
        # A matrix of zeros, as the last one is at the start, has no direction to follow yet.
        self._directions.copy_(torch.where(length > 0, self._moves / length.clamp_min(1e-12), self._directions))
        for matrix, _, direction, image, _ in self._products:
            torch.mm(matrix, direction, out=image)
        factors = (self._limits / torch.linalg.vector_norm(self._images, dim=1)).clamp_max(1)
        for weight, factor, less in zip(self._weights, factors, self._shortened(factors), strict=True):
            if less:
                weight.mul_(factor)

    @staticmethod
    def _shortened(factors: Tensor) -> list[bool]:
        """Which matrices have to be scaled; where asking would halt a device, all, as a factor of 1 does nothing."""
        return (factors != 1).tolist() if factors.is_cpu else len(factors) * [True]
