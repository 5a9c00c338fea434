"""WAMWipe: slide the tool over a table, flush, to a goal (section A.1.1)."""

from __future__ import annotations

import math
from typing import ClassVar, Literal, get_args

import mujoco
import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array, Flags, Seed
from nht.envs.models import ASSETS, load_model
from nht.envs.wam import BRAKE_HIGH, BRAKE_LOW, WAMTask, check_positive
from nht.envs.wam_kinematics import damped_solve, forward_kinematics

START_POSTURE = np.array([-0.2024, 0.4339, 0.0471, 2.1786, -0.0392, 0.5299, -0.1258])
"""The authors' start posture [rad]: the tool face lies flush on the table."""
TABLE_HEIGHT = 0.064
"""Height of the table top over the shoulder [m]."""
GOAL_LOW, GOAL_HIGH = np.array([0.3, -0.25]), np.array([0.7, 0.25])
"""Goal area on the table, x and y [m]."""
DOWN = np.array([0.0, 0.0, -1.0])

Start = Literal["fixed", "random"]


class WAMWipe(WAMTask):
    """Slide the tool face over a table to a goal, without pressing, lifting or tilting it (section A.1.1).

    Actuation: joint velocities ``(N, 7)`` [rad/s]. Reward: -1 a step, 0 within ``success_radius`` of the goal.
    A violation (the face leaves the table's height by more than ``height_tolerance``, or tilts by more than
    ``tilt_tolerance``) is a failure: from then on every step costs -1 and the episode cannot succeed.

    Args:
        num_envs: number of copies N.
        num_threads: native threads that share the copies.
        seed: seed of goals and starts.
        start: ``"fixed"``, the authors' posture, or ``"random"``: a flush posture over the goal area whose elbow is
            swivelled by up to ``swivel_range``.
        swivel_range: largest turn of the shoulder yaw from the authors' posture [rad], for random starts.
        height_tolerance: allowed distance from the table's height [m].
        tilt_tolerance: allowed angle between the face normal and straight down [rad].
        success_radius: distance to the goal that counts as reached [m].
        terminate_on_failure: end an episode at a violation; by default it goes on, absorbing.
        terminate_on_success: end an episode at the goal, for demonstrations; by default it goes on.
        max_episode_steps: environment steps of 0.02 s in an episode.

    Raises:
        ValueError: for an unknown start, or a tolerance or radius that is not positive.
    """

    observation_sizes: ClassVar[dict[str, int]] = {
        "observation": 16,
        "joint_angle": 7,
        "tool_position": 3,
        "goal": 3,
    }

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        seed: Seed = None,
        *,
        start: Start = "fixed",
        swivel_range: float = 0.5,
        height_tolerance: float = 0.015,
        tilt_tolerance: float = math.pi / 16,
        success_radius: float = 0.03,
        terminate_on_failure: bool = False,
        terminate_on_success: bool = False,
        max_episode_steps: int = 200,
    ) -> None:
        if start not in get_args(Start):
            raise ValueError(f"start must be one of {get_args(Start)}, got {start!r}.")
        check_positive(height_tolerance=height_tolerance)
        if not 0 <= swivel_range <= 1.5:
            raise ValueError(f"swivel_range must lie in [0, 1.5] rad, got {swivel_range}.")
        super().__init__(
            load_model(ASSETS / "wam_wipe.xml"),
            num_envs=num_envs,
            num_threads=num_threads,
            seed=seed,
            success_radius=success_radius,
            tilt_tolerance=tilt_tolerance,
            terminate_on_failure=terminate_on_failure,
            terminate_on_success=terminate_on_success,
            max_episode_steps=max_episode_steps,
        )
        self.start = start
        self.swivel_range = swivel_range
        self.height_tolerance = height_tolerance
        self.reset()

    def _draw_start(self, rows: NDArray[np.intp]) -> None:
        count = len(rows)
        goal_xy = self.rng.uniform(GOAL_LOW, GOAL_HIGH, (count, 2))
        self.goal[rows] = np.column_stack([goal_xy, np.full(count, TABLE_HEIGHT)])
        self.failed[rows] = False
        self.qpos[rows] = START_POSTURE if self.start == "fixed" else self._draw_postures(count)
        self._update_pose()

    def _draw_postures(self, count: int) -> Array:
        """Flush postures over the goal area with a random swivel, ``(count, 7)``."""
        postures = np.empty((count, 7))
        missing = np.arange(count)
        for _ in range(100):
            size = len(missing)
            target = np.column_stack(
                [self.rng.uniform(GOAL_LOW, GOAL_HIGH, (size, 2)), np.full(size, TABLE_HEIGHT)]
            )
            swivel = self.rng.uniform(-self.swivel_range, self.swivel_range, size)
            found, reachable = flush_posture(target, swivel)
            postures[missing[reachable]] = found[reachable]
            missing = missing[~reachable]
            if not len(missing):
                return postures
        raise RuntimeError(f"no flush posture within the joint limits for {len(missing)} of {count} starts.")

    def observe(self) -> dict[str, Array]:
        """Joint angles [rad], tool position and goal [m], and all of them with the face normal (16 numbers)."""
        parts = [self.qpos, self._position, self.goal, self._normal]
        return {"observation": np.concatenate(parts, axis=1), **self._observe_arm()}

    def _violates(self) -> Flags:
        off_table = np.abs(self._position[:, 2] - TABLE_HEIGHT) > self.height_tolerance
        tilted = self._normal[:, 2] > -math.cos(self.tilt_tolerance)
        return off_table | tilted

    def _at_goal(self) -> Flags:
        to_goal = self.goal - self._position
        return np.einsum("ij,ij->i", to_goal, to_goal) < self.success_radius**2

    def decorate(self, scene: mujoco.MjvScene, row: int) -> None:
        """Draw the goal as a disc, in a halo wider than the tool: green once reached, red after a violation."""
        colour = self._colour(row)
        # As thin as can be told from the table: a thicker disc has a ragged shadow of its own along its edge.
        discs = ((self.success_radius, 1.0, 0.0006), (2.5 * self.success_radius, 0.35, 0.0003))
        for radius, opacity, height in discs:
            scene.ngeom += 1
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom - 1],
                mujoco.mjtGeom.mjGEOM_CYLINDER,
                np.array([radius, 0.0002, 0.0]),
                self.goal[row] + np.array([0.0, 0.0, height]),
                np.eye(3).ravel(),
                np.array([*colour, opacity], dtype=np.float32),
            )


def flush_posture(target: Array, swivel: Array, iterations: int = 30) -> tuple[Array, Flags]:
    """Postures with the tool face on ``target``, straight down, and the shoulder yaw turned by ``swivel``.

    Newton steps of least norm on position and tilt, the shoulder yaw held.

    Args:
        target: centre of the tool face [m], ``(N, 3)``.
        swivel: turn of the shoulder yaw from the authors' posture [rad], ``(N,)``.
        iterations: Newton steps.

    Returns:
        joint angles ``(N, 7)`` [rad], and ``(N,)`` whether a posture was found outside the brakes' reach.
    """
    posture = np.tile(START_POSTURE, (len(target), 1))
    posture[:, 2] += swivel
    held = np.array([1.0, 1.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    for _ in range(iterations):
        pose = forward_kinematics(posture)
        error = np.concatenate([target - pose.position, -pose.normal[:, :2]], axis=1)
        jacobian = np.concatenate([pose.linear_jacobian(), pose.normal_jacobian()[:, :2]], axis=1) * held
        posture = posture + np.clip(damped_solve(jacobian, error), -0.3, 0.3)
    pose = forward_kinematics(posture)
    exact = np.linalg.norm(pose.position - target, axis=1) < 1e-6
    straight = pose.normal[:, 2] < -1 + 1e-9
    inside = ((posture > BRAKE_LOW) & (posture < BRAKE_HIGH)).all(axis=1)
    return posture, exact & straight & inside
