"""Action maps for Gymnasium: what `ActionMapTransform` does, without TorchRL, around one environment or a vector."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Space
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray
from tensordict import NestedKey

from nht import ActionMap, load_map
from nht.transforms.arguments import frozen_copy, resolve_action_scale, resolve_context_keys

Array = NDArray[np.floating[Any]]
Flags = NDArray[np.bool_]


class ActionMapWrapper(gymnasium.Wrapper[Any, Array, Any, Array], RecordConstructorArgs):
    """The policy gives an action in [-1, 1]^k, the environment executes the actuation that the map makes of it.

        actuation = clip(map(action_scale * action, context), the environment's own action space)

    The context is read from what `reset` and `step` return: an entry of a Dict observation, `"observation"` for any
    other observation, or else an entry of `info`, such as the raw keys of `nht.envs`. The observation is that of the
    wrapped environment: wrappers that rewrite it, such as `NormalizeObservation`, belong around this one.
    `info["actuation"]` (n,) is what the environment got in this step. Actions are not clipped, NaN is passed on.

    Args:
        env: its actions must be a Box of floats. Of a vector environment, see `ActionMapVectorWrapper`.
        map: any action map. It is copied, frozen and kept in eval mode.
        context_keys: entries, of shape (width,) or single numbers, that side by side are the context. Defaults to
            those that the map was trained on. A nested key stands in a list, `[("arm", "joint_angle")]`.
        action_scale: what 1 stands for, in the map's own units. Defaults to the map's.

    Raises:
        TypeError: if `env` or `map` is none, or on actions or, here or at the first reset, a context entry that is
            not of floats.
        ValueError: on an `action_scale` that is not positive and finite, on context keys that are missing or in
            another order than the map's; if the width of the actuation or, here or at the first reset, of the context
            is not the map's.
        KeyError: at a reset or step that brings a context key neither in the observation nor in `info`.
        ResetNeeded: at a step before the first reset.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        map: ActionMap,
        context_keys: Sequence[NestedKey] | None = None,
        *,
        action_scale: float | None = None,
    ) -> None:
        if not isinstance(env, gymnasium.Env):
            raise TypeError(
                f"env must be a gymnasium.Env, got {type(env).__name__}: "
                "ActionMapVectorWrapper is for vector environments"
            )
        RecordConstructorArgs.__init__(self, map=map, context_keys=context_keys, action_scale=action_scale)
        super().__init__(env)
        self._mapping = _Mapping(map, context_keys, action_scale, env.observation_space, env.action_space)
        self.action_space = self._mapping.action_space
        self._context: Array | None = None

    @classmethod
    def from_file(cls, env: gymnasium.Env[Any, Any], path: str | Path, **kwargs: Any) -> "ActionMapWrapper":
        """A wrapper with the map in a file of `nht.save_map`; keyword arguments are the constructor's."""
        return cls(env, load_map(path), **kwargs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets the environment and reads the context."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._context = self._mapping.context(observation, info)
        return observation, info

    def step(self, action: Array) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Executes the actuation that stands for `action` (k,)."""
        actuation = self._mapping.actuation(action, self._context)
        observation, reward, terminated, truncated, info = self.env.step(actuation.copy())
        self._context = self._mapping.context(observation, info)
        return observation, reward, terminated, truncated, info | {"actuation": actuation}


class ActionMapVectorWrapper(VectorWrapper[Any, Array, Any, Array, NDArray[Any]]):
    """`ActionMapWrapper` around a `gymnasium.vector.VectorEnv`: actions are (N, k), actuations (N, n).

    `infos["actuation"]` is what the copies executed; where a copy was reset instead, it is 0 and its mask,
    `infos["_actuation"]`, False. In the autoreset mode `SAME_STEP` it stands beside `final_info`, not within.

    Arguments, and errors beside those of `ActionMapWrapper`, are the same.

    Raises:
        KeyError: also if a copy's mask in `infos` says that it has no such context entry.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        map: ActionMap,
        context_keys: Sequence[NestedKey] | None = None,
        *,
        action_scale: float | None = None,
    ) -> None:
        super().__init__(env)
        self._mapping = _Mapping(
            map, context_keys, action_scale, env.observation_space, env.action_space, (env.num_envs,)
        )
        self.action_space = self._mapping.action_space
        self.single_action_space = self._mapping.single_action_space
        mode = env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP)
        self._skips_a_step = mode is AutoresetMode.NEXT_STEP
        self._waiting = np.zeros(env.num_envs, dtype=bool)  # copies that the next step resets
        self._context: Array | None = None

    @classmethod
    def from_file(
        cls, env: VectorEnv[Any, Any, Any], path: str | Path, **kwargs: Any
    ) -> "ActionMapVectorWrapper":
        """A wrapper with the map in a file of `nht.save_map`; keyword arguments are the constructor's."""
        return cls(env, load_map(path), **kwargs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Resets the copies, or those in `options["reset_mask"]` (N,), and reads their context."""
        everyone = np.ones(self.num_envs, dtype=bool)
        mask = (options or {}).get("reset_mask", everyone)  # read first: environments may take it out
        if self._context is None and not np.all(mask):
            raise ResetNeeded("the first reset must be of all copies: the others' context is unknown")
        observations, infos = self.env.reset(seed=seed, options=options)
        context = self._mapping.context(observations, infos, mask)
        self._context = context if self._context is None else np.where(mask[:, None], context, self._context)
        self._waiting = self._waiting & ~mask
        return observations, infos

    def step(self, actions: Array) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Executes the actuations that stand for `actions` (N, k)."""
        actuation = self._mapping.actuation(actions, self._context)
        observations, rewards, terminations, truncations, infos = self.env.step(actuation.copy())
        self._context = self._mapping.context(observations, infos)
        executed = ~self._waiting
        actuation[self._waiting] = 0.0
        self._waiting = (terminations | truncations) & self._skips_a_step
        infos = infos | {"actuation": actuation, "_actuation": executed}
        return observations, rewards, terminations, truncations, infos


class _Mapping:
    """What both wrappers share: where the context stands, and the way from action to actuation.

    Args:
        map, context_keys, action_scale: as of the wrappers.
        observation_space: of the wrapped environment.
        action_space: of the wrapped environment.
        lead: what stands in front of every shape: (), or (N,) for a vector.
    """

    def __init__(
        self,
        map: ActionMap,
        context_keys: Sequence[NestedKey] | None,
        action_scale: float | None,
        observation_space: Space[Any],
        action_space: Space[Any],
        lead: tuple[int, ...] = (),
    ) -> None:
        self.keys = resolve_context_keys(map, context_keys)
        self.scale = resolve_action_scale(map, action_scale)
        self.map = frozen_copy(map)
        self.lead = lead
        self.low, self.high = _bounds(action_space, (*lead, map.actuation_dim))
        dtype = torch.empty(0, dtype=self.scale.dtype).numpy().dtype
        self.action_space = Box(-1.0, 1.0, (*lead, map.action_dim), dtype.type)
        self.single_action_space = Box(-1.0, 1.0, (map.action_dim,), dtype.type)
        observed = {key: _find(_by_key(observation_space), key) for key in self.keys}
        if None not in observed.values():  # otherwise it is known after the first reset
            self._check(observed)

    def context(self, observation: Any, info: dict[str, Any], rows: Flags | None = None) -> Array:
        """The context (*lead, context_dim); of the copies `rows` (N,), all by default, it must be there."""
        observed = _by_key(observation)
        values = {}
        for key in self.keys:
            value = _find(observed, key)
            if value is None:
                value = self._from_info(key, info, rows, observed)
            values[key] = np.asarray(value)
        self._check(values)
        columns = [np.reshape(value, (*self.lead, -1)) for value in values.values()]
        return np.concatenate(columns, axis=-1) if columns else np.empty((*self.lead, 0), np.float32)

    def _from_info(
        self, key: NestedKey, info: dict[str, Any], rows: Flags | None, observed: Mapping[str, Any]
    ) -> Any:
        value = _find(info, key)
        if value is None:
            raise KeyError(
                f"no context key {key!r}: the observation has {list(observed)}, info has {_names(info)}"
            )
        *outer, name = (key,) if isinstance(key, str) else key
        has = _find(info, (*outer, f"_{name}")) if self.lead else None
        if has is not None:
            missing = ~has if rows is None else rows & ~has
            if missing.any():
                raise KeyError(f"info has no {key!r} of the copies {np.flatnonzero(missing).tolist()}")
        return value

    def _check(self, entries: Mapping[NestedKey, Any]) -> None:
        """Every entry, an array or a space, is of floats and fits, and the widths add up to the map's context."""
        widths = {}
        for key, entry in entries.items():
            if entry.dtype is None or not np.issubdtype(entry.dtype, np.floating):
                raise TypeError(f"context key {key!r} must be of floats, got {entry.dtype}")
            width = entry.shape[len(self.lead) :] or (1,)
            if entry.shape[: len(self.lead)] != self.lead or len(width) > 1:
                wanted = ", ".join(map(str, [*self.lead, "width"]))
                raise ValueError(f"context key {key!r} must have the shape ({wanted}), got {entry.shape}")
            widths[key] = width[0]
        if sum(widths.values()) != self.map.context_dim:
            sizes = ", ".join(f"{key!r}: {width}" for key, width in widths.items())
            raise ValueError(
                f"the map's context has {self.map.context_dim} entries, "
                f"the context keys {sum(widths.values())} ({sizes})"
            )

    @torch.no_grad()
    def actuation(self, action: Array, context: Array | None) -> Array:
        """Actuation (*lead, n) for an action (*lead, k), in the dtype of the environment's action space."""
        if context is None:
            raise ResetNeeded("call reset before the first step")
        action = np.asarray(action)
        if action.shape != self.action_space.shape:
            raise ValueError(f"expected an action of shape {self.action_space.shape}, got {action.shape}")
        scaled = self.scale.new_tensor(action) * self.scale
        actuation: Array = self.map(scaled, self.scale.new_tensor(context)).cpu().numpy()
        return np.clip(actuation.astype(self.low.dtype), self.low, self.high)


def _bounds(space: Space[Any], shape: tuple[int, ...]) -> tuple[Array, Array]:
    if not isinstance(space, Box) or not np.issubdtype(space.dtype, np.floating):
        raise TypeError(f"the environment's actions are not continuous: {space}")
    if space.shape != shape:
        raise ValueError(
            f"the map drives {shape[-1]} actuators, the environment's actions have the shape {space.shape}"
        )
    return space.low, space.high


def _by_key(observation: Any) -> Mapping[str, Any]:
    """A Dict observation, or its space, as it is; any other under `"observation"`."""
    return observation if isinstance(observation, Mapping) else {"observation": observation}


def _find(entries: Any, key: NestedKey) -> Any:
    """The entry of a Mapping, or of Mappings within it; None if there is none."""
    for name in (key,) if isinstance(key, str) else key:
        entries = entries.get(name) if isinstance(entries, Mapping) else None
    return entries


def _names(info: Mapping[str, Any]) -> list[str]:
    """The keys of `info` without masks."""
    return [key for key in info if not str(key).startswith("_")]
