"""TorchRL transforms that put an action map between a policy and an environment."""

from nht.transforms.action_map import ActionMapTransform
from nht.transforms.context import ContextSnapshot

__all__ = ["ActionMapTransform", "ContextSnapshot"]
