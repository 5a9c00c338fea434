"""Tasks on batched MuJoCo, for TorchRL and for Gymnasium."""

from nht.envs.dm_control import make_dm_control
from nht.envs.experts import Expert
from nht.envs.foreign import ForeignEnv
from nht.envs.gymnasium_env import GYMNASIUM_IDS, GymnasiumEnv, register
from nht.envs.gymnasium_mujoco import make_gymnasium
from nht.envs.gymnasium_vector import GymnasiumVectorEnv
from nht.envs.mujoco_batch import BatchedMujocoEnv
from nht.envs.registry import EXPERTS, FOREIGN, TASKS, make_env, make_expert, make_task
from nht.envs.task import BatchedTask, Outcome

__all__ = [
    "EXPERTS",
    "FOREIGN",
    "GYMNASIUM_IDS",
    "TASKS",
    "BatchedMujocoEnv",
    "BatchedTask",
    "Expert",
    "ForeignEnv",
    "GymnasiumEnv",
    "GymnasiumVectorEnv",
    "Outcome",
    "make_dm_control",
    "make_env",
    "make_expert",
    "make_gymnasium",
    "make_task",
]

register()
