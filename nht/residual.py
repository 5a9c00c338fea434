"""Small corrections in all n dimensions, on top of any action map."""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor

from nht.maps import ActionMap


class Residual(ActionMap):
    """Another map's action plus n corrections: u = map(a) + scale r, for an action (a, r) of k + n entries.

    So every actuation can be reached, and those that the map gives are the easiest to find. A correction of 1 adds
    ``scale`` to its motor, in units of actuation; ActionMapTransform multiplies it by ``action_scale``, as all of the
    action.

    There is nothing to learn: wrap a trained map. Its context keys, scale, bounds and fingerprint are taken over.

    Args:
        map: the map that is corrected; it is kept, not copied.
        scale: weight of the corrections. For no corrections, use the map itself.

    Raises:
        TypeError: if ``map`` is no action map, or one with corrections already.
        ValueError: if ``scale`` is not a positive number.
    """

    learns = False

    def __init__(self, map: ActionMap, scale: float) -> None:
        if isinstance(map, Residual) or not isinstance(map, ActionMap):
            raise TypeError(f"map must be an action map without corrections, got {type(map).__name__}.")
        if not 0 < scale < math.inf:
            raise ValueError(
                f"scale must be a positive number, got {scale}; for no corrections, use the map itself."
            )
        super().__init__(map.context_dim, map.actuation_dim, map.action_dim)
        self.action_dim = map.action_dim + map.actuation_dim  # k + n: corrections make it more than n
        self.map = map
        self.scale = scale
        self.take_over(map)

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """map(a) + scale r."""
        interface, correction = action.split([self.map.action_dim, self.actuation_dim], dim=-1)
        return self.map(interface, context) + self.scale * correction

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """The map's own projection, and corrections for what it leaves.

        Mapped back, they give exactly the actuation.
        """
        interface = self.map.project(actuation, context)
        missed = actuation - self.map(interface, context)
        return torch.cat([interface, missed / self.scale], dim=-1)

    def rest(self, context: Tensor) -> Tensor:
        """The rest of the wrapped map."""
        return self.map.rest(context)

    def fit(self, batch: TensorDictBase) -> bool:
        """Always raise: with corrections every map reaches every actuation, so there is nothing to train.

        Raises:
            ValueError: always.
        """
        raise ValueError(
            f"a Residual learns nothing: train its {type(self.map).__name__}, then wrap that in a Residual."
        )
