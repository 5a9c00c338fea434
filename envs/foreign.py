"""Environments of other libraries, made into what the recipes ask for.

They are stepped by TorchRL's own wrappers, one copy after the other. What is added here: flat observations in float32,
the flags ``success``, ``failure`` and ``diverged``, a batch dimension, and a way to save and draw the simulators.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import Any, ClassVar

import mujoco
import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.data import Binary, Composite
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.transforms import (
    CatTensors,
    Compose,
    DoubleToFloat,
    FlattenObservation,
    StepCounter,
    Transform,
)

from nht.envs.task import Array

LONGEST_EPISODE = 1_000
"""Environment steps after which an episode is truncated where the environment itself knows no limit."""
FLAGS = ("success", "failure", "diverged")


class MujocoCopy(ABC):
    """The simulator behind one copy of an environment.

    Args:
        env: TorchRL's wrapper.
    """

    model: mujoco.MjModel
    data: mujoco.MjData
    time_per_step: float
    """Simulated time of one environment step [s]."""
    max_episode_steps: float
    """Environment steps in an episode, or infinity."""

    # Large, and the same in all episodes.
    _fixed: ClassVar[tuple[str, ...]] = ("bvh_", "mesh_", "skin_", "tex_")

    @abstractmethod
    def __init__(self, env: EnvBase) -> None: ...

    @abstractmethod
    def progress(self) -> dict[str, Any]:
        """What the library keeps beside the simulator: generator and clock of the episode."""

    @abstractmethod
    def set_progress(self, saved: dict[str, Any]) -> None:
        """Go on from what ``progress`` returned."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step and the next reset depend on."""
        state = np.empty(mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_INTEGRATION))
        mujoco.mj_getState(self.model, self.data, state, mujoco.mjtState.mjSTATE_INTEGRATION)
        model = {name: values.copy() for name, values in self._model_arrays().items()}
        return {"state": state, "model": model, "progress": self.progress()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        for name, values in self._model_arrays().items():
            values[...] = saved["model"][name]
        integration = mujoco.mjtState.mjSTATE_INTEGRATION
        mujoco.mj_setState(self.model, self.data, saved["state"], integration)
        # dm_control's steps start from positions and velocities that were propagated already.
        mujoco.mj_step1(self.model, self.data)
        mujoco.mj_setState(self.model, self.data, saved["state"], integration)
        self.set_progress(saved["progress"])

    def _model_arrays(self) -> dict[str, Array]:
        """What a task may change in its model when an episode starts: places, sizes, gains ..."""
        arrays = {
            name: getattr(self.model, name) for name in dir(self.model) if not name.startswith(self._fixed)
        }
        return {
            name: values
            for name, values in arrays.items()
            if isinstance(values, np.ndarray) and np.issubdtype(values.dtype, np.floating)
        }


class ForeignTask:
    """What recipes ask of the simulators of all copies; the counterpart of ``BatchedTask``."""

    def __init__(self, copies: list[MujocoCopy], observation_sizes: dict[str, int]) -> None:
        self.copies = copies
        self.observation_sizes = observation_sizes
        self.num_envs = len(copies)
        self.time_per_step = copies[0].time_per_step
        limit = copies[0].max_episode_steps
        self.max_episode_steps = LONGEST_EPISODE if math.isinf(limit) else round(limit)

    def state_dict(self) -> dict[str, Any]:
        """Everything a later ``load_state_dict`` needs to go on bit for bit."""
        return {f"copy{i}": copy.state_dict() for i, copy in enumerate(self.copies)}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        for i, copy in enumerate(self.copies):
            copy.load_state_dict(saved[f"copy{i}"])


class ForeignEnv(SerialEnv):
    """N copies of a single environment, stepped one after the other: batch size ``[N]``.

    Every observation is flat and in float32; ``"observation"`` is all of them side by side, in the order of the
    environment. ``"success"`` is what the environment says of itself, if it does; ``"failure"`` and ``"diverged"``
    are never set.

    Args:
        make: builds one copy, TorchRL's wrapper of batch size ``[]``.
        simulator: finds the simulator in what ``make`` built.
        num_envs: number of copies N, at least 1.
        seed: seed of every random draw of the environments.
        device: where the tensors go.

    Raises:
        ValueError: if ``num_envs`` is below 1.
    """

    task: ForeignTask

    def __init__(
        self,
        make: Callable[[], EnvBase],
        simulator: Callable[[EnvBase], MujocoCopy],
        num_envs: int = 1,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}.")
        super().__init__(num_envs, partial(_flat, make, simulator), device=device)
        self.start()
        sizes = {
            key: spec.shape[-1] for key, spec in self.observation_spec.items() if spec.dtype == torch.float32
        }
        self.task = ForeignTask([simulator(env.base_env) for env in self._envs], sizes)
        self.set_seed(seed)


def _flat(make: Callable[[], EnvBase], simulator: Callable[[EnvBase], MujocoCopy]) -> TransformedEnv:
    env = make()
    keys = [key for key in env.observation_spec if key != "success"]
    transforms: list[Transform] = [
        FlattenObservation(first_dim=0, last_dim=-1, in_keys=[key], allow_positive_dim=True)
        for key in keys
        if len(env.observation_spec[key].shape) > 1
    ]
    transforms.append(DoubleToFloat())
    if keys != ["observation"]:
        transforms.append(CatTensors(keys, "observation", del_keys=False, sort=False))
    if math.isinf(simulator(env).max_episode_steps):
        transforms.append(StepCounter(LONGEST_EPISODE))
    return TransformedEnv(env, Compose(*transforms, OutcomeFlags()))


class OutcomeFlags(Transform):
    """Adds the flags that every environment of ours has and this one lacks; they are never set."""

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        unset = torch.zeros(*next_tensordict.batch_size, 1, dtype=torch.bool, device=next_tensordict.device)
        for name in FLAGS:
            if name not in next_tensordict:
                next_tensordict[name] = unset.clone()
        return next_tensordict

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Registers the flags: collectors drop what is not in the specs."""
        shape = (*observation_spec.shape, 1)
        for name in FLAGS:
            observation_spec[name] = Binary(
                n=1, shape=shape, dtype=torch.bool, device=observation_spec.device
            )
        return observation_spec
