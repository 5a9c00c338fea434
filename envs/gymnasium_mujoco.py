"""Gymnasium's MuJoCo environments through TorchRL's ``GymEnv``, the Adroit hand of Gymnasium-Robotics among them."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import gymnasium
import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, TensorSpec
from torchrl.envs import EnvBase, GymEnv
from torchrl.envs.gym_like import BaseInfoDictReader

from nht.envs.foreign import ForeignEnv, MujocoCopy


def make_gymnasium(
    name: str, num_envs: int = 1, seed: int = 0, device: torch.device | str = "cpu", **options: Any
) -> ForeignEnv:
    """Copies of a MuJoCo environment that ``gymnasium.make`` knows, or that Gymnasium-Robotics brings.

    Args:
        name: its id, ``"AdroitHandRelocate-v1"``.
        num_envs: number of copies.
        seed: seed of every random draw of the environment.
        device: where the tensors go.
        options: further arguments of ``gymnasium.make``.

    Raises:
        ImportError: if the environment is one of Gymnasium-Robotics, which is not installed.
        ValueError: for an id that does not exist, with some that do, and for environments without MuJoCo.
    """
    _check_id(name)
    return ForeignEnv(partial(_gym_env, name, options), GymnasiumCopy, num_envs, seed, device)


def _check_id(name: str) -> None:
    if name not in gymnasium.registry:
        _register_robotics(needed="Adroit" in name)
    if name not in gymnasium.registry:
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


def _gym_env(name: str, options: dict[str, Any]) -> EnvBase:
    env = GymEnv(name, **options)
    if not hasattr(env._env.unwrapped, "data"):
        raise ValueError(f"{name} is no MuJoCo environment: its simulator could be neither saved nor drawn.")
    return env.set_info_dict_reader(SuccessReader())


class SuccessReader(BaseInfoDictReader):
    """Takes ``info["success"]``, where there is one; TorchRL's own reader stumbles over Python's bools."""

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        """Write ``"success"`` ``(1,)``."""
        return tensordict.set("success", torch.tensor([bool(info_dict.get("success", False))]))

    @property
    def info_spec(self) -> dict[str, TensorSpec]:
        """What is written."""
        return {"success": Binary(n=1, shape=(1,), dtype=torch.bool)}


class GymnasiumCopy(MujocoCopy):
    """The simulator behind one ``GymEnv``."""

    def __init__(self, env: EnvBase) -> None:
        self._env = env._env  # Gymnasium's own, in its wrappers
        self._core = self._env.unwrapped
        self.model, self.data = self._core.model, self._core.data
        self.time_per_step = self._core.dt
        self._clock = _time_limit(self._env)
        self.max_episode_steps = math.inf if self._clock is None else self._clock._max_episode_steps

    def progress(self) -> dict[str, Any]:
        """Generator and clock."""
        steps = None if self._clock is None else self._clock._elapsed_steps
        return {"random": self._core.np_random.bit_generator.state, "steps": steps}

    def set_progress(self, saved: dict[str, Any]) -> None:
        """Go on from what ``progress`` returned."""
        self._core.np_random.bit_generator.state = saved["random"]
        if self._clock is not None:
            self._clock._elapsed_steps = saved["steps"]


def _time_limit(env: gymnasium.Env[Any, Any]) -> gymnasium.wrappers.TimeLimit[Any, Any] | None:
    while isinstance(env, gymnasium.Wrapper):
        if isinstance(env, gymnasium.wrappers.TimeLimit):
            return env
        env = env.env
    return None
