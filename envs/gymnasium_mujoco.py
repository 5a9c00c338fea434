"""Gymnasium's environments through TorchRL's ``GymEnv``, on MuJoCo or not."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from functools import partial
from textwrap import shorten
from typing import Any

import gymnasium
import numpy as np
import torch
from torchrl.envs import EnvBase, GymEnv

from nht.envs.foreign import ForeignEnv
from nht.envs.gymnasium_copies import GymnasiumCopy, InfoReader, NativeCopy, gymnasium_copy
from nht.envs.outcome import INFO_FLAGS


def make_gymnasium(
    name: str,
    num_envs: int = 1,
    seed: int | None = None,
    device: torch.device | str = "cpu",
    *,
    info_keys: Sequence[str] = (),
    **options: Any,
) -> ForeignEnv:
    """Copies of an environment that ``gymnasium.make`` knows, or that Gymnasium-Robotics brings.

    Its actions must be a vector of numbers, and so must its observations, or the entries of a Dict of them. Those on
    MuJoCo, our own, and those that consist of plain Python values can be saved; of others ``task.resume_obstacle`` says
    why not.

    Args:
        name: its id, ``"AdroitHandRelocate-v1"``.
        num_envs: number of copies.
        seed: seed of every random draw of the environment; None draws one, so that no two environments are alike.
        device: where the tensors go.
        info_keys: entries of ``info``, numbers or vectors, that become observations beside ``"observation"``, for the
            context of maps. Of our own tasks the raw keys are there anyway.
        options: further arguments of ``gymnasium.make``.

    Raises:
        ImportError: if the environment is one of Gymnasium-Robotics, which is not installed, or needs another package.
        KeyError: if a reset's ``info`` lacks one of the ``info_keys``.
        ValueError: for an id that does not exist, with some that do; for options that it does not take; for actions or
            observations of other kinds.
    """
    _check_id(name)
    return ForeignEnv(
        partial(_gym_env, name, tuple(info_keys), options), gymnasium_copy, num_envs, seed, device, name
    )


def _check_id(name: str) -> None:
    if name not in gymnasium.registry and ":" not in name:
        _register_robotics(needed="Adroit" in name)
    if name not in gymnasium.registry and ":" not in name:
        first = name[:5].lower()
        similar = sorted(each for each in gymnasium.registry if each.lower().startswith(first))
        raise ValueError(f"gymnasium has no environment {name!r}; with similar names it has {similar}.")


def _register_robotics(needed: bool) -> None:
    try:
        import gymnasium_robotics
    except ImportError as error:
        if needed:
            raise ImportError("the Adroit hand needs Gymnasium-Robotics: pip install 'nht[hand]'.") from error
        return
    gymnasium.register_envs(gymnasium_robotics)


def _gym_env(name: str, info_keys: Sequence[str], options: dict[str, Any]) -> EnvBase:
    try:
        env = GymEnv(name, **options)
    except ModuleNotFoundError as error:
        raise ImportError(
            f"{name} needs {error.name}, which is not installed; Gymnasium's own MuJoCo tasks: "
            "pip install 'gymnasium[mujoco]'."
        ) from error
    except (TypeError, OverflowError) as error:
        told = shorten(str(error), 300).rstrip(".")
        raise ValueError(f"{name} cannot be made with the options {options}: {told}.") from error
    copy = gymnasium_copy(env)
    drawn_by_itself = type(copy) is GymnasiumCopy and "rgb_array" in copy.core.metadata.get(
        "render_modes", []
    )
    if drawn_by_itself and "render_mode" not in options:
        env.close()
        env = GymEnv(name, **options, render_mode="rgb_array")
        copy = gymnasium_copy(env)
    if isinstance(copy, NativeCopy):
        sizes = {key: size for key, size in copy.task.observation_sizes.items() if key != "observation"}
        return env.set_info_dict_reader(InfoReader(INFO_FLAGS, sizes))
    return env.set_info_dict_reader(InfoReader(("success",), _sizes(name, info_keys, options)))


def _sizes(name: str, keys: Sequence[str], options: dict[str, Any]) -> dict[str, int]:
    """The lengths of the entries of ``info`` after a reset, from an environment made for this."""
    if not keys:
        return {}
    with closing(gymnasium.make(name, **options)) as env:
        _, info = env.reset()
    if missing := [key for key in keys if key not in info]:
        raise KeyError(f"the info of {name} lacks {missing} after a reset; it has {list(info)}.")
    return {key: np.size(info[key]) for key in keys}
