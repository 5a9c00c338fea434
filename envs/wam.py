"""The Barrett WAM arm, kinematic as in the paper (section A.1): the actuation sets the joint velocities."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar

import mujoco
import numpy as np

from nht.envs.arrays import Array, Flags, Seed
from nht.envs.task import BatchedTask
from nht.envs.wam_kinematics import JOINT_HIGH, JOINT_LOW, MAX_SPEED, tool_pose

BRAKE_ZONE = 0.15
"""Within this angle of a limit [rad] a joint cannot move further towards it."""
BRAKE_LOW, BRAKE_HIGH = JOINT_LOW + BRAKE_ZONE, JOINT_HIGH - BRAKE_ZONE


class WAMTask(BatchedTask):
    """N arms with a goal for the tool each, and failures that last.

    Actuation: joint velocities ``(N, 7)`` [rad/s]. Reward: -1 a step, 0 at the goal. After a failure every step costs
    -1 and the episode cannot succeed. A subclass draws starts and goals, observes, and says what a failure is and
    what it means to be at the goal.

    Args:
        model: the arm and what stands around it.
        num_envs: number of copies N.
        num_threads: native threads that share the copies.
        seed: seed of goals and starts.
        success_radius: distance to the goal that counts as reached [m].
        tilt_tolerance: allowed angle of the face normal from the direction asked for [rad].
        terminate_on_failure: end an episode at a failure; otherwise it goes on, absorbing.
        terminate_on_success: end an episode at the goal, for demonstrations; otherwise it goes on.
        max_episode_steps: environment steps of 0.02 s in an episode.

    Raises:
        ValueError: if the radius or the tolerance is not positive.
    """

    reward_range = (-1.0, 0.0)
    _episode_arrays: ClassVar[tuple[str, ...]] = ("goal", "failed")

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        num_envs: int,
        num_threads: int,
        seed: Seed,
        success_radius: float,
        tilt_tolerance: float,
        terminate_on_failure: bool,
        terminate_on_success: bool,
        max_episode_steps: int,
    ) -> None:
        check_positive(tilt_tolerance=tilt_tolerance, success_radius=success_radius)
        super().__init__(
            model,
            num_envs=num_envs,
            substeps=10,
            max_episode_steps=max_episode_steps,
            num_threads=num_threads,
            seed=seed,
        )
        self.success_radius = success_radius
        self.tilt_tolerance = tilt_tolerance
        self.terminate_on_failure = terminate_on_failure
        self.terminate_on_success = terminate_on_success
        self.goal: Array = np.zeros((num_envs, 3))
        self.failed: Flags = np.zeros(num_envs, dtype=bool)

    @abstractmethod
    def _violates(self) -> Flags:
        """Which copies ``(N,)`` break a rule of the task in their present state."""

    @abstractmethod
    def _at_goal(self) -> Flags:
        """Which tools ``(N,)`` are at the goal."""

    @property
    def actuation_bounds(self) -> tuple[Array, Array]:
        """The joints' largest speed [rad/s] in both directions."""
        return np.full(7, -MAX_SPEED), np.full(7, MAX_SPEED)

    def _apply(self, actuation: Array) -> None:
        self.qvel[:] = brake(self.qpos, actuation)

    def _update_pose(self) -> None:
        self._position, self._normal = tool_pose(self.qpos)

    def _note_diverged(self, diverged: Flags) -> None:
        self.failed |= diverged

    def _judge(self, actuation: Array) -> tuple[Array, Flags, Flags, Flags]:
        self._update_pose()
        self.failed |= self._violates()
        success = self._at_goal() & ~self.failed
        ended = (self.failed & self.terminate_on_failure) | (success & self.terminate_on_success)
        return np.where(success, 0.0, -1.0), ended, success, self.failed.copy()

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        super().load_state_dict(saved)
        self._update_pose()

    def _observe_arm(self) -> dict[str, Array]:
        """The observations of every task with this arm: joint angles [rad], tool position and goal [m]."""
        return {
            "joint_angle": self.qpos.copy(),
            "tool_position": self._position.copy(),
            "goal": self.goal.copy(),
        }

    def _colour(self, row: int) -> tuple[float, float, float]:
        """The colour of the goal of copy ``row``: orange, green once reached, red after a failure."""
        if self.failed[row]:
            return 0.85, 0.15, 0.15
        return (0.2, 0.7, 0.25) if self._at_goal()[row] else (0.95, 0.6, 0.1)


def check_positive(**settings: float) -> None:
    """Raise ValueError if one of the settings, given by name, is not positive."""
    for name, value in settings.items():
        if not value > 0:
            raise ValueError(f"{name} must be positive, got {value}.")


def brake(joint_angle: Array, velocity: Array) -> Array:
    """The joint velocities ``(N, 7)`` without the components that move a joint further towards a near limit."""
    to_low = (joint_angle < BRAKE_LOW) & (velocity < 0)
    to_high = (joint_angle > BRAKE_HIGH) & (velocity > 0)
    return np.where(to_low | to_high, 0.0, velocity)
