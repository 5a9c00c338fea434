"""Put an action map between policy and environment: the policy acts in k dimensions, n motors move."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded
from torchrl.data.tensor_specs import Stacked
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Transform

from nht import ActionMap, load_map
from nht.transforms.arguments import frozen_copy, resolve_action_scale, resolve_context_keys
from nht.transforms.context import (
    ContextSnapshot,
    check_context,
    check_writers,
    surroundings,
    transformed_spec,
)


class ActionMapTransform(Transform):
    """The policy gives an action in [-1, 1]^k, the environment executes the actuation that the map makes of it.

        actuation = clip(map(action_scale * action, context), the environment's own action spec)

    The map sees the raw context, that of `env.base_env`, wherever this transform stands among others. TorchRL
    inverts actions only after all transforms have rewritten the observation; a copy of the raw context therefore
    travels in the tensordict. Where other transforms come before this one, a `ContextSnapshot` that takes the copy
    is put in front of them when the environment is attached. Only if an entry of the context is itself made by a
    transform before this one, say the tool's position from joint angles, the copy is taken here.

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
            is not the map's, if the environment has entries of its own under our keys, or if another transform
            came between raw context and copy.
        KeyError: on attaching, if the environment lacks a context key or the actuation key.
    """

    invertible = True
    map: ActionMap
    action_scale: Tensor
    _low: Tensor | None
    _high: Tensor | None
    _executed_spec: Unbounded
    _context_shape: torch.Size

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
        keys = resolve_context_keys(map, context_keys)
        action_key, actuation_key = unravel_key(action_key), unravel_key(actuation_key)
        context_key, executed_key = unravel_key(context_key), unravel_key(executed_key)
        if forward_only:
            super().__init__(in_keys=[actuation_key, *keys], out_keys=[action_key])
        else:
            _check_distinct({action_key, actuation_key}, context_key, executed_key)
            out_keys = [context_key, executed_key] if keys else [executed_key]
            super().__init__(keys, out_keys, in_keys_inv=[actuation_key], out_keys_inv=[action_key])
        scale = resolve_action_scale(map, action_scale)
        self.map = frozen_copy(map)
        self.register_buffer("action_scale", scale)
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
        executed_spec = self._executed_spec
        if (device := observation_spec.device) is not None:
            executed_spec = executed_spec.to(device)
        observation_spec[self.executed_key] = executed_spec.expand(
            *observation_spec.shape, *executed_spec.shape
        )
        return self._with_context(observation_spec)

    def transform_state_spec(self, state_spec: Composite) -> Composite:
        """Registers the context as an input too: worker processes are sent nothing else along with the action."""
        return self._with_context(state_spec)

    def _with_context(self, spec: Composite) -> Composite:
        if self.snapshot is not None:
            spec[self.context_key] = Unbounded(self._context_shape, dtype=self.dtype, device=spec.device)
        return spec

    def __repr__(self) -> str:
        size = f"{self.map.action_dim} -> {self.map.actuation_dim}"
        keys = [] if self.snapshot is None else self.snapshot.in_keys
        return f"{type(self).__name__}({type(self.map).__name__} {size}, context_keys={keys})"

    def _attach(self, *, may_place: bool = False) -> None:
        """Checks map against environment, if there is one by now, and reads what holds for all steps."""
        env, front, ahead = surroundings(self)
        if env is None:
            return
        if self.forward_only:
            raise ValueError("a forward_only transform is for replay buffers, not for environments")
        base = env.base_env
        self._attach_actuation(base, ahead)
        observation_spec = base.full_observation_spec
        raw_keys = set(observation_spec.keys(True, True))
        others = [transform for transform in ahead if not isinstance(transform, ContextSnapshot)]
        if taken := {self.context_key, self.executed_key} & raw_keys.union(*(t.out_keys for t in others)):
            raise ValueError(
                f"there is another entry {taken.pop()!r} already: choose another context_key or executed_key"
            )
        if self.snapshot is None:
            return
        keys = self.snapshot.in_keys
        made = set(keys) - raw_keys
        if made and ahead:
            check_writers(ahead, keys, made)
            observation_spec = transformed_spec(base.output_spec, ahead, "output")["full_observation_spec"]
        lead = self._context_shape[:-1]
        check_context(observation_spec, keys, lead, self.map.context_dim)
        self._takes_snapshot = bool(made) or not self.snapshot.put_in_front(front, ahead, may_place)

    def _attach_actuation(self, base: EnvBase, ahead: list[Transform]) -> None:
        action_spec = transformed_spec(base.input_spec, ahead, "input")["full_action_spec"]
        spec = _actuation_spec(action_spec, self.actuation_key, self.map.actuation_dim)
        batch_dims = len(base.batch_size)
        self._low, self._high = _bounds(spec, batch_dims)
        self._context_shape = torch.Size((*spec.shape[:-1], self.map.context_dim))
        if self.actuation_key in base.full_action_spec.keys(True, True):
            spec = base.full_action_spec[self.actuation_key]  # what other transforms make of it is executed
        self._executed_spec = Unbounded(spec.shape[batch_dims:], dtype=spec.dtype, device=spec.device)


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
    if not spec.dtype.is_floating_point:
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
    if isinstance(spec, Stacked):
        lows, highs = zip(*(_bounds(part, 0) for part in spec.unbind(spec.stack_dim)), strict=True)
        return torch.stack(lows, spec.stack_dim), torch.stack(highs, spec.stack_dim)
    if isinstance(spec, Unbounded):
        high = torch.full(spec.shape[batch_dims:], torch.inf, dtype=spec.dtype, device=spec.device)
        return -high, high
    low, high = spec.space.low, spec.space.high
    first = (0,) * batch_dims
    if low.equal(low[first].expand_as(low)) and high.equal(high[first].expand_as(high)):
        low, high = low[first], high[first]  # these fit any batch, such as that of a masked step
    return low.clone(), high.clone()
