"""What puts an action map between a policy and an environment: a TorchRL transform, and Gymnasium wrappers."""

from nht.transforms.action_map import ActionMapTransform
from nht.transforms.action_map_wrapper import ActionMapVectorWrapper, ActionMapWrapper
from nht.transforms.context import ContextSnapshot

__all__ = ["ActionMapTransform", "ActionMapVectorWrapper", "ActionMapWrapper", "ContextSnapshot"]
