"""The table of tasks by name, and how to make one."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch

from nht.envs.ant import Ant
from nht.envs.cheetah import CheetahRun
from nht.envs.dm_control import make_dm_control
from nht.envs.experts import Expert, GraspExpert, WipeExpert
from nht.envs.foreign import ForeignEnv
from nht.envs.gymnasium_mujoco import make_gymnasium
from nht.envs.locomotion import HalfCheetah, Hopper, Walker2d
from nht.envs.manipulator import BringBall
from nht.envs.mujoco_batch import BatchedMujocoEnv
from nht.envs.task import BatchedTask
from nht.envs.wam_grasp import WAMGrasp
from nht.envs.wam_wipe import WAMWipe

TASKS: dict[str, type[BatchedTask]] = {
    "ant": Ant,
    "cheetah_run": CheetahRun,
    "half_cheetah": HalfCheetah,
    "hopper": Hopper,
    "manipulator_bring_ball": BringBall,
    "walker2d": Walker2d,
    "wam_grasp": WAMGrasp,
    "wam_wipe": WAMWipe,
}
"""Every task by the name that recipes and ``make_env`` use."""

EXPERTS: dict[str, type[Expert]] = {"wam_grasp": GraspExpert, "wam_wipe": WipeExpert}
"""The scripted demonstrator of every task that has one."""

FOREIGN: dict[str, Callable[..., ForeignEnv]] = {"dm_control": make_dm_control, "gymnasium": make_gymnasium}
"""What makes the tasks of other libraries, by the name of the library."""


class UnknownOptionError(ValueError, TypeError):
    """An option that does not exist: a bad value to whoever wrote a configuration, a TypeError to Python.

    TorchRL's ``GymEnv`` tries keywords of other environments and takes only Python's usual answer for a no.
    """


def make_task(name: str, **options: Any) -> BatchedTask:
    """Build the copies of a task.

    Args:
        name: a key of ``TASKS``.
        options: arguments of the task, e.g. ``num_envs=64, seed=0, start="random"``.

    Raises:
        ValueError: for an unknown name or option; the message lists those that exist.
    """
    if name not in TASKS:
        raise ValueError(f"unknown environment {name!r}: choose from {sorted(TASKS)}.")
    _check_options(TASKS[name], options, name)
    return TASKS[name](**options)


def make_env(
    name: str,
    num_envs: int = 1,
    num_threads: int = 1,
    seed: int = 0,
    device: torch.device | str = "cpu",
    **options: Any,
) -> BatchedMujocoEnv:
    """A batch-native TorchRL environment of ``num_envs`` copies.

    Args:
        name: a key of ``TASKS``, e.g. ``"wam_wipe"``.
        num_envs: number of copies N, the environment's batch size.
        num_threads: native threads that share the copies.
        seed: seed of every random draw of the task.
        device: where the tensors go.
        options: further arguments of the task, e.g. ``start="random"``.

    Raises:
        ValueError: for an unknown name or option; the message lists those that exist.
    """
    task = make_task(name, num_envs=num_envs, num_threads=num_threads, seed=seed, **options)
    return BatchedMujocoEnv(task, device=device)


def make_expert(name: str, **settings: Any) -> Expert:
    """The scripted demonstrator of a task.

    Raises:
        ValueError: for a task without one, or an unknown setting.
    """
    if name not in EXPERTS:
        raise ValueError(f"{name!r} has no scripted expert: {sorted(EXPERTS)} have one.")
    _check_options(EXPERTS[name], settings, f"the expert of {name}")
    return EXPERTS[name](**settings)


def _check_options(factory: type, options: dict[str, Any], name: str) -> None:
    known = list(inspect.signature(factory).parameters)
    for option in options:
        if option not in known:
            raise UnknownOptionError(
                f"{name} got an unexpected keyword argument {option!r}: its options are {known}."
            )
