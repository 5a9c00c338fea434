"""Tasks on batched MuJoCo, for TorchRL and for Gymnasium."""

from nht.envs.experts import Expert
from nht.envs.gymnasium_env import GYMNASIUM_IDS, GymnasiumEnv, register
from nht.envs.gymnasium_vector import GymnasiumVectorEnv
from nht.envs.mujoco_batch import BatchedMujocoEnv
from nht.envs.registry import EXPERTS, TASKS, make_env, make_expert, make_task
from nht.envs.task import BatchedTask, Outcome

__all__ = [
    "EXPERTS",
    "GYMNASIUM_IDS",
    "TASKS",
    "BatchedMujocoEnv",
    "BatchedTask",
    "Expert",
    "GymnasiumEnv",
    "GymnasiumVectorEnv",
    "Outcome",
    "make_env",
    "make_expert",
    "make_task",
]

register()
