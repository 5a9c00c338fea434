"""The table of tasks, and how to make one."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from nht.envs.arm import Arm
from nht.envs.arrays import Seed
from nht.envs.table import Table, imported

if TYPE_CHECKING:
    import torch

    from nht.envs.experts import Expert
    from nht.envs.mujoco_batch import BatchedMujocoEnv
    from nht.envs.task import BatchedTask

GOLDEN = Path(__file__).parent / "assets" / "golden"


@dataclass(frozen=True)
class TaskRecord:
    """The record of a task. Classes may be given as import paths, ``"module:Class"``, and are imported when needed.

    Attributes:
        task: the ``BatchedTask``.
        expert: its scripted demonstrator, if it has one.
        arm: the arm that does it, if it is one whose joint angles are observed as ``"joint_angle"``.
        context_keys: the observations that an action map sees unless told otherwise.
        gymnasium_id: None derives one from the name: ``"pour_tea"`` is ``"nht/PourTea-v0"``.
        max_episode_steps: the task's time limit, for Gymnasium; None leaves it to the task itself.
        golden: JSON file with the first steps that tests compare with, if there is one.
    """

    task: type[BatchedTask] | str
    expert: type[Expert] | str | None = None
    arm: Arm | str | None = None
    context_keys: tuple[str, ...] = ("observation",)
    gymnasium_id: str | None = None
    max_episode_steps: int | None = None
    golden: Path | None = None

    @property
    def task_class(self) -> type[BatchedTask]:
        """The task's class."""
        return imported(self.task) if isinstance(self.task, str) else self.task

    @property
    def expert_class(self) -> type[Expert] | None:
        """The expert's class."""
        return imported(self.expert) if isinstance(self.expert, str) else self.expert

    @property
    def kinematics(self) -> Arm | None:
        """The arm."""
        return imported(self.arm) if isinstance(self.arm, str) else self.arm

    @property
    def options(self) -> list[str]:
        """The arguments that the task takes."""
        return list(inspect.signature(self.task_class).parameters)

    @property
    def endings(self) -> dict[str, bool]:
        """The options that make an episode end at success and at failure, as far as the task has them."""
        return {
            name: True for name in ("terminate_on_success", "terminate_on_failure") if name in self.options
        }

    @property
    def has_success(self) -> bool:
        """Whether the task has a notion of success, that is, an option to end episodes there."""
        return "terminate_on_success" in self.endings


def _adopt(name: str, found: Any) -> TaskRecord:
    from nht.envs.task import BatchedTask

    if isinstance(found, TaskRecord):
        return found
    if isinstance(found, type) and issubclass(found, BatchedTask):
        return TaskRecord(found)
    raise TypeError(f"the task {name!r} must be a TaskRecord or a BatchedTask, got {found!r}.")


def _wam(module: str, task: str, expert: str, gymnasium_id: str, golden: str) -> TaskRecord:
    return TaskRecord(
        f"nht.envs.{module}:{task}",
        expert=f"nht.envs.experts:{expert}",
        arm="nht.envs.wam_kinematics:ARM",
        context_keys=("tool_position", "joint_angle"),
        gymnasium_id=gymnasium_id,
        max_episode_steps=200,
        golden=GOLDEN / golden,
    )


def _locomotion(task: str, name: str) -> TaskRecord:
    return TaskRecord(task, max_episode_steps=1_000, golden=GOLDEN / f"{name}.json")


TASKS: Table[TaskRecord] = Table(
    "nht.tasks",
    {
        "ant": _locomotion("nht.envs.ant:Ant", "ant"),
        "cheetah_run": _locomotion("nht.envs.cheetah:CheetahRun", "cheetah_run"),
        "half_cheetah": _locomotion("nht.envs.locomotion:HalfCheetah", "half_cheetah"),
        "hopper": _locomotion("nht.envs.locomotion:Hopper", "hopper"),
        "manipulator_bring_ball": TaskRecord(
            "nht.envs.manipulator:BringBall",
            context_keys=("arm_pos", "touch"),
            max_episode_steps=1_000,
            golden=GOLDEN / "manipulator_bring_ball.json",
        ),
        "walker2d": _locomotion("nht.envs.locomotion:Walker2d", "walker2d"),
        "wam_grasp": _wam("wam_grasp", "WAMGrasp", "GraspExpert", "nht/WAMGrasp-v0", "wam_grasp.json"),
        "wam_wipe": _wam("wam_wipe", "WAMWipe", "WipeExpert", "nht/WAMWipe-v0", "wam_wipe.json"),
    },
    _adopt,
)
"""Every task by the name that recipes and ``make_env`` use; packages add theirs as entry points ``nht.tasks``."""

FOREIGN: Mapping[str, str] = {
    "dm_control": "nht.envs.dm_control:make_dm_control",
    "gymnasium": "nht.envs.gymnasium_mujoco:make_gymnasium",
    "torchrl": "nht.envs.torchrl_env:make_torchrl",
}
"""Import paths of the functions that make other libraries' tasks, by the name of the library."""


class UnknownOptionError(ValueError, TypeError):
    """An option that does not exist: a ValueError for users of configurations, and a TypeError for Python code.

    TorchRL's ``GymEnv`` tries keywords of other environments and expects Python's usual TypeError as a refusal.
    """


def find_task(name: str) -> TaskRecord:
    """The record of a task.

    Args:
        name: a key of ``TASKS``, or an import path, ``"my_package.tasks:Pour"``.

    Raises:
        ValueError: for an unknown name; the message lists those that exist.
    """
    if name not in TASKS:
        raise ValueError(
            f"unknown environment {name!r}: choose from {sorted(TASKS)}, or name an import path, "
            "package.module:Task."
        )
    try:
        return TASKS[name]
    except (ImportError, TypeError) as error:
        reason = str(error).removesuffix(".")
        raise ValueError(f"the environment {name!r} cannot be found: {reason}.") from error


def make_task(name: str, **options: Any) -> BatchedTask:
    """Build the copies of a task.

    Args:
        name: a key of ``TASKS``, or an import path, ``"my_package.tasks:Pour"``.
        options: arguments of the task, e.g. ``num_envs=64, seed=0, start="random"``.

    Raises:
        ValueError: for an unknown name or option; the message lists those that exist.
    """
    task = find_task(name).task_class
    _check_options(task, options, name)
    return task(**options)


def make_env(
    name: str,
    num_envs: int = 1,
    num_threads: int = 1,
    seed: Seed = None,
    device: torch.device | str = "cpu",
    **options: Any,
) -> BatchedMujocoEnv:
    """A batch-native TorchRL environment of ``num_envs`` copies.

    Args:
        name: a key of ``TASKS``, e.g. ``"wam_wipe"``, or an import path, ``"my_package.tasks:Pour"``.
        num_envs: number of copies N, the environment's batch size.
        num_threads: native threads that share the copies.
        seed: seed of every random draw of the task; None draws one, so that no two environments are alike. With several
            seeds there are ``num_envs`` copies for each, whose draws are their own: the batch size is ``[seeds, N]``.
        device: where the tensors go.
        options: further arguments of the task, e.g. ``start="random"``.

    Raises:
        ValueError: for an unknown name or option; the message lists those that exist.
    """
    from nht.envs.mujoco_batch import BatchedMujocoEnv

    groups = len(seed) if isinstance(seed, Sequence) else None
    copies = num_envs * (groups or 1)
    task = make_task(name, num_envs=copies, num_threads=num_threads, seed=seed, **options)
    return BatchedMujocoEnv(task, device=device, groups=groups)


def make_expert(name: str, **settings: Any) -> Expert:
    """The scripted demonstrator of a task.

    Raises:
        ValueError: for a task without one, or an unknown setting.
    """
    expert = find_task(name).expert_class if name in TASKS else None
    if expert is None:
        having = sorted(task for task in TASKS if TASKS[task].expert is not None)
        raise ValueError(f"{name!r} has no scripted expert: {having} have one.")
    _check_options(expert, settings, f"the expert of {name}")
    return expert(**settings)


def _check_options(factory: type, options: dict[str, Any], name: str) -> None:
    known = list(inspect.signature(factory).parameters)
    for option in options:
        if option not in known:
            raise UnknownOptionError(
                f"{name} got an unexpected keyword argument {option!r}: its options are {known}."
            )
