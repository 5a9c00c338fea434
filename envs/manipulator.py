"""The planar manipulator of dm_control's suite on the batched engine."""

from __future__ import annotations

from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array, Flags, Seed
from nht.envs.dm_control import suite_module, tolerance
from nht.envs.suite_task import SuiteTask

ARM_JOINTS = ("arm_root", "arm_shoulder", "arm_elbow", "arm_wrist")
FINGERS = ("finger", "fingertip", "thumb", "thumbtip")
BALL = ("ball_x", "ball_z", "ball_y")
LINKS = ("upper_arm", "middle_arm", "lower_arm", "hand")
TOUCH = ("palm_touch", "finger_touch", "thumb_touch", "fingertip_touch", "thumbtip_touch")
CLOSE = 0.01
"""Distance between ball and target that earns the full reward [m]."""
IN_HAND, IN_TARGET = 0.1, 0.1
"""Shares of the episodes that start with the ball in the hand, and on its target."""


class BringBall(SuiteTask):
    """dm_control's manipulator-bring_ball: 5 motors, 44 observed numbers, 0.01 s a step.

    Actuation: the motors' controls ``(N, 5)``, in [-1, 1]. Reward: 1 with the ball within 1 cm of the target, less
    further away. The target differs between copies and touches nothing: it is an array of the task, not of the model.
    Touch is felt, as in the suite, in the state before the last simulation step.

    Args:
        num_envs: number of copies N.
        num_threads: native threads that share the copies.
        seed: seed of the starts.
        max_episode_steps: environment steps in an episode.

    Raises:
        ImportError: if dm_control is not installed.
        ValueError: if a count is below 1.
    """

    reads_sensors = True
    _episode_arrays: ClassVar[tuple[str, ...]] = ("target", "sensors")

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        seed: Seed = None,
        *,
        max_episode_steps: int = 1_000,
    ) -> None:
        xml, assets = suite_module("manipulator").make_model(use_peg=False, insert=False)
        super().__init__(
            "manipulator-bring_ball",
            xml,
            assets,
            control_timestep=0.01,
            num_envs=num_envs,
            num_threads=num_threads,
            seed=seed,
            max_episode_steps=max_episode_steps,
        )
        model = self.model
        self._arm, self._fingers, self._ball = (
            np.array([model.joint(name).qposadr[0] for name in names])
            for names in (ARM_JOINTS, FINGERS, BALL)
        )
        self._touch = np.array([model.sensor(name).adr[0] for name in TOUCH])
        self._lengths = np.array([model.body(name).pos[2] for name in LINKS])
        self._grasp = model.site("grasp").pos[2]
        self._depth = model.body("target_ball").pos[1] - model.body("ball").pos[1]
        # The model's own target stands still: ``decorate`` draws one where it is.
        model.geom("target_ball").matid = -1
        model.geom("target_ball").rgba = 0.0
        self._scratch = mujoco.MjData(model)
        self.target: Array = np.zeros((num_envs, 4))  # x, z [m], and the quaternion's w and y
        self.reset()

    @property
    def observation_sizes(self) -> dict[str, int]:
        """Length of every observation by its key."""
        return {
            "observation": 44,
            "arm_pos": 16,
            "arm_vel": 8,
            "touch": 5,
            "hand_pos": 4,
            "object_pos": 4,
            "object_vel": 3,
            "target_pos": 4,
        }

    def _entries(self) -> dict[str, Array]:
        joints = np.concatenate([self._arm, self._fingers])
        angle = self.qpos[:, joints]
        x, z, turn = self._hand(self.qpos)
        ball_x, ball_z, ball_turn = self.qpos[:, self._ball].T
        return {
            "arm_pos": np.stack([np.sin(angle), np.cos(angle)], axis=-1).reshape(self.num_envs, -1),
            "arm_vel": self.qvel[:, joints],
            "touch": np.log1p(self.sensors[:, self._touch]),
            "hand_pos": planar_pose(x, z, turn),
            "object_pos": planar_pose(ball_x, ball_z, ball_turn),
            "object_vel": self.qvel[:, self._ball],
            "target_pos": self.target.copy(),
        }

    def _hand(self, qpos: Array, beyond: float = 0.0) -> tuple[Array, Array, Array]:
        """Position x and z [m] of the hand, or of a point ``beyond`` it, and its turn about y [rad], each ``(N,)``."""
        turn = -np.cumsum(qpos[:, self._arm], axis=1)
        reach = np.append(self._lengths[1:], beyond)
        return np.sin(turn) @ reach, self._lengths[0] + np.cos(turn) @ reach, turn[:, -1]

    def _draw_start(self, rows: NDArray[np.intp]) -> None:
        self.sensors[rows] = 0.0
        missing = rows
        while len(missing):
            self._draw(missing)
            missing = missing[[self._penetrates(row) for row in missing]]

    def _draw(self, rows: NDArray[np.intp]) -> None:
        """Draw starts of the copies ``rows`` that may be penetrating."""
        count, uniform = len(rows), self.rng.uniform
        joints = np.concatenate([self._arm, self._fingers])
        low, high = np.where(
            self.model.jnt_limited[joints], self.model.jnt_range[joints].T, [[-np.pi], [np.pi]]
        )
        qpos = np.empty((count, self.model.nq))
        qpos[:, joints] = uniform(low, high, (count, len(joints)))
        qpos[:, self._fingers[0]] = qpos[:, self._fingers[2]]  # the hand is symmetric

        target = uniform([-0.4, 0.1, -np.pi], [0.4, 0.4, np.pi], (count, 3))
        anywhere = uniform([-0.5, 0.0, 0.0], [0.5, 0.7, 2 * np.pi], (count, 3))
        x, z, turn = self._hand(qpos, self._grasp)
        places = [np.stack([x, z, np.pi + turn], axis=1), target, anywhere]
        kind = self.rng.choice(3, size=count, p=[IN_HAND, IN_TARGET, 1 - IN_HAND - IN_TARGET])
        qpos[:, self._ball] = np.choose(kind[:, None], places)
        self.qpos[rows], self.target[rows] = qpos, planar_pose(*target.T)
        # Like the suite, a ball keeps the speed of the last try that gave it one.
        thrown = rows[kind == 2]
        self.qvel[thrown, self._ball[0]] = uniform(-5, 5, len(thrown))

    def _penetrates(self, row: int) -> bool:
        """Whether anything touches in the copy ``row``. Asked at starts only: MuJoCo has no batched collisions."""
        self._scratch.qpos[:] = self.qpos[row]
        mujoco.mj_fwdPosition(self.model, self._scratch)
        return self._scratch.ncon > 0

    def _judge(self, actuation: Array) -> tuple[Array, Flags, Flags, Flags]:
        apart = self.qpos[:, self._ball[:2]] - self.target[:, :2]
        distance = np.sqrt(np.einsum("ij,ij->i", apart, apart) + self._depth**2)
        never = np.zeros(self.num_envs, dtype=bool)
        return tolerance(distance, (0.0, CLOSE), 2 * CLOSE), never, never.copy(), never.copy()

    def decorate(self, scene: mujoco.MjvScene, row: int) -> None:
        """Draw the target as a pale ball."""
        x, z = self.target[row, :2]
        scene.ngeom += 1
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom - 1],
            mujoco.mjtGeom.mjGEOM_SPHERE,
            self.model.geom("target_ball").size,
            np.array([x, self._depth, z]),
            np.eye(3).ravel(),
            np.array([0.6, 0.3, 0.3, 0.5], dtype=np.float32),
        )


def planar_pose(x: Array, z: Array, turn: Array) -> Array:
    """Position and quaternion in the plane, ``(N, 4)``: x, z [m], w and y."""
    return np.stack([x, z, np.cos(turn / 2), np.sin(turn / 2)], axis=1)
