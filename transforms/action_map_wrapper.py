"""Action maps for Gymnasium: what ``ActionMapTransform`` does, without TorchRL, around one environment or a vector."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils import RecordConstructorArgs
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper
from numpy.typing import NDArray
from tensordict import NestedKey

from nht.saturation import Saturation
from nht.transforms.arguments import MapOrFile, take_map
from nht.transforms.gymnasium_mapping import Floats, GymnasiumMapping


class ActionMapWrapper(gymnasium.Wrapper[Any, Floats, Any, Floats], RecordConstructorArgs):
    """The policy gives an action in [-1, 1]^k, the environment executes the actuation that the map makes of it.

        actuation = map.decode(action, context), within the limits of the environment's own action space

    The map alone decides what an action means: its scale, and what happens at the limits. See ``nht.ActionMap``.

    The context is read from what ``reset`` and ``step`` return: an entry of a Dict observation, ``"observation"`` for
    any other observation, or else an entry of ``info``, such as the raw keys of ``nht.envs``. The observation is that
    of the wrapped environment: wrappers that rewrite it, such as ``NormalizeObservation``, belong around this one.
    ``info["actuation"]`` (n,) is what the environment got in this step. Actions are not clipped, NaN is passed on.

    All arguments but ``env`` can be JSON values, so that configurations and ``env.spec.to_json()`` can hold them; the
    map is then the path of its file. ``spec`` of a wrapper that was given a map object makes the environment again,
    but cannot be turned into JSON.

    Args:
        env: its actions must be a Box of floats. Of a vector environment, see ``ActionMapVectorWrapper``.
        map: any action map, or the path of its file. It is copied, frozen and kept in eval mode.
        context_keys: entries, of shape (width,) or single numbers, that side by side are the context. Defaults to
            those that the map was trained on. A nested key stands in a list, ``[("arm", "joint_angle")]``.
        action_scale: what 1 stands for, in the map's own units, in place of the map's.
        saturation: ``"scale"`` or ``"clip"``, what happens at the limits, in place of the map's.
        allow: modules that may be imported for the class of a map in a file, see ``nht.load_map``.

    Raises:
        TypeError: if ``env`` or ``map`` is none, or on actions or, here or at the first reset, a context entry that is
            not of floats.
        FileNotFoundError: if there is no such file of a map.
        ValueError: on a file that holds no map, on an ``action_scale`` that is not positive and finite, on another
            ``saturation``, on context keys that are missing or in another order than the map's; if the width of the
            actuation or, here or at the first reset, of the context is not the map's; at a step, on an action of
            another shape.
        KeyError: at a reset or step that brings a context key neither in the observation nor in ``info``.
        ResetNeeded: at a step before the first reset.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        map: MapOrFile,
        context_keys: Sequence[NestedKey] | None = None,
        *,
        action_scale: float | None = None,
        saturation: Saturation | None = None,
        allow: Sequence[str] = (),
    ) -> None:
        if not isinstance(env, gymnasium.Env):
            raise TypeError(
                f"env must be a gymnasium.Env, got {type(env).__name__}: "
                "ActionMapVectorWrapper is for vector environments."
            )
        taken = take_map(map, action_scale, saturation, allow)
        self._map_has_a_file = isinstance(map, str | Path)
        RecordConstructorArgs.__init__(
            self,
            map=str(map) if isinstance(map, Path) else map,
            context_keys=_as_json(context_keys),
            action_scale=None if action_scale is None else float(action_scale),
            saturation=saturation,
            allow=list(allow),
        )
        super().__init__(env)
        self._mapping = GymnasiumMapping(taken, context_keys, env.observation_space, env.action_space)
        self.action_space = self._mapping.action_space
        self._context: Floats | None = None

    @classmethod
    def from_file(cls, env: gymnasium.Env[Any, Any], path: str | Path, **kwargs: Any) -> ActionMapWrapper:
        """A wrapper with the map in a file of ``nht.save_map``; keyword arguments are the constructor's."""
        return cls(env, path, **kwargs)

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]  # a property in Gymnasium's own Wrapper too
        """The specification from which ``gymnasium.make`` makes this environment again, with wrapper and map."""
        spec = super().spec
        if spec is None or self._map_has_a_file:
            return spec
        values = {field.name: getattr(spec, field.name) for field in dataclasses.fields(spec) if field.init}
        return _SpecWithMap(**values)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the environment and read the context."""
        observation, info = self.env.reset(seed=seed, options=options)
        self._context = self._mapping.context(observation, info)
        return observation, info

    def step(self, action: Floats) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Execute the actuation that stands for ``action`` (k,)."""
        actuation = self._mapping.actuation(action, self._context)
        observation, reward, terminated, truncated, info = self.env.step(actuation.copy())
        self._context = self._mapping.context(observation, info)
        return observation, reward, terminated, truncated, info | {"actuation": actuation}


class _SpecWithMap(EnvSpec):
    """The specification of an environment whose map is an object in memory."""

    def to_json(self) -> str:
        raise TypeError(
            "the map of this ActionMapWrapper is an object, which JSON cannot hold: "
            'save it, and give the path of its file, ActionMapWrapper(env, "map.safetensors").'
        )


class ActionMapVectorWrapper(VectorWrapper[Any, Floats, Any, Floats, NDArray[Any]]):
    """``ActionMapWrapper`` around a ``gymnasium.vector.VectorEnv``: actions are (N, k), actuations (N, n).

    ``infos["actuation"]`` is what the copies executed; where a copy was reset instead, it is 0 and its mask,
    ``infos["_actuation"]``, False. In the autoreset mode ``SAME_STEP`` it stands beside ``final_info`` and within.

    Arguments, and errors beside those of ``ActionMapWrapper``, are the same.

    Attributes:
        autoreset_mode: that of the wrapped vector, for those who look for it there, such as TorchRL's ``GymWrapper``.

    Raises:
        KeyError: also if a copy's mask in ``infos`` says that it has no such context entry.
    """

    def __init__(
        self,
        env: VectorEnv[Any, Any, Any],
        map: MapOrFile,
        context_keys: Sequence[NestedKey] | None = None,
        *,
        action_scale: float | None = None,
        saturation: Saturation | None = None,
        allow: Sequence[str] = (),
    ) -> None:
        super().__init__(env)
        taken = take_map(map, action_scale, saturation, allow)
        self._mapping = GymnasiumMapping(
            taken, context_keys, env.observation_space, env.action_space, (env.num_envs,)
        )
        self.action_space = self._mapping.action_space
        self.single_action_space = self._mapping.single_action_space
        self.autoreset_mode = AutoresetMode(env.metadata.get("autoreset_mode", AutoresetMode.NEXT_STEP))
        self._skips_a_step = self.autoreset_mode is AutoresetMode.NEXT_STEP
        self._waiting = np.zeros(env.num_envs, dtype=bool)  # copies that the next step resets
        self._context: Floats | None = None

    @classmethod
    def from_file(
        cls, env: VectorEnv[Any, Any, Any], path: str | Path, **kwargs: Any
    ) -> ActionMapVectorWrapper:
        """A wrapper with the map in a file of ``nht.save_map``; keyword arguments are the constructor's."""
        return cls(env, path, **kwargs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Reset the copies, or those in ``options["reset_mask"]`` (N,), and read their context."""
        everyone = np.ones(self.num_envs, dtype=bool)
        mask = (options or {}).get("reset_mask", everyone)  # read first: environments may take it out
        if self._context is None and not np.all(mask):
            raise ResetNeeded("the first reset must be of all copies: the others' context is unknown.")
        observations, infos = self.env.reset(seed=seed, options=options)
        context = self._mapping.context(observations, infos, mask)
        self._context = context if self._context is None else np.where(mask[:, None], context, self._context)
        self._waiting = self._waiting & ~mask
        return observations, infos

    def step(self, actions: Floats) -> tuple[Any, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Execute the actuations that stand for ``actions`` (N, k)."""
        actuation = self._mapping.actuation(actions, self._context)
        observations, rewards, terminations, truncations, infos = self.env.step(actuation.copy())
        self._context = self._mapping.context(observations, infos)
        executed = ~self._waiting
        actuation[self._waiting] = 0.0
        self._waiting = (terminations | truncations) & self._skips_a_step
        infos = infos | {"actuation": actuation, "_actuation": executed}
        if isinstance(
            final := infos.get("final_info"), Mapping
        ):  # where the last steps of episodes are looked up
            infos["final_info"] = {
                **final,
                "actuation": actuation.copy(),
                "_actuation": terminations | truncations,
            }
        return observations, rewards, terminations, truncations, infos


def _as_json(keys: Sequence[NestedKey] | None) -> list[Any] | None:
    """Keys in JSON, where a nested key is a list."""
    if keys is None:
        return None
    listed = [keys] if isinstance(keys, str) else keys
    return [key if isinstance(key, str) else list(key) for key in listed]
