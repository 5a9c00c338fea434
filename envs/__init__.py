"""Tasks on batched MuJoCo, for TorchRL and for Gymnasium. Nothing is imported before it is asked for."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from nht.envs.arm import Arm
from nht.envs.gymnasium_ids import gymnasium_id, register
from nht.envs.registry import FOREIGN, TASKS, TaskRecord, make_env, make_expert, make_task

if TYPE_CHECKING:
    from nht.envs.dm_control import make_dm_control
    from nht.envs.experts import Expert
    from nht.envs.foreign import ForeignEnv
    from nht.envs.gymnasium_env import GymnasiumEnv
    from nht.envs.gymnasium_mujoco import make_gymnasium
    from nht.envs.gymnasium_vector import GymnasiumVectorEnv
    from nht.envs.mujoco_batch import BatchedMujocoEnv
    from nht.envs.outcome import Outcome
    from nht.envs.simulation import Simulation
    from nht.envs.task import BatchedTask
    from nht.envs.torchrl_env import make_torchrl

__all__ = [
    "FOREIGN",
    "TASKS",
    "Arm",
    "BatchedMujocoEnv",
    "BatchedTask",
    "Expert",
    "ForeignEnv",
    "GymnasiumEnv",
    "GymnasiumVectorEnv",
    "Outcome",
    "Simulation",
    "TaskRecord",
    "gymnasium_id",
    "make_dm_control",
    "make_env",
    "make_expert",
    "make_gymnasium",
    "make_task",
    "make_torchrl",
]

_MODULES = {
    "BatchedMujocoEnv": "mujoco_batch",
    "BatchedTask": "task",
    "Expert": "experts",
    "ForeignEnv": "foreign",
    "GymnasiumEnv": "gymnasium_env",
    "GymnasiumVectorEnv": "gymnasium_vector",
    "Outcome": "outcome",
    "Simulation": "simulation",
    "make_dm_control": "dm_control",
    "make_gymnasium": "gymnasium_mujoco",
    "make_torchrl": "torchrl_env",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}.")
    found = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return __all__


register()
