"""Put an action map between policy and environment: the policy acts in k dimensions, n motors move."""

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform, VecGymEnvTransform

from nht import ActionMap, load_map


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

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Registers the snapshot: collectors drop what is not in the specs."""
        shapes = [observation_spec[key].shape for key in self.in_keys]
        shape = (*shapes[0][:-1], sum(shape[-1] for shape in shapes))
        observation_spec[self.out_keys[0]] = Unbounded(
            shape, dtype=self.dtype, device=observation_spec.device
        )
        return observation_spec


class ActionMapTransform(Transform):
    """The policy gives an action in [-1, 1]^k, the environment executes the actuation that the map makes of it.

        actuation = clip(map(action_scale * action, context), the environment's own action spec)

    The map sees the raw context, that of `env.base_env`, wherever this transform stands among others. TorchRL
    inverts actions only after all transforms have rewritten the observation; a copy of the raw context therefore
    travels in the tensordict. Where other transforms come before this one, a `ContextSnapshot` that takes the copy
    is put in front of them when the environment is attached. What transforms add to an observation is not raw: to
    take it for context, wrap the transformed environment once more, with `auto_unwrap=False`.

    Three entries stand in the data, registered in the specs:

    - `action_key`, (*batch, k): the policy's action, as it gave it.
    - `context_key`, (*batch, context_dim): the raw context. Left out if the map's `context_dim` is 0.
    - `executed_key`, (*batch, n): under "next", the actuation that the environment got in this step; at the root,
      hence, that of the step before, and zero after a reset.

    Where the environment's action spec is unbounded, or where there is no environment, nothing is clipped. Policies
    see the map's dtype, environments that of their own spec. The map is copied, frozen and kept in eval mode;
    nothing that depends on the course of an episode stays in this module.

    `forward` is the way back, for replay buffers and demonstrations: it reads `actuation_key` and the context keys,
    and writes project(actuation, context) / action_scale to `action_key`, not clipped. As `ReplayBuffer.extend`
    calls `inv`, a buffer that is written to needs an instance with `forward_only=True`, whose `inv` does nothing.

    Args:
        map: any action map.
        context_keys: entries of the raw observation whose concatenation is the context. Defaults to those that the
            map was trained on. A nested key stands in a list, `[("arm", "joint_angle")]`: a tuple is several keys.
        action_scale: what 1 stands for, in the map's own units. Defaults to the map's: the largest entry among the
            actions of its demonstrations.
        action_key: the policy's action.
        actuation_key: the environment's own action; in a replay buffer, the recorded actuation.
        context_key: the copy of the context.
        executed_key: the executed actuation.
        forward_only: for replay buffers. To attach such an instance to an environment is an error.

    Raises:
        TypeError: if `map` is no ActionMap; on attaching, if a context entry or the actuation is not of floats.
        ValueError: on an `action_scale` that is not positive and finite, on context keys that are missing or in
            another order than the map's, on keys that collide; on attaching, if the width of context or actuation
            is not the map's, or if the environment has entries of its own under our keys.
        KeyError: on attaching, if the environment lacks a context key or the actuation key.
    """

    invertible = True
    map: ActionMap
    action_scale: Tensor
    _low: Tensor | None
    _high: Tensor | None
    _executed_spec: Unbounded
    _context_shape: tuple[int, ...]

    def __init__(
        self,
        map: ActionMap,
        context_keys: Sequence[NestedKey] | None = None,
        *,
        action_scale: float | None = None,
        action_key: NestedKey = "action",
        actuation_key: NestedKey = "action",
        context_key: NestedKey = "context",
        executed_key: NestedKey = "actuation",
        forward_only: bool = False,
    ) -> None:
        if not isinstance(map, ActionMap):
            raise TypeError(f"map must be an nht.ActionMap, got {type(map).__name__}")
        keys = _resolve_context_keys(map, context_keys)
        action_key, actuation_key = unravel_key(action_key), unravel_key(actuation_key)
        context_key, executed_key = unravel_key(context_key), unravel_key(executed_key)
        if forward_only:
            super().__init__(in_keys=[actuation_key, *keys], out_keys=[action_key])
        else:
            _check_distinct({action_key, actuation_key}, context_key, executed_key)
            out_keys = [context_key, executed_key] if keys else [executed_key]
            super().__init__(keys, out_keys, in_keys_inv=[actuation_key], out_keys_inv=[action_key])
        scale = torch.as_tensor(map.action_scale if action_scale is None else action_scale)
        if scale.ndim or not scale.isfinite() or scale <= 0:
            raise ValueError(f"action_scale must be a positive, finite number, got {scale.tolist()}")
        self.map = copy.deepcopy(map).requires_grad_(False).eval()
        self.register_buffer("action_scale", scale.detach().to(map.action_scale, copy=True))
        # The bounds belong to the environment: found on attaching, not saved.
        self.register_buffer("_low", None, persistent=False)
        self.register_buffer("_high", None, persistent=False)
        self.snapshot = ContextSnapshot(keys, context_key, self.dtype) if keys else None
        self.action_key, self.actuation_key = action_key, actuation_key
        self.context_key, self.executed_key = context_key, executed_key
        self.forward_only = forward_only
        self._takes_snapshot = bool(keys)

    @classmethod
    def from_file(cls, path: str | Path, **kwargs: Any) -> "ActionMapTransform":
        """A transform around the map in a file of `nht.save_map`; keyword arguments are the constructor's."""
        return cls(load_map(path), **kwargs)

    @property
    def dtype(self) -> torch.dtype:
        """Of the map, hence of actions and context."""
        return self.action_scale.dtype

    def train(self, mode: bool = True) -> "ActionMapTransform":
        """Sets the mode of this module, not that of the map."""
        super().train(mode)
        self.map.eval()
        return self

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Actuation to action, in data with the raw observation at the root."""
        actuation = tensordict[self.actuation_key].to(self.dtype)
        context = actuation[..., :0] if self.snapshot is None else self.snapshot.read(tensordict)
        return tensordict.set(self.action_key, self.map.project(actuation, context) / self.action_scale)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.forward_only:
            return tensordict
        scale = self.action_scale
        action = tensordict[self.action_key].to(scale.dtype) * scale
        context = action[..., :0] if self.snapshot is None else tensordict.get(self.context_key)
        if context is None:
            raise KeyError(f"no {self.context_key!r} beside the action: pass on what reset or step returned")
        actuation = self.map(action, context)
        low = self._low
        if low is not None:
            actuation = actuation.to(low.dtype).clamp(low, self._high)
        return tensordict.set(self.actuation_key, actuation)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._record(next_tensordict)
        return next_tensordict.set(self.executed_key, tensordict.get(self.actuation_key))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._record(tensordict_reset)
        idle = self._executed_spec.zero(tensordict_reset.batch_size)
        return tensordict_reset.set(self.executed_key, idle)

    def _record(self, observed: TensorDictBase) -> None:
        if self._takes_snapshot and self.snapshot is not None:
            self.snapshot._call(observed)

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attaches the transform to an environment, or to a Compose that may be attached to one already."""
        super().set_container(container)
        self._attach(may_place=True)

    def transform_action_spec(self, action_spec: Composite) -> Composite:
        """The environment's actuation gives way to the policy's action."""
        self._attach()  # again, for transforms may have been inserted since
        actuation_spec = action_spec[self.actuation_key]
        del action_spec[self.actuation_key]
        action_spec[self.action_key] = Bounded(
            -1.0,
            1.0,
            shape=(*actuation_spec.shape[:-1], self.map.action_dim),
            dtype=self.dtype,
            device=actuation_spec.device,
        )
        return action_spec

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Registers what is added to the data: collectors drop what is not in the specs."""
        self._attach()
        device = observation_spec.device
        if self.snapshot is not None:
            observation_spec[self.context_key] = Unbounded(
                self._context_shape, dtype=self.dtype, device=device
            )
        executed_spec = self._executed_spec.to(device) if device is not None else self._executed_spec
        observation_spec[self.executed_key] = executed_spec.expand(
            *observation_spec.shape, *executed_spec.shape
        )
        return observation_spec

    def __repr__(self) -> str:
        size = f"{self.map.action_dim} -> {self.map.actuation_dim}"
        keys = [] if self.snapshot is None else self.snapshot.in_keys
        return f"{type(self).__name__}({type(self.map).__name__} {size}, context_keys={keys})"

    def _attach(self, *, may_place: bool = False) -> None:
        """Checks map against environment, if there is one by now, and reads what holds for all steps."""
        parent = self.parent  # the environment with the transforms before this one
        if parent is None:
            return
        self.empty_cache()  # or the parent would be kept, and be pickled with this transform
        if self.forward_only:
            raise ValueError("a forward_only transform is for replay buffers, not for environments")
        base, batch_dims = parent.base_env, len(parent.batch_size)
        actuation_spec = _actuation_spec(parent.full_action_spec, self.actuation_key, self.map.actuation_dim)
        self._low, self._high = _bounds(actuation_spec, batch_dims)
        if self.actuation_key in base.full_action_spec.keys(True, True):
            actuation_spec = base.full_action_spec[self.actuation_key]
        self._executed_spec = Unbounded(
            actuation_spec.shape[batch_dims:], dtype=actuation_spec.dtype, device=actuation_spec.device
        )
        observation_spec = base.full_observation_spec
        if taken := {self.context_key, self.executed_key} & set(observation_spec.keys(True, True)):
            raise ValueError(
                f"the environment has an observation {taken.pop()!r} of its own: choose another "
                "context_key or executed_key"
            )
        if self.snapshot is not None:
            lead = actuation_spec.shape[:-1]
            _check_context(observation_spec, self.snapshot.in_keys, lead, self.map.context_dim)
            self._context_shape = (*lead, self.map.context_dim)
            self._place_snapshot(self.snapshot, may_place)

    def _place_snapshot(self, snapshot: ContextSnapshot, may_place: bool) -> None:
        """Sees to it that the context is recorded before another transform can rewrite the observation."""
        front, ahead = self._chain()
        placed = [isinstance(t, ContextSnapshot) and t.out_keys == snapshot.out_keys for t in ahead]
        others = [not isinstance(t, _READERS) for t in ahead]
        self._takes_snapshot = not any(placed) and not any(others)
        if front is None or not any(others):
            return
        first = others.index(True)
        if any(placed[:first]):
            return
        if any(placed) or not may_place:
            raise ValueError(
                f"{type(ahead[first]).__name__} was put in front of the transform that records the raw context: "
                "put it behind, or build the chain anew"
            )
        chain = list(front.transforms)
        copied = snapshot.clone()
        chain.insert(1 if isinstance(chain[0], VecGymEnvTransform) else 0, copied)
        front.transforms = nn.ModuleList(chain)  # a new list, for the old one may just be iterated over
        copied.set_container(front)

    def _chain(self) -> tuple[Compose | None, list[Transform]]:
        """The outermost Compose around this transform and, flat, all transforms that run before this one."""
        front: Compose | None = None
        ahead: list[Transform] = []
        inner: Transform = self
        while isinstance(outer := inner.__dict__["_container"](), Compose):
            before = outer.transforms[: list(outer.transforms).index(inner)]
            ahead[:0] = [leaf for transform in before for leaf in _leaves(transform)]
            front = inner = outer
        return front, ahead


# These leave the observation as it is; VecGymEnvTransform is a part of TorchRL's vectorised Gym environments.
_READERS = (ContextSnapshot, ActionMapTransform, VecGymEnvTransform)


def _leaves(transform: Transform) -> list[Transform]:
    if not isinstance(transform, Compose):
        return [transform]
    return [leaf for child in transform.transforms for leaf in _leaves(child)]


def _resolve_context_keys(map: ActionMap, given: Sequence[NestedKey] | None) -> list[NestedKey]:
    own = None if map.context_keys is None else [unravel_key(key) for key in map.context_keys]
    if given is None:
        if own is None and map.context_dim:
            raise ValueError(
                f"context_keys must name the entries that make up the map's context of {map.context_dim}: "
                "the map does not know them, as it was not trained on demonstrations"
            )
        return own or []
    keys = [unravel_key(key) for key in ([given] if isinstance(given, str) else given)]
    if own is not None and keys != own and sorted(map(str, keys)) == sorted(map(str, own)):
        raise ValueError(f"the map was trained on context_keys {own}, in this order; got {keys}")
    if bool(keys) != bool(map.context_dim):
        raise ValueError(f"the map's context has {map.context_dim} entries, got context_keys {keys}")
    return keys


def _check_distinct(action_keys: set[NestedKey], context_key: NestedKey, executed_key: NestedKey) -> None:
    if context_key == executed_key or {context_key, executed_key} & action_keys:
        raise ValueError(
            f"context_key {context_key!r} and executed_key {executed_key!r} must differ from each other and "
            f"from the action's keys, {', '.join(sorted(map(repr, action_keys)))}"
        )


def _actuation_spec(action_spec: Composite, key: NestedKey, actuation_dim: int) -> TensorSpec:
    keys = list(action_spec.keys(True, True))
    if key not in keys:
        raise KeyError(f"the environment has no action {key!r}; it has {keys}")
    spec = action_spec[key]
    if not isinstance(spec.space, ContinuousBox) or not spec.dtype.is_floating_point:
        raise TypeError(
            f"the environment's action {key!r} is not continuous: {type(spec).__name__} of {spec.dtype}"
        )
    if not spec.shape or spec.shape[-1] != actuation_dim:
        raise ValueError(
            f"the map drives {actuation_dim} actuators, "
            f"the environment's action {key!r} has the shape {tuple(spec.shape)}"
        )
    return spec


def _bounds(spec: TensorSpec, batch_dims: int) -> tuple[Tensor, Tensor]:
    """Low and high, infinite if there are none: one copy's, or, if the copies' bounds differ, those of all."""
    if isinstance(spec, Unbounded):
        high = torch.full(spec.shape[batch_dims:], torch.inf, dtype=spec.dtype, device=spec.device)
        return -high, high
    low, high = spec.space.low, spec.space.high
    first = (0,) * batch_dims
    if low.equal(low[first].expand_as(low)) and high.equal(high[first].expand_as(high)):
        low, high = low[first], high[first]  # these fit any batch, such as that of a masked step
    return low.clone(), high.clone()


def _check_context(
    observation_spec: Composite, keys: Sequence[NestedKey], lead: torch.Size, context_dim: int
) -> None:
    """Every key is there, of floats, of shape (*lead, width), and the widths add up to the map's context."""
    available = list(observation_spec.keys(True, True))
    for key in keys:
        if key not in available:
            raise KeyError(
                f"the environment's raw observation has no context key {key!r}; it has {available}"
            )
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
