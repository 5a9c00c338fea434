"""A task of one's own: six joints in a plane bring the tip of the arm to a goal."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from nht.envs import BatchedTask, Expert, TaskRecord
from nht.envs.task import Array, Flags, load_model

LINK, SPEED = 0.1, 2.0
"""Length of each link [m], largest speed of each joint [rad/s]."""


def tip(joint_angle: Array) -> Array:
    """Where the arm's tip is [m], ``(N, 2)``, at joint angles ``(N, 6)`` [rad]."""
    heading = joint_angle.cumsum(axis=1)
    return LINK * np.stack([np.cos(heading).sum(axis=1), np.sin(heading).sum(axis=1)], axis=1)


class Reach(BatchedTask):
    """Bring the tip to a goal. Actuation: joint velocities ``(N, 6)`` [rad/s]. Reward: -1 a step, 0 at the goal.

    Args:
        num_envs, num_threads, seed, max_episode_steps: as of every task.
        radius: distance to the goal that counts as reached [m].
        terminate_on_success: end an episode at the goal.
    """

    reward_range = (-1.0, 0.0)
    observation_sizes: ClassVar[dict[str, int]] = {"observation": 10, "joint_angle": 6}
    _episode_arrays: ClassVar[tuple[str, ...]] = ("goal",)

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        seed: int | None = None,
        *,
        radius: float = 0.05,
        terminate_on_success: bool = False,
        max_episode_steps: int = 100,
    ) -> None:
        super().__init__(
            load_model(Path(__file__).parent / "reach.xml"),
            num_envs=num_envs,
            substeps=2,
            max_episode_steps=max_episode_steps,
            num_threads=num_threads,
            seed=seed,
        )
        self.radius, self.terminate_on_success = radius, terminate_on_success
        self.goal: Array = np.zeros((num_envs, 2))
        self.reset()

    @property
    def actuation_bounds(self) -> tuple[Array, Array]:
        """The joints' largest speed in both directions."""
        return np.full(6, -SPEED), np.full(6, SPEED)

    def _draw_start(self, rows: NDArray[np.intp]) -> None:
        self.qpos[rows] = self.rng.uniform(-0.4, 0.4, (len(rows), 6))
        angle, distance = self.rng.uniform(-1.0, 1.0, len(rows)), self.rng.uniform(0.3, 0.5, len(rows))
        self.goal[rows] = distance[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def observe(self) -> dict[str, Array]:
        """Joint angles, tip and goal; joint angles by themselves."""
        observed = np.concatenate([self.qpos, tip(self.qpos), self.goal], axis=1)
        return {"observation": observed, "joint_angle": self.qpos.copy()}

    def _apply(self, actuation: Array) -> None:
        self.qvel[:] = actuation

    def _judge(self, actuation: Array) -> tuple[Array, Flags, Flags, Flags]:
        success = np.linalg.norm(self.goal - tip(self.qpos), axis=1) < self.radius
        never = np.zeros(self.num_envs, dtype=bool)
        return np.where(success, 0.0, -1.0), success & self.terminate_on_success, success, never


class ReachExpert(Expert):
    """Straight to the goal, by the pseudo-inverse of the arm's Jacobian.

    Args:
        speed: of the tip [m/s].
    """

    def __init__(self, speed: float = 0.4) -> None:
        self.speed = speed

    def __call__(self, observation: Mapping[str, Array]) -> Array:
        """Joint velocities ``(N, 6)`` [rad/s]."""
        angle = np.asarray(observation["joint_angle"], dtype=np.float64)
        way = np.asarray(observation["observation"], dtype=np.float64)[:, 8:] - tip(angle)
        step = self.speed * way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 0.02)
        heading = angle.cumsum(axis=1)
        pieces = LINK * np.stack([-np.sin(heading), np.cos(heading)], axis=1)
        jacobian = pieces[:, :, ::-1].cumsum(axis=2)[:, :, ::-1]
        return np.einsum("nij,nj->ni", np.linalg.pinv(jacobian, rcond=1e-2), step)


REACH = TaskRecord(Reach, expert=ReachExpert, context_keys=("joint_angle",))
