"""Environments of other libraries, made into what the recipes ask for.

They are stepped by TorchRL's own wrappers, one copy after the other. What is added here: flat observations in float32,
the flags ``success``, ``failure`` and ``diverged``, a batch dimension, and a way to save and draw the simulators.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.data import Binary, Composite
from torchrl.envs import EnvBase, SerialEnv, TransformedEnv
from torchrl.envs.transforms import (
    CatTensors,
    Compose,
    DTypeCastTransform,
    FlattenObservation,
    StepCounter,
    Transform,
    UnsqueezeTransform,
)

from nht.envs.foreign_specs import check_specs
from nht.envs.mujoco_log import warnings_logged
from nht.envs.pictures import Pictures, check_mode
from nht.envs.simulation import DEFAULT_SIZE, CopyRenderer
from nht.envs.torchrl_internals import members

LONGEST_EPISODE = 1_000
"""Environment steps after which an episode is truncated where the environment itself knows no limit."""
FLAGS = ("success", "failure", "diverged")
UNSEEN = ("step_count",)
"""What is no observation: TorchRL's own clock."""


class ForeignCopy(ABC):
    """The simulator behind one copy of an environment."""

    time_per_step: float
    """Simulated time of one environment step [s]."""
    max_episode_steps: float = math.inf
    """Environment steps in an episode, or infinity: where the environment knows no limit, it gets one."""
    longest_episode: int | None = None
    """That limit; None is ``LONGEST_EPISODE``."""
    reward_range: tuple[float, float] = (-math.inf, math.inf)
    """Smallest and largest reward of a step."""
    aside: Sequence[str] = ()
    """Observations that are not part of ``"observation"``."""
    resume_obstacle: str = ""
    """Why the copy cannot be saved whole, a part of a sentence; ``""`` where it can."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Everything that the next step and the next reset depend on, as far as it can be saved."""

    @abstractmethod
    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""

    @abstractmethod
    def renderer(self, width: int, height: int, camera: str | int | None) -> CopyRenderer:
        """Takes pictures of this copy, of this size [pixel].

        Raises:
            RuntimeError: if it cannot be drawn; the message says why.
        """


class ForeignTask:
    """What recipes ask of the simulators of all copies, a ``Simulation``; the counterpart of ``BatchedTask``."""

    def __init__(self, copies: Sequence[ForeignCopy], observation_sizes: dict[str, int]) -> None:
        self.copies = list(copies)
        self.observation_sizes = observation_sizes
        self.num_envs = len(copies)
        self.time_per_step = copies[0].time_per_step
        self.reward_range = copies[0].reward_range
        limit = copies[0].max_episode_steps
        self.max_episode_steps = _longest(copies[0]) if math.isinf(limit) else round(limit)

    @property
    def can_resume(self) -> bool:
        """Whether a loaded state goes on bit for bit."""
        return not self.resume_obstacle

    @property
    def resume_obstacle(self) -> str:
        """Why not, a part of a sentence; ``""`` where it does."""
        return self.copies[0].resume_obstacle

    def state_dict(self) -> dict[str, Any]:
        """Everything a later ``load_state_dict`` needs to go on bit for bit, as far as it can be saved."""
        return {f"copy{i}": copy.state_dict() for i, copy in enumerate(self.copies)}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        for i, copy in enumerate(self.copies):
            copy.load_state_dict(saved.get(f"copy{i}", {}))

    def renderer(
        self, width: int = DEFAULT_SIZE[0], height: int = DEFAULT_SIZE[1], camera: str | int | None = None
    ) -> ForeignRenderer:
        """Takes pictures of the copies, of this size [pixel]; None is the first camera.

        Raises:
            RuntimeError: if the environment, or this machine, cannot draw; the message says what is missing.
        """
        return ForeignRenderer(self, width, height, camera)


class ForeignRenderer:
    """Renders copies of an environment of another library, each on its own: their models may differ.

    Args:
        task: the simulators to look at.
        width: picture width [pixel].
        height: picture height [pixel].
        camera: name or number of a camera, where there is a choice; None is the first one.

    Raises:
        RuntimeError: if the environment, or this machine, cannot draw; the message says what is missing.
        ValueError: if there is no such camera.
    """

    def __init__(self, task: ForeignTask, width: int, height: int, camera: str | int | None) -> None:
        self._renderers = [copy.renderer(width, height, camera) for copy in task.copies]

    def frame(self, row: int = 0, trail: NDArray[np.float64] | None = None) -> NDArray[np.uint8]:
        """The copy ``row`` as it stands now; as of ``Renderer``."""
        return self._renderers[row].frame(trail)

    def close(self) -> None:
        """Release the renderers of all copies."""
        for renderer in self._renderers:
            renderer.close()


class ForeignEnv(SerialEnv):
    """N copies of a single environment, stepped one after the other: batch size ``[N]``.

    Every observation is flat and in float32; ``"observation"`` is all of them side by side, in the order of the
    environment. ``"success"`` is what the environment says of itself, if it does; ``"failure"`` and ``"diverged"``
    are never set, unless the environment is one of ours. Actions come in float32, whatever precision the environment
    takes them in.

    Partial steps touch only the copies that ``"_step"`` names: the others show what they showed, with the reward 0.

    It can be copied and pickled where ``task.can_resume``: what comes of it goes on bit for bit.

    Args:
        make: builds one copy, TorchRL's wrapper of batch size ``[]``.
        simulator: finds the simulator in what ``make`` built.
        num_envs: number of copies N, at least 1.
        seed: seed of every random draw of the environments; None draws one, so that no two environments are alike.
        device: where the tensors go.
        name: of the environment, for messages.

    Raises:
        ValueError: if ``num_envs`` is below 1, or for observations or actions that are not flat numbers.
    """

    task: ForeignTask

    @warnings_logged()
    def __init__(
        self,
        make: Callable[[], EnvBase],
        simulator: Callable[[EnvBase], ForeignCopy],
        num_envs: int = 1,
        seed: int | None = None,
        device: torch.device | str = "cpu",
        name: str = "the environment",
    ) -> None:
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, got {num_envs}.")
        super().__init__(num_envs, partial(_flat, make, simulator, name), device=device)
        self.start()
        sizes = {
            key: spec.shape[-1] for key, spec in self.observation_spec.items() if spec.dtype == torch.float32
        }
        self.task = ForeignTask([env.copy_of for env in members(self)], sizes)
        self._recipe = (make, simulator, num_envs, name)
        self._shown: TensorDictBase | None = None
        self._pictures = Pictures(self.task)
        self.set_seed(int(np.random.SeedSequence().generate_state(1)[0] >> 1) if seed is None else seed)

    @warnings_logged()
    def _reset(self, tensordict: TensorDictBase | None = None, **options: Any) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        started = super()._reset(tensordict, **options)
        shown = started.clone()
        if mask is not None and self._shown is not None:
            going_on = ~mask.view(-1)
            shown[going_on] = self._shown[going_on]
        self._shown = shown
        return started

    @warnings_logged()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        mask = tensordict.get("_step", None)
        stepped = super()._step(tensordict)
        if mask is not None and not mask.all() and self._shown is not None:
            # TorchRL fills in what the caller showed: what transforms have made of that they would do once more.
            still = ~mask.view(-1)
            stepped[still] = self._shown[still]
            stepped["reward"][still] = 0.0
        self._shown = stepped.exclude("reward").clone()
        return stepped

    def render(
        self,
        mode: str = "rgb_array",
        width: int = DEFAULT_SIZE[0],
        height: int = DEFAULT_SIZE[1],
        camera: str | int | None = None,
    ) -> NDArray[np.uint8]:
        """A picture of every copy as it stands now, ``(N, height, width, 3)``.

        Arguments as of ``BatchedMujocoEnv.render``.

        Raises:
            RuntimeError: if the environment, or this machine, cannot draw; the message says what is missing.
            ValueError: for another mode, or if there is no such camera.
        """
        check_mode(mode)
        return self._pictures.take(width, height, camera)

    def close(self, *, raise_if_closed: bool = False) -> None:
        """Release the renderers and the copies."""
        self._pictures.close()
        super().close(raise_if_closed=raise_if_closed)

    def __reduce__(self) -> tuple[Any, ...]:
        if not self.task.can_resume:
            raise TypeError(
                f"{self._recipe[-1]} can be neither copied nor pickled: {self.task.resume_obstacle}. "
                "Hand over a function that makes it."
            )
        device = "cpu" if self.device is None else self.device
        shown = None if self._shown is None else self._shown.clone()
        return _restored, (*self._recipe, device, self.task.state_dict(), shown)


def _restored(
    make: Callable[[], EnvBase],
    simulator: Callable[[EnvBase], ForeignCopy],
    num_envs: int,
    name: str,
    device: torch.device | str,
    saved: dict[str, Any],
    shown: TensorDictBase | None,
) -> ForeignEnv:
    """The environment that was copied or pickled."""
    env = ForeignEnv(make, simulator, num_envs, None, device, name)
    if shown is not None:
        env.reset()  # makes what an environment makes at its first reset
    env.task.load_state_dict(saved)
    env._shown = shown
    return env


def _flat(make: Callable[[], EnvBase], simulator: Callable[[EnvBase], ForeignCopy], name: str) -> FlatEnv:
    env = make()
    check_specs(env, name)
    copy = simulator(env)
    aside = {*FLAGS, *UNSEEN, *copy.aside}
    keys = [key for key in env.observation_spec if key not in aside]
    shapes = {key: env.observation_spec[key].shape for key in (*keys, *copy.aside)}
    transforms: list[Transform] = [
        _as_vector(key, len(shape)) for key, shape in shapes.items() if len(shape) != 1
    ]
    specs = [*env.observation_spec.values(), env.full_reward_spec[env.reward_key], env.action_spec]
    # In this order always, whatever a set's is.
    for precision in sorted({spec.dtype for spec in specs if spec.dtype.is_floating_point}, key=str):
        if precision != torch.float32:
            transforms.append(DTypeCastTransform(precision, torch.float32))
    if keys != ["observation"]:
        transforms.append(CatTensors(keys, "observation", del_keys=False, sort=False))
    if math.isinf(copy.max_episode_steps):
        transforms.append(StepCounter(_longest(copy)))
    flat = FlatEnv(env, Compose(*transforms, OutcomeFlags()))
    flat.copy_of = copy
    return flat


def _longest(copy: ForeignCopy) -> int:
    return LONGEST_EPISODE if copy.longest_episode is None else copy.longest_episode


class FlatEnv(TransformedEnv):
    """One copy as ``ForeignEnv`` steps it."""

    copy_of: ForeignCopy
    """Its simulator."""


def _as_vector(key: str, dimensions: int) -> Transform:
    if dimensions == 0:
        return UnsqueezeTransform(-1, in_keys=[key], allow_positive_dim=True)
    return FlattenObservation(first_dim=0, last_dim=-1, in_keys=[key], allow_positive_dim=True)


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
            if name not in list(observation_spec.keys()):
                observation_spec[name] = Binary(
                    n=1, shape=shape, dtype=torch.bool, device=observation_spec.device
                )
        return observation_spec
