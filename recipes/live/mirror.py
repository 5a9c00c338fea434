"""A copy of a running simulator's state, to be looked at: poses, the tool, and what the motors do to it."""

from __future__ import annotations

from typing import Any, Protocol

import mujoco
import numpy as np
from torchrl.envs import EnvBase

from nht.envs.arrays import Array
from nht.envs.foreign_copies import ForeignTask
from nht.envs.gymnasium_copies import NativeCopy
from nht.envs.task import BatchedTask


class Source(Protocol):
    """A simulator that steps elsewhere."""

    model: mujoco.MjModel

    def copy_into(self, data: mujoco.MjData) -> None:
        """Write its state into ``data``."""

    def decorate(self, scene: mujoco.MjvScene) -> None:
        """Add what the model does not hold: goals, marks."""


class TaskSource:
    """The one copy of a task of ours."""

    def __init__(self, task: BatchedTask) -> None:
        self._task = task
        self.model = task.model

    def copy_into(self, data: mujoco.MjData) -> None:
        """Write its state into ``data``."""
        mujoco.mj_setState(self.model, data, self._task.state[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)

    def decorate(self, scene: mujoco.MjvScene) -> None:
        """Add what the model does not hold."""
        self._task.decorate(scene, 0)


class ForeignSource:
    """The simulator of another library's environment."""

    def __init__(self, simulator: Any) -> None:
        self._simulator = simulator
        self.model = simulator.model

    def copy_into(self, data: mujoco.MjData) -> None:
        """Write its state into ``data``."""
        kind = mujoco.mjtState.mjSTATE_INTEGRATION
        state = np.empty(mujoco.mj_stateSize(self.model, kind))
        mujoco.mj_getState(self.model, self._simulator.data, state, kind)
        mujoco.mj_setState(self.model, data, state, kind)

    def decorate(self, scene: mujoco.MjvScene) -> None:
        """Nothing: all is in the model."""


def source_of(base: EnvBase, name: str) -> Source:
    """The simulator behind an environment.

    Args:
        base: the task itself.
        name: of the task, for the message.

    Raises:
        ValueError: if it is not MuJoCo's.
    """
    task = getattr(base, "task", None)
    if isinstance(task, BatchedTask):
        return TaskSource(task)
    if isinstance(task, ForeignTask):
        copy = task.copies[0]
        if isinstance(copy, NativeCopy):
            return TaskSource(copy.task)
        simulator = getattr(copy, "simulator", None)
        if simulator is not None:
            return ForeignSource(simulator)
    raise ValueError(
        f"{name} has no MuJoCo model to draw: steer shows tasks of the table, and those of Gymnasium and dm_control on "
        "MuJoCo."
    )


class Mirror:
    """Poses of a running simulator.

    Args:
        source: the simulator.

    Attributes:
        model: the simulator's own.
        data: the state when it was last looked at, with all that follows from it.
        root: the robot's first body, if nothing keeps it in its place.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.model = source.model
        self.data = mujoco.MjData(self.model)
        self._scene = mujoco.MjvScene(self.model, maxgeom=200)
        self._before = self._latest = np.array(self.data.qpos)
        self.root = root_that_goes_about(self.model)
        self.jump()
        self._home = np.zeros(3) if self.root is None else np.array(self.data.subtree_com[self.root])

    def jump(self) -> None:
        """Copy the state as it stands now, after a jump in time: there is no way from the one before."""
        self._source.copy_into(self.data)
        self._before = self._latest = np.array(self.data.qpos)
        mujoco.mj_forward(self.model, self.data)

    def look(self, part: float = 1.0) -> None:
        """Copy the state as it stands now, or a pose on the way to it.

        Args:
            part: of the way from the state before the last step, in 0 .. 1; so slow steps look smooth.
        """
        self._source.copy_into(self.data)
        if not np.array_equal(self.data.qpos, self._latest):
            self._before, self._latest = self._latest, np.array(self.data.qpos)
        if part < 1.0:
            way = np.zeros(self.model.nv)
            mujoco.mj_differentiatePos(self.model, way, 1.0, self._before, self._latest)
            pose = self._before.copy()
            mujoco.mj_integratePos(self.model, pose, way, part)
            self.data.qpos[:] = pose
        mujoco.mj_forward(self.model, self.data)

    def moving_parts(self) -> tuple[Array, float]:
        """Centre ``(3,)`` and radius [m] of what can move, as it stands now: of the robot, without floor and tables."""
        moves = self.model.body_weldid[self.model.geom_bodyid] != 0
        if not moves.any():
            return np.array(self.model.stat.center), float(self.model.stat.extent)
        places, reach = self.data.geom_xpos[moves], self.model.geom_rbound[moves][:, None]
        low, high = (places - reach).min(axis=0), (places + reach).max(axis=0)
        return (low + high) / 2, float(np.linalg.norm(high - low)) / 2

    def walked(self) -> Array:
        """How far a robot that goes about has come from where it was first seen, ``(3,)`` [m]; along the floor."""
        if self.root is None:
            return np.zeros(3)
        now = np.array(self.data.subtree_com[self.root])
        return np.array([*(now - self._home)[:2], 0.0])

    def marks(self) -> list[mujoco.MjvGeom]:
        """What the task adds to the scene: goals, marks. Valid until the next call."""
        self._scene.ngeom = 0
        self._source.decorate(self._scene)
        return list(self._scene.geoms[: self._scene.ngeom])


def root_that_goes_about(model: mujoco.MjModel) -> int | None:
    """The first body of the robot, if it is free, or slides without limits; None for an arm on its base, or a cart."""
    on_joints = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    moved = model.jnt_bodyid[model.actuator_trnid[on_joints, 0]]
    for root in sorted(set(map(int, model.body_rootid[moved]))):
        first = model.body_jntadr[root]
        for joint in range(first, first + model.body_jntnum[root]):
            kind, limited = model.jnt_type[joint], model.jnt_limited[joint]
            if kind == mujoco.mjtJoint.mjJNT_FREE or (kind == mujoco.mjtJoint.mjJNT_SLIDE and not limited):
                return root
    return None
