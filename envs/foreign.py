"""Adapts environments of other libraries to what the recipes need.

They are stepped by TorchRL's own wrappers, one copy after the other. What is added here: flat observations in float32,
the flags ``success``, ``failure`` and ``diverged``, a batch dimension, and a way to save and draw the simulators.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torchrl.envs import EnvBase, SerialEnv

from nht.envs.flat_env import flattened
from nht.envs.foreign_copies import ForeignCopy, ForeignTask
from nht.envs.mujoco_log import warnings_logged
from nht.envs.pictures import Pictures, check_mode
from nht.envs.simulation import DEFAULT_SIZE
from nht.envs.torchrl_internals import members


class ForeignEnv(SerialEnv):
    """N copies of a single environment, stepped one after the other: batch size ``[N]``.

    Every observation is flat and in float32; ``"observation"`` is all of them side by side, in the order of the
    environment. ``"success"`` comes from the environment, if it reports it; ``"failure"`` and ``"diverged"`` are never
    set, unless the environment is one of ours. Actions come in float32, whatever precision the environment takes them
    in.

    Partial steps touch only the copies that ``"_step"`` names: the others return the same observation again, with the
    reward 0.

    It can be copied and pickled where ``task.can_resume``; a copy goes on bit for bit like the original.

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
        super().__init__(num_envs, partial(flattened, make, simulator, name), device=device)
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
    """Rebuild an environment that was copied or pickled."""
    env = ForeignEnv(make, simulator, num_envs, None, device, name)
    if shown is not None:
        env.reset()  # makes what an environment makes at its first reset
    env.task.load_state_dict(saved)
    env._shown = shown
    return env
