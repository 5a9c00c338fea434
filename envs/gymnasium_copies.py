"""The simulator behind one ``GymEnv``: ours, MuJoCo's, or plain Python."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, TensorSpec, Unbounded
from torchrl.envs import EnvBase
from torchrl.envs.gym_like import BaseInfoDictReader

from nht.envs.foreign_copies import ForeignCopy
from nht.envs.gymnasium_internals import EpisodeClock
from nht.envs.mujoco_copy import Simulator
from nht.envs.python_state import PythonState
from nht.envs.simulation import CopyRenderer
from nht.envs.task import BatchedTask
from nht.envs.torchrl_internals import wrapped

FRAME_RATE = 30.0
"""Steps per second of simulated time, where an environment does not say."""


class InfoReader(BaseInfoDictReader):
    """Turns entries of ``info`` into observations; TorchRL's own reader fails on Python's bools.

    Args:
        flags: entries that are True or False; one that ``info`` lacks is False. ``info`` may call ``"success"``
            ``"is_success"``.
        entries: length of the others, numbers or vectors, by their key.
    """

    def __init__(self, flags: Sequence[str], entries: Mapping[str, int]) -> None:
        self.flags = tuple(flags)
        self.entries = dict(entries)

    def __call__(self, info_dict: dict[str, Any], tensordict: TensorDictBase) -> TensorDictBase:
        """Write the flags ``(1,)``, and the entries in float32."""
        for name in self.flags:
            value = info_dict.get(name, info_dict.get(f"is_{name}", False))
            tensordict.set(name, torch.tensor([bool(value)]))
        for name in self.entries:
            values = np.array(info_dict[name], dtype=np.float32).reshape(-1)
            tensordict.set(name, torch.from_numpy(values))
        return tensordict

    @property
    def info_spec(self) -> dict[str, TensorSpec]:
        """The specs of the entries that are written."""
        flags = {name: Binary(n=1, shape=(1,), dtype=torch.bool) for name in self.flags}
        return flags | {name: Unbounded((size,), dtype=torch.float32) for name, size in self.entries.items()}


class GymnasiumCopy(ForeignCopy):
    """An environment without MuJoCo: it can be saved if it consists of plain Python values only.

    Args:
        env: TorchRL's ``GymEnv``.
    """

    def __init__(self, env: EnvBase) -> None:
        self.env: gymnasium.Env[Any, Any] = wrapped(env)
        self.core = self.env.unwrapped
        readers = [reader for reader in env.info_dict_reader if isinstance(reader, InfoReader)]
        self.aside = [key for reader in readers for key in reader.entries]
        self.time_per_step = _time_per_step(self.core)
        self._clock = EpisodeClock(self.env)
        self.max_episode_steps = math.inf if self._clock.limit is None else self._clock.limit
        self._python = PythonState(self.env)
        unknown = self._python.unknown
        self.resume_obstacle = f"its simulator cannot be saved ({unknown})" if unknown else ""

    def state_dict(self) -> dict[str, Any]:
        """Generators, clock and attributes."""
        progress = {"random": self.core.np_random.bit_generator.state, "steps": self._clock.steps}
        return {"progress": progress, "python": self._python.state_dict()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        progress = saved["progress"]
        if "python" in saved:  # older files lack it
            self._python.load_state_dict(saved["python"])
        self.core.np_random.bit_generator.state = progress["random"]
        self._clock.steps = progress["steps"]

    def renderer(self, width: int, height: int, camera: str | int | None) -> CopyRenderer:
        """Takes the pictures that the environment itself draws, stretched to this size; there is no other camera.

        Raises:
            RuntimeError: if it draws none; the message says why.
        """
        if self.env.render_mode != "rgb_array":
            modes = self.env.metadata.get("render_modes", [])
            raise RuntimeError(
                "the environment cannot be drawn: it has no MuJoCo model, and was not made with "
                f"render_mode='rgb_array'; its render modes are {modes}."
            )
        from nht.envs.own_pictures import OwnRenderer

        return OwnRenderer(self.env.render, width, height, camera)


class MujocoGymnasiumCopy(GymnasiumCopy):
    """An environment of Gymnasium, or of Gymnasium-Robotics, on MuJoCo."""

    def __init__(self, env: EnvBase) -> None:
        super().__init__(env)
        self.resume_obstacle = ""
        self.simulator = Simulator(self.core.model, self.core.data)

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step and the next reset depend on."""
        return super().state_dict() | self.simulator.state_dict()

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        self.simulator.load_state_dict(saved)
        super().load_state_dict(saved)

    def renderer(self, width: int, height: int, camera: str | int | None) -> CopyRenderer:
        """Takes pictures of this size through a camera of the model."""
        return self.simulator.renderer(width, height, camera)


class NativeCopy(GymnasiumCopy):
    """One of our own tasks, made by its Gymnasium id."""

    def __init__(self, env: EnvBase) -> None:
        super().__init__(env)
        self.task: BatchedTask = self.core.task
        self.reward_range = self.task.reward_range
        self.resume_obstacle = self.task.resume_obstacle

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step and the next reset depend on."""
        return super().state_dict() | {"task": self.task.state_dict()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        super().load_state_dict(saved)
        self.task.load_state_dict(saved["task"])

    def renderer(self, width: int, height: int, camera: str | int | None) -> CopyRenderer:
        """Takes pictures of this size through a camera of the model."""
        from nht.envs.rendering import NativeRenderer

        return NativeRenderer(self.task.renderer(width, height, camera))


def gymnasium_copy(env: EnvBase) -> GymnasiumCopy:
    """The simulator behind a ``GymEnv``."""
    core = wrapped(env).unwrapped
    if isinstance(getattr(core, "task", None), BatchedTask):
        return NativeCopy(env)
    if isinstance(getattr(core, "data", None), mujoco.MjData):
        return MujocoGymnasiumCopy(env)
    return GymnasiumCopy(env)


def _time_per_step(core: gymnasium.Env[Any, Any]) -> float:
    """Simulated time of a step [s]: from the environment, one that it holds, as mazes do, or its frame rate."""
    for part in (core, *vars(core).values()):
        if isinstance(part, gymnasium.Env) and isinstance(dt := getattr(part, "dt", None), float):
            return dt
    return 1.0 / (core.metadata.get("render_fps") or FRAME_RATE)
