"""The Lipschitz limits of several maps, kept after each step in few calls."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from nht.lipschitz import LipschitzProjection


class LimitsTogether:
    """What ``LipschitzProjection.step`` does to each of several maps.

    Products and norms are a call each, of the shape that they have alone; what is done to directions is done to those
    of all matrices at once, in a table whose rows are filled up with zeros.

    Args:
        limits: of the maps, on one device.
    """

    def __init__(self, limits: Sequence[LipschitzProjection]) -> None:
        networks = [network for limit in limits for network in limit.networks]
        self._apart = [network for network in networks if network.frobenius]
        self._followed = [network for network in networks if not network.frobenius]
        self._products: list[tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]] = []
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
        limits = [network.limits[layer] for network, layer, _ in weights]
        self._limits = torch.tensor(limits, dtype=like.dtype, device=like.device)
        self._directions, self._moves = like.new_zeros(count, widest), like.new_zeros(count, widest)
        self._images = like.new_zeros(count, tallest)
        self._matrices, self._divisions = [], []
        for network, layer, weight in weights:
            matrix, std = weight, network.network.context_std
            if layer == 0 and bool((std != 1).any()):  # as it acts on the raw context
                matrix = torch.empty_like(weight)
                self._divisions.append((weight, std, matrix))
            self._matrices.append(matrix)
        self._lengths = like.new_zeros(count, 1)
        tables = (self._directions, self._images, self._moves, self._lengths)
        for matrix, direction, image, move, length in zip(self._matrices, *tables, strict=True):
            high, wide = matrix.shape
            columns = direction[:wide, None], image[:high, None], move[:wide, None], length[:, None]
            self._products.append((matrix, matrix.mT, *columns))
        self.follow()

    def follow(self) -> None:
        """After ``LipschitzProjection.exact``: go on from the directions that it found."""
        found = [direction for network in self._followed for direction in network.directions]
        for direction, (_, _, own, *_) in zip(found, self._products, strict=True):
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
        for matrix, turned, direction, image, move, length in self._products:
            torch.mm(matrix, direction, out=image)
            torch.mm(turned, image, out=move)
            torch.linalg.vector_norm(move, dim=-2, keepdim=True, out=length)
        length = self._lengths
        # A matrix of zeros, as the last one is at the start, has no direction to follow yet.
        self._directions.copy_(
            torch.where(length > 0, self._moves / length.clamp_min(1e-12), self._directions)
        )
        for matrix, _, direction, image, _, length in self._products:
            torch.mm(matrix, direction, out=image)
            torch.linalg.vector_norm(image, dim=-2, keepdim=True, out=length)
        # A number over a tensor is rounded twice, too.
        factors = (self._lengths.squeeze(1).reciprocal() * self._limits).clamp_max(1)
        for weight, factor, less in zip(self._weights, factors, self._shortened(factors), strict=True):
            if less:
                weight.mul_(factor)

    @staticmethod
    def _shortened(factors: Tensor) -> list[bool]:
        """Which matrices have to be scaled; where asking would halt a device, all, as a factor of 1 does nothing."""
        return (factors != 1).tolist() if factors.is_cpu else len(factors) * [True]
