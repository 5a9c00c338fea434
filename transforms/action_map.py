"""Put an action map between policy and environment: the policy acts in k dimensions, n motors move."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase, unravel_key
from tensordict.utils import expand_as_right
from torch import Tensor, nn

from nht.saturation import Saturation
from nht.transforms.arguments import MapOrFile, check_distinct, resolve_context_keys, take_map
from nht.transforms.attachment import Attachment
from nht.transforms.context import read_context
from nht.transforms.repeats import Repeats


class ActionMapTransform(Attachment):
    """The policy gives an action in [-1, 1]^k, the environment executes the actuation that the map makes of it.

        actuation = map.decode(action, context), within the limits of the environment's own action spec

    The map alone decides what an action means: its scale, and what happens at the limits. See ``nht.ActionMap``.

    The map sees the raw context, as ``env.base_env`` gives it, wherever this transform stands among others. TorchRL
    inverts actions only after all transforms have rewritten the observation; a copy of the raw context therefore
    travels in the tensordict. It is taken before the transforms in front of this one run; the chain's order, indices
    and saved states stay as they are without a map. Only if a transform in front makes an entry of the context, say the
    tool's position from joint angles, the whole context is read here instead.

    Three entries stand in the data, registered in the specs:

    - ``action_key``, (*batch, k): the policy's action, as it gave it.
    - ``context_key``, (*batch, context_dim): the raw context. Left out if the map's ``context_dim`` is 0.
    - ``executed_key``, (*batch, n): under "next", the actuation that the environment executed in this step; at the
      root, that of the step before, zero after a reset. A copy whose step was skipped keeps its last value.

    Transforms that step the environment again, such as ``FrameSkipTransform``, repeat the actuation, in whichever
    order they stand. Where the environment's action spec is unbounded, or where there is no environment, nothing is
    limited. Policies see the map's dtype, environments that of their own spec. The map is copied, frozen and kept in
    eval mode; nothing that depends on the course of an episode stays in this module.

    ``forward`` goes from actuation to action, for replay buffers and demonstrations: it reads ``actuation_key`` and the
    context keys, and writes ``map.encode(actuation, context)`` to ``action_key``, not limited. As
    ``ReplayBuffer.extend`` calls ``inv``, a buffer that is written to needs an instance with ``forward_only=True``,
    whose ``inv`` does nothing.

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
        forward_only: for replay buffers. Attaching such an instance to an environment raises an error.
        allow: modules that may be imported for the class of a map in a file, see ``nht.load_map``.

    Raises:
        TypeError: if ``map`` is neither map nor path; on attaching, if a context entry or the actuation is not of
            floats.
        FileNotFoundError: if there is no such file.
        ValueError: on a file that holds no map, on an ``action_scale`` that is not positive and finite, on another
            ``saturation``, on context keys that are missing or in another order than the map's, on keys that collide;
            on attaching, if the width of context or actuation is not the map's, if the environment has entries of its
            own under our keys, or if the raw context cannot be read because of other transforms; at a step, if the
            action has another width than k.
        KeyError: on attaching, if the environment lacks a context key or the actuation key.
    """

    invertible = True

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
        allow: Sequence[str] = (),
    ) -> None:
        map = take_map(map, action_scale, saturation, allow)
        keys = resolve_context_keys(map, context_keys)
        action_key, actuation_key = unravel_key(action_key), unravel_key(actuation_key)
        context_key, executed_key = unravel_key(context_key), unravel_key(executed_key)
        if forward_only:
            super().__init__(in_keys=[actuation_key, *keys], out_keys=[action_key])
        else:
            check_distinct({action_key, actuation_key}, context_key, executed_key)
            out_keys = [context_key, executed_key] if keys else [executed_key]
            super().__init__(keys, out_keys, in_keys_inv=[actuation_key], out_keys_inv=[action_key])
        self.map = map
        self._register_limits()
        self.register_load_state_dict_pre_hook(_take_old_action_scale)
        self.context_keys = keys
        self.action_key, self.actuation_key = action_key, actuation_key
        self.context_key, self.executed_key = context_key, executed_key
        self.forward_only = forward_only
        self._repeats = Repeats(action_key, actuation_key, executed_key)

    @classmethod
    def from_file(cls, path: str | Path, **kwargs: Any) -> ActionMapTransform:
        """A transform around the map in a file of ``nht.save_map``; keyword arguments are the constructor's."""
        return cls(path, **kwargs)

    @property
    def action_scale(self) -> Tensor:
        """The map's action scale, a scalar: what a policy's action of 1 stands for."""
        return self.map.action_scale

    def train(self, mode: bool = True) -> ActionMapTransform:
        """Set the mode of this module, not that of the map."""
        super().train(mode)
        self.map.eval()
        return self

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
        if self._low is None:
            self._check_not_recorded(tensordict, action, context)
        elif context is None:
            raise KeyError(f"no {self.context_key!r} beside the action: pass on what reset or step returned.")
        return tensordict.set(self.actuation_key, self.map.decode(action, context, self._low, self._high))

    def _check_not_recorded(self, tensordict: TensorDictBase, action: Tensor, context: Tensor | None) -> None:
        """Without an environment, refuse data that have no policy's action and context: they are of a replay buffer."""
        if context is None or "next" in tensordict or action.shape[-1] != self.map.action_dim:
            beside = f" and {self.context_key!r}" if self.context_keys else ""
            raise ValueError(
                f"without an environment inv maps a policy's action: it reads {self.action_key!r}, (*batch, "
                f"{self.map.action_dim}){beside}; got {self.action_key!r} {tuple(action.shape)} among "
                f"{sorted(map(str, tensordict.keys(True, True)))}. "
                "For the recorded data of a replay buffer, make a transform with forward_only=True."
            )

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        self._see_to_context(next_tensordict)
        executed = tensordict.get(self.actuation_key)
        self._repeats.remember(tensordict, executed)
        stepped = tensordict.get("_step", None)  # of these copies only
        if stepped is not None:
            before = tensordict.get(self.executed_key, torch.zeros_like(executed))
            executed = torch.where(expand_as_right(stepped, executed), executed, before)
        return next_tensordict.set(self.executed_key, executed)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        self._see_to_context(tensordict_reset)
        idle = self._executed_spec.zero(tensordict_reset.batch_size)
        return tensordict_reset.set(self.executed_key, idle)

    def _see_to_context(self, observed: TensorDictBase) -> None:
        """Read the context, or make sure that the one that was read early is still there."""
        if not self.context_keys:
            return
        if not self.reads_early:
            self.read_raw(observed)
        elif observed.get(self.context_key, None) is None:
            raise KeyError(
                f"a transform in front of the ActionMapTransform removed {self.context_key!r}, the recorded context: "
                "put the ActionMapTransform in front of it, or let it leave that key."
            )

    def __repr__(self) -> str:
        size = f"{self.map.action_dim} -> {self.map.actuation_dim}"
        return f"{type(self).__name__}({type(self.map).__name__} {size}, context_keys={self.context_keys})"


def _take_old_action_scale(
    _module: nn.Module, state_dict: dict[str, Any], prefix: str, *_others: object
) -> None:
    """Accept states of earlier versions, in which the transform had its own action scale in place of the map's."""
    if f"{prefix}action_scale" in state_dict:
        state_dict[f"{prefix}map.action_scale"] = state_dict.pop(f"{prefix}action_scale")
