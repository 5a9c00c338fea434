"""The raw context: recorded before other transforms can rewrite the observation that it is part of."""

from collections.abc import Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn
from torchrl.data import Composite, Unbounded
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Compose, Transform, VecGymEnvTransform


class ContextSnapshot(Transform):
    """Writes the raw context, entries of the observation side by side, under a key of its own.

    `ActionMapTransform` has one, and puts it in front of the transforms that come before it.

    Args:
        context_keys: entries of the observation, (*batch, width) each, in the order of concatenation.
        context_key: where the snapshot goes, (*batch, context_dim).
        dtype: of the snapshot.
    """

    def __init__(
        self, context_keys: Sequence[NestedKey], context_key: NestedKey, dtype: torch.dtype = torch.float32
    ) -> None:
        super().__init__(in_keys=list(context_keys), out_keys=[context_key])
        self.dtype = dtype

    def read(self, tensordict: TensorDictBase) -> Tensor:
        """The context in raw observations, (*batch, context_dim).

        Always a copy, for environments may reuse the buffers that they hand out.
        """
        return torch.cat([tensordict[key] for key in self._in_keys], -1).to(self.dtype)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(self._out_keys[0], self.read(next_tensordict))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def put_in_front(self, front: Compose | None, ahead: list[Transform], may_place: bool) -> bool:
        """Has the context recorded before any transform ahead of ours can rewrite the observation.

        Args:
            front: the outermost Compose around our transform.
            ahead: all that run before our transform; a copy of this snapshot may be among them.
            may_place: whether one may be put in front of them.

        Returns:
            Whether one is ahead now. If not, nothing comes before our transform that rewrites observations.
        """
        # VecGymEnvTransform is a part of TorchRL's vectorised Gym environments: raw is what it leaves.
        placed = [isinstance(t, ContextSnapshot) and t.out_keys == self.out_keys for t in ahead]
        others = [not isinstance(t, ContextSnapshot | VecGymEnvTransform) for t in ahead]
        if front is None or not any(others):
            return any(placed)
        first = others.index(True)
        if any(placed[:first]):
            return True
        if any(placed) or not may_place:
            raise ValueError(
                f"{type(ahead[first]).__name__} was put in front of the transform that records the raw context: "
                "put it behind, or build the chain anew"
            )
        chain = list(front.transforms)
        copied = self.clone()
        chain.insert(1 if isinstance(chain[0], VecGymEnvTransform) else 0, copied)
        front.transforms = nn.ModuleList(chain)  # a new list, for the old one may just be iterated over
        copied.set_container(front)
        return True

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Registers the snapshot: collectors drop what is not in the specs."""
        shapes = [observation_spec[key].shape for key in self.in_keys]
        shape = (*shapes[0][:-1], sum(shape[-1] for shape in shapes))
        observation_spec[self.out_keys[0]] = Unbounded(
            shape, dtype=self.dtype, device=observation_spec.device
        )
        return observation_spec


def surroundings(
    transform: Transform,
) -> tuple[TransformedEnv | None, Compose | None, list[Transform]]:
    """The environment, the outermost Compose around the transform and, flat, all transforms that run before it.

    `Transform.parent` would copy all of these, and fails where a nested Compose comes first.
    """
    front: Compose | None = None
    ahead: list[Transform] = []
    inner = transform
    while (container := inner.__dict__["_container"]) is not None:
        outer = container()
        if not isinstance(outer, Compose):
            return outer, front, ahead
        siblings = list(outer.transforms)
        ahead[:0] = [leaf for sibling in siblings[: siblings.index(inner)] for leaf in _leaves(sibling)]
        front = inner = outer
    return None, front, ahead


def _leaves(transform: Transform) -> list[Transform]:
    if not isinstance(transform, Compose):
        return [transform]
    return [leaf for child in transform.transforms for leaf in _leaves(child)]


def transformed_spec(spec: Composite, ahead: list[Transform], kind: Literal["input", "output"]) -> Composite:
    """The environment's input or output spec, as the transforms ahead leave it."""
    spec = spec.clone()
    for transform in ahead:
        change = transform.transform_input_spec if kind == "input" else transform.transform_output_spec
        spec = change(spec)
    return spec


def check_context(
    observation_spec: Composite, keys: Sequence[NestedKey], lead: torch.Size, context_dim: int
) -> None:
    """Every key is there, of floats, of shape (*lead, width), and the widths add up to the map's context."""
    available = list(observation_spec.keys(True, True))
    for key in keys:
        if key not in available:
            raise KeyError(f"the environment has no context key {key!r}; it has {available}")
        spec = observation_spec[key]
        if not spec.dtype.is_floating_point:
            raise TypeError(f"context key {key!r} must be of floats, got {spec.dtype}")
        if not spec.shape or spec.shape[:-1] != lead:
            raise ValueError(
                f"context key {key!r} must have the shape ({', '.join(map(str, [*lead, 'width']))}), "
                f"as the actuation has, got {tuple(spec.shape)}"
            )
    widths = {key: observation_spec[key].shape[-1] for key in keys}
    if sum(widths.values()) != context_dim:
        sizes = ", ".join(f"{key!r}: {width}" for key, width in widths.items())
        raise ValueError(
            f"the map's context has {context_dim} entries, the context keys {sum(widths.values())} ({sizes})"
        )


def check_writers(ahead: list[Transform], keys: Sequence[NestedKey], made: set[NestedKey]) -> None:
    """No transform ahead rewrites a context entry that another one, or the environment, made."""
    for key in keys:
        writers = [transform for transform in ahead if key in transform.out_keys]
        if len(writers) > (key in made):
            raise ValueError(
                f"{type(writers[-1]).__name__} rewrites context key {key!r}: put the ActionMapTransform in front of it"
            )
