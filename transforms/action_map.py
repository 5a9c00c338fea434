"""Put an action map between policy and environment: the policy acts in k dimensions, n motors move."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.utils import expand_as_right
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.transforms import Compose, Transform

from nht import ActionMap
from nht.saturation import Saturation
from nht.transforms.action_spec import find_actuation_spec, limits, transformed_spec
from nht.transforms.arguments import MapOrFile, resolve_context_keys, take_map
from nht.transforms.context import (
    LEAVING_OBSERVATIONS,
    check_context,
    check_writers,
    read_context,
    rewriters,
)
from nht.transforms.repeats import Repeats
from nht.transforms.torchrl_internals import EarlyReader, containers, let_read_early, surroundings


class ActionMapTransform(EarlyReader):
    """The policy gives an action in [-1, 1]^k, the environment executes the actuation that the map makes of it.

        actuation = map.decode(action, context), within the limits of the environment's own action spec

    What an action means, its scale and what happens at the limits, is the map's alone: see ``nht.ActionMap``.

    The map sees the raw context, that of ``env.base_env``, wherever this transform stands among others. TorchRL
    inverts actions only after all transforms have rewritten the observation; a copy of the raw context therefore
    travels in the tensordict. It is taken here or, where transforms that may rewrite the observation come before this
    one, by the chain just before the first of these: nothing is added to the chain. Only if an entry of the context
    is itself made by a transform before this one, say the tool's position from joint angles, it is read here always.

    Three entries stand in the data, registered in the specs:

    - ``action_key``, (*batch, k): the policy's action, as it gave it.
    - ``context_key``, (*batch, context_dim): the raw context. Left out if the map's ``context_dim`` is 0.
    - ``executed_key``, (*batch, n): under "next", the actuation that the environment got in this step; at the root,
      hence, that of the step before, and zero after a reset. A copy whose step was skipped keeps it as it was.

    Transforms that step the environment again, such as ``FrameSkipTransform``, repeat the actuation, in whichever
    order they stand. Where the environment's action spec is unbounded, or where there is no environment, nothing is
    limited. Policies see the map's dtype, environments that of their own spec. The map is copied, frozen and kept in
    eval mode; nothing that depends on the course of an episode stays in this module.

    ``forward`` is the way back, for replay buffers and demonstrations: it reads ``actuation_key`` and the context
    keys, and writes ``map.encode(actuation, context)`` to ``action_key``, not limited. As ``ReplayBuffer.extend``
    calls ``inv``, a buffer that is written to needs an instance with ``forward_only=True``, whose ``inv`` does nothing.

    Args:
        map: any action map, or the path of its file.
        context_keys: entries of the raw observation whose concatenation is the context. Defaults to those that the
            map was trained on. A nested key stands in a list, ``[("arm", "joint_angle")]``: a tuple is several keys.
        action_scale: what 1 stands for, in the map's own units, in place of the map's.
        saturation: ``"scale"`` or ``"clip"``, what happens at the limits, in place of the map's.
        action_key: the policy's action.
        actuation_key: the environment's own action; in a replay buffer, the recorded actuation.
        context_key: the copy of the context.
        executed_key: the executed actuation.
        forward_only: for replay buffers. To attach such an instance to an environment is an error.

    Raises:
        TypeError: if ``map`` is neither map nor path; on attaching, if a context entry or the actuation is not of
            floats.
        FileNotFoundError: if there is no such file.
        ValueError: on an ``action_scale`` that is not positive and finite, on another ``saturation``, on context keys
            that are missing or in another order than the map's, on keys that collide; on attaching, if the width of
            context or actuation is not the map's, if the environment has entries of its own under our keys, or if the
            raw context cannot be read because of other transforms; at a step, if the action has another width than k.
        KeyError: on attaching, if the environment lacks a context key or the actuation key.
    """

    invertible = True
    map: ActionMap
    _low: Tensor | None
    _high: Tensor | None
    _executed_spec: Unbounded
    _context_shape: torch.Size

    def __init__(
        self,
        map: MapOrFile,
        context_keys: Sequence[NestedKey] | None = None,
        *,
        action_scale: float | None = None,
        saturation: Saturation | None = None,
        action_key: NestedKey = "action",
        actuation_key: NestedKey = "action",
        context_key: NestedKey = "context",
        executed_key: NestedKey = "actuation",
        forward_only: bool = False,
    ) -> None:
        map = take_map(map, action_scale, saturation)
        keys = resolve_context_keys(map, context_keys)
        action_key, actuation_key = unravel_key(action_key), unravel_key(actuation_key)
        context_key, executed_key = unravel_key(context_key), unravel_key(executed_key)
        if forward_only:
            super().__init__(in_keys=[actuation_key, *keys], out_keys=[action_key])
        else:
            _check_distinct({action_key, actuation_key}, context_key, executed_key)
            out_keys = [context_key, executed_key] if keys else [executed_key]
            super().__init__(keys, out_keys, in_keys_inv=[actuation_key], out_keys_inv=[action_key])
        self.map = map
        # The limits belong to the environment: found on attaching, not saved.
        self.register_buffer("_low", None, persistent=False)
        self.register_buffer("_high", None, persistent=False)
        self.register_load_state_dict_pre_hook(_take_old_action_scale)
        self.context_keys = keys
        self.action_key, self.actuation_key = action_key, actuation_key
        self.context_key, self.executed_key = context_key, executed_key
        self.forward_only = forward_only
        self._repeats = Repeats(action_key, actuation_key, executed_key)
        self._is_current = True

    @classmethod
    def from_file(cls, path: str | Path, **kwargs: Any) -> ActionMapTransform:
        """A transform around the map in a file of ``nht.save_map``; keyword arguments are the constructor's."""
        return cls(path, **kwargs)

    @property
    def action_scale(self) -> Tensor:
        """What a policy's action of 1 stands for, a scalar: the map's."""
        return self.map.action_scale

    @property
    def dtype(self) -> torch.dtype:
        """Of the map, hence of actions and context."""
        return self.map.action_scale.dtype

    def train(self, mode: bool = True) -> ActionMapTransform:
        """Sets the mode of this module, not that of the map."""
        super().train(mode)
        self.map.eval()
        return self

    def clone(self) -> ActionMapTransform:
        """A transform with the same map, for another environment: it does not know this one's limits."""
        twin: ActionMapTransform = super().clone()
        twin._low = twin._high = None
        return twin

    def empty_cache(self) -> None:
        """Called whenever the chain around the transform changes."""
        super().empty_cache()
        self._is_current = False

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Actuation to action, in data with the raw observation at the root."""
        actuation = tensordict[self.actuation_key].to(self.dtype)
        keys = self.context_keys
        context = read_context(tensordict, keys, self.dtype) if keys else actuation[..., :0]
        return tensordict.set(self.action_key, self.map.encode(actuation, context))

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        if self.forward_only:
            return tensordict
        if not torch.compiler.is_compiling():
            self._check_place()
        action = self._repeats.policy_action(tensordict, tensordict[self.action_key])
        context = tensordict.get(self.context_key) if self.context_keys else action[..., :0]
        if context is None:
            raise KeyError(f"no {self.context_key!r} beside the action: pass on what reset or step returned.")
        return tensordict.set(self.actuation_key, self.map.decode(action, context, self._low, self._high))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self.context_keys and not self.reads_early:
            self.read_raw(next_tensordict)
        executed = tensordict.get(self.actuation_key)
        self._repeats.remember(tensordict, executed)
        stepped = tensordict.get("_step", None)  # of these copies only
        if stepped is not None:
            before = tensordict.get(self.executed_key, torch.zeros_like(executed))
            executed = torch.where(expand_as_right(stepped, executed), executed, before)
        return next_tensordict.set(self.executed_key, executed)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        if self.context_keys and not self.reads_early:
            self.read_raw(tensordict_reset)
        idle = self._executed_spec.zero(tensordict_reset.batch_size)
        return tensordict_reset.set(self.executed_key, idle)

    def read_raw(self, observed: TensorDictBase) -> None:
        """Writes the context to its key."""
        observed.set(self.context_key, read_context(observed, self.context_keys, self.dtype))

    def set_container(self, container: Transform | EnvBase) -> None:
        """Attaches the transform to an environment, or to a Compose that may be attached to one already."""
        super().set_container(container)
        self._attach()

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
        if self.context_keys:
            spec[self.context_key] = Unbounded(self._context_shape, dtype=self.dtype, device=spec.device)
        return spec

    def __repr__(self) -> str:
        size = f"{self.map.action_dim} -> {self.map.actuation_dim}"
        return f"{type(self).__name__}({type(self.map).__name__} {size}, context_keys={self.context_keys})"

    def _check_place(self) -> None:
        """What holds for all steps is up to date, and nobody takes this for a replay buffer's transform."""
        if not self._is_current:
            self._attach()
        if self._low is None and any(True for _ in containers(self)):
            raise ValueError(
                "this ActionMapTransform is in a chain without an environment, such as that of a replay buffer, "
                "where inv would map recorded actions: make one with forward_only=True."
            )

    def _attach(self) -> None:
        """Checks map against environment, if there is one by now, and reads what holds for all steps."""
        self._is_current = True
        env, chain, ahead = surroundings(self)
        if env is None:
            return
        if self.forward_only:
            raise ValueError("a forward_only transform is for replay buffers, not for environments.")
        self._attach_actuation(env.base_env, ahead)
        raw_keys = set(env.base_env.full_observation_spec.keys(True, True))
        if taken := {self.context_key, self.executed_key} & raw_keys.union(*(t.out_keys for t in ahead)):
            raise ValueError(
                f"there is another entry {taken.pop()!r} already: choose another context_key or executed_key."
            )
        if self.context_keys:
            self._attach_context(env.base_env, chain, ahead, made=set(self.context_keys) - raw_keys)

    def _attach_actuation(self, base: EnvBase, ahead: list[Transform]) -> None:
        action_spec = transformed_spec(base.input_spec, ahead, "input")["full_action_spec"]
        spec = find_actuation_spec(action_spec, self.actuation_key, self.map.actuation_dim)
        batch_dims = len(base.batch_size)
        self._low, self._high = limits(spec, batch_dims)
        self._context_shape = torch.Size((*spec.shape[:-1], self.map.context_dim))
        if self.actuation_key in base.full_action_spec.keys(True, True):
            spec = base.full_action_spec[self.actuation_key]  # what other transforms make of it is executed
        self._executed_spec = Unbounded(spec.shape[batch_dims:], dtype=spec.dtype, device=spec.device)

    def _attach_context(
        self, base: EnvBase, chain: Compose | None, ahead: list[Transform], made: set[NestedKey]
    ) -> None:
        """Finds out who has to read the context, and when; `made` are the keys that other transforms make."""
        observation_spec = base.full_observation_spec
        spared = (*LEAVING_OBSERVATIONS, ActionMapTransform)
        if made and ahead:
            check_writers(ahead, self.context_keys, made)
            observation_spec = transformed_spec(base.output_spec, ahead, "output")["full_observation_spec"]
        check_context(observation_spec, self.context_keys, self._context_shape[:-1], self.map.context_dim)
        self.reads_early = not made and bool(rewriters(ahead, spared))
        if self.reads_early and chain is not None:
            let_read_early(chain, spared)


def _check_distinct(action_keys: set[NestedKey], context_key: NestedKey, executed_key: NestedKey) -> None:
    if context_key == executed_key or {context_key, executed_key} & action_keys:
        raise ValueError(
            f"context_key {context_key!r} and executed_key {executed_key!r} must differ from each other and "
            f"from the action's keys, {', '.join(sorted(map(repr, action_keys)))}."
        )


def _take_old_action_scale(
    module: nn.Module, state_dict: dict[str, Any], prefix: str, *_others: object
) -> None:
    """States saved earlier: the transform had an action scale of its own, which held instead of the map's."""
    if f"{prefix}action_scale" in state_dict:
        state_dict[f"{prefix}map.action_scale"] = state_dict.pop(f"{prefix}action_scale")
