"""A TorchRL transform and Gymnasium wrappers that put an action map between a policy and an environment."""

from __future__ import annotations

from nht.transforms.action_map import ActionMapTransform
from nht.transforms.action_map_wrapper import ActionMapVectorWrapper, ActionMapWrapper

__all__ = ["ActionMapTransform", "ActionMapVectorWrapper", "ActionMapWrapper"]
