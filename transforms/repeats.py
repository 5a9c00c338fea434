"""Recognises steps that another transform repeats with the same input: they repeat the actuation."""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor


class Repeats:
    """Remembers, in the input of a step, the policy's action and the actuation that replaced it.

    A transform behind the map, such as ``FrameSkipTransform``, may step the environment again with the input of a
    step that was made. Where action and actuation have the same key, the actuation stands there by then, and to map
    that once more would be wrong. The two entries are private, and never part of what a step returns.

    Args:
        action_key: of the policy's action.
        actuation_key: of what is executed.
        name: what distinguishes one map from others in the chain.
    """

    def __init__(self, action_key: NestedKey, actuation_key: NestedKey, name: NestedKey) -> None:
        self.possible = action_key == actuation_key
        suffix = name if isinstance(name, str) else "_".join(name)
        self.given_key, self.executed_key = f"_given_{suffix}", f"_executed_{suffix}"

    def policy_action(self, tensordict: TensorDictBase, found: Tensor) -> Tensor:
        """The policy's action: what the input of a step has, or the remembered one if that was executed before."""
        if not self.possible:
            return found
        executed = tensordict.get(self.executed_key, None)
        action = found
        if executed is not None and _same(executed, found):
            action = tensordict.get(self.given_key)
        tensordict.set(self.given_key, action)
        return action

    def remember(self, tensordict: TensorDictBase, executed: Tensor) -> None:
        """Note what was executed, in the input of the step."""
        if self.possible:
            tensordict.set(self.executed_key, executed)


def _same(left: Tensor, right: Tensor) -> bool:
    """Whether these are one tensor, or copies."""
    return left is right or (
        left.shape == right.shape and left.dtype == right.dtype and torch.equal(left, right)
    )
