"""Parts of TorchRL and tensordict that are not public, each with what it relies on; the only place that uses them."""

from __future__ import annotations

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase, SerialEnv


class WholeSteps(EnvBase):
    """An environment whose ``_step`` writes every entry itself, each in its right shape.

    Relies on ``EnvBase.step`` handing what ``_step`` returns to ``_step_proc_data``, which looks for missing flags and
    wrong shapes, returns the same TensorDict, and takes a sixth of the time of a small task's step.
    """

    def _step_proc_data(self, next_tensordict_out: TensorDictBase) -> TensorDictBase:
        return next_tensordict_out


def packed(entries: dict[str, Tensor], batch_size: torch.Size, device: torch.device | None) -> TensorDict:
    """A TensorDict of tensors whose shapes and device are known to be right and are not checked.

    Relies on ``TensorDict._new_unsafe(source, batch_size=..., device=...)``.
    """
    return TensorDict._new_unsafe(entries, batch_size=batch_size, device=device)


def wrapped(env: EnvBase) -> Any:
    """The other library's environment in a wrapper of TorchRL (``GymEnv``, ``DMControlEnv``).

    Relies on ``_EnvWrapper._env``.
    """
    return env._env


def members(env: SerialEnv) -> list[EnvBase]:
    """The environments that a started ``SerialEnv`` steps, in their order. Relies on ``SerialEnv._envs``."""
    return list(env._envs)
