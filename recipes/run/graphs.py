"""Gradient steps as CUDA graphs: a GPU goes through their many small kernels without waiting for Python."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from tensordict.nn import CudaGraphModule

from nht.recipes.run.ranks import Ranks

Update = Callable[[TensorDictBase], TensorDictBase]


def graphed(ranks: Ranks) -> Callable[[Update], Update]:
    """Decorates an update; on a GPU, with one process, it is recorded when first called and played from then on.

    The update takes a minibatch, whose shape never changes, returns detached tensors, and asks for no tensor's value.

    Args:
        ranks: the processes that learn together. Several exchange gradients, which is not recorded.
    """

    def decorate(update: Update) -> Update:
        if ranks.device.type != "cuda" or ranks.size > 1:
            return update
        return CudaGraphModule(update, in_keys=[], device=ranks.device)

    return decorate
