"""How long the gradients were, read from what Adam keeps of them: that costs an update nothing."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nht.recipes.run.metrics import gradient_norm


class GradientNorms:
    """The root mean square of the gradient's length over about the last ``1 / (1 - beta2)`` updates, a thousand.

    Adam (Kingma & Ba 2015) keeps the moving average v of each squared entry g^2. Without its bias, v / (1 - beta2^t),
    the sum over all entries is the moving average of ||g||^2. Clipped gradients count as clipped.

    Args:
        optimiser: an Adam.
        networks: a name for each of its groups of parameters; none, if it has one group.
        learners: number of learners whose parameters ``(L, ...)`` are stacked, if several.
    """

    def __init__(self, optimiser: torch.optim.Adam, *networks: str, learners: int | None = None) -> None:
        self._optimiser, self._learners = optimiser, learners
        self.names = tuple(map(gradient_norm, networks or ("",)))
        if len(self.names) != len(optimiser.param_groups):
            raise ValueError(
                f"the optimiser has {len(optimiser.param_groups)} groups, got the names {list(networks)}."
            )

    def __call__(self) -> list[dict[str, float]]:
        """The lengths for every learner, by column; NaN before the first update."""
        rows: list[dict[str, float]] = [{} for _ in range(self._learners or 1)]
        for name, group in zip(self.names, self._optimiser.param_groups, strict=True):
            for row, value in zip(rows, self._of(group).tolist(), strict=True):
                row[name] = value
        return rows

    def _of(self, group: dict[str, Any]) -> Tensor:
        unbiased = []
        for weight in group["params"]:
            state = self._optimiser.state.get(weight, {})
            if "exp_avg_sq" not in state:
                continue
            squares = state["exp_avg_sq"].double()
            summed = squares.sum().reshape(1) if self._learners is None else squares.flatten(1).sum(1)
            unbiased.append(summed / (1 - group["betas"][1] ** state["step"].double().to(summed.device)))
        if not unbiased:
            return torch.full((self._learners or 1,), torch.nan)
        return torch.stack(unbiased).sum(0).sqrt()
