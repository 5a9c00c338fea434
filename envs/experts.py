"""Scripted demonstrators: controllers of a task's own observations, for all copies at once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping

import numpy as np

from nht.envs.arrays import Array
from nht.envs.wam_grasp import GRASP_RADIUS, OBJECT_CENTRE
from nht.envs.wam_kinematics import damped_solve, forward_kinematics
from nht.envs.wam_wipe import DOWN, TABLE_HEIGHT


class Expert(ABC):
    """A controller of a task: its observations in, actuations out."""

    @abstractmethod
    def __call__(self, observation: Mapping[str, Array]) -> Array:
        """Actuations ``(N, n)`` from the task's observations, each ``(N, size)``."""


class WipeExpert(Expert):
    """Resolved-rate controller for WAMWipe: straight to the goal, height and tilt held.

    The task velocity has five rows, tool velocity (3) and rate of the face normal (2); the joint velocity is the
    one of least norm that gives it.

    Args:
        speed: largest speed of the tool over the table [m/s]. At 0.2 an episode takes about 50 steps, at 0.032
            about the 250 of the paper's demonstrations, which then need a time limit of 700 instead of 200.
        gain: how fast errors of position, height and tilt are driven out [1/s].

    Raises:
        ValueError: if the speed or gain is not positive.
    """

    def __init__(self, speed: float = 0.2, gain: float = 5.0) -> None:
        if not (speed > 0 and gain > 0):
            raise ValueError(f"speed and gain must be positive, got {speed} and {gain}.")
        self.speed = speed
        self.gain = gain

    def __call__(self, observation: Mapping[str, Array]) -> Array:
        """Joint velocities ``(N, 7)`` [rad/s] from ``"joint_angle"`` and ``"goal"``."""
        pose = forward_kinematics(np.asarray(observation["joint_angle"], dtype=np.float64))
        to_goal = np.asarray(observation["goal"], dtype=np.float64)[:, :2] - pose.position[:, :2]
        distance = np.linalg.norm(to_goal, axis=1, keepdims=True)
        planar = to_goal * np.minimum(self.gain, self.speed / np.maximum(distance, 1e-9))
        lift = self.gain * (TABLE_HEIGHT - pose.position[:, 2:])
        level = self.gain * (DOWN - pose.normal)[:, :2]
        velocity = np.concatenate([planar, lift, level], axis=1)
        jacobian = np.concatenate([pose.linear_jacobian(), pose.normal_jacobian()[:, :2]], axis=1)
        return damped_solve(jacobian, velocity)


class GraspExpert(Expert):
    """Resolved-rate controller for WAMGrasp: around the object to the grasp point, while the face turns to the centre.

    The tool follows a great circle about the object's centre while its distance from the centre changes to that of the
    grasp points, so that it never comes nearer than both ends are. Distance and turn shrink in proportion, so that both
    end together. The joint velocity is the one of least norm.

    Args:
        speed: largest speed of the tool [m/s], its turn counted with ``TURN_LENGTH``. At 0.107 an episode from around
            ``HOME`` takes about 100 steps.
        gain: how fast the last of the error is driven out [1/s].

    Raises:
        ValueError: if the speed or gain is not positive.
    """

    TURN_LENGTH = 0.2
    """The distance that a turn by one radian counts as [m]: the length of the hand."""

    def __init__(self, speed: float = 0.107, gain: float = 5.0) -> None:
        if not (speed > 0 and gain > 0):
            raise ValueError(f"speed and gain must be positive, got {speed} and {gain}.")
        self.speed = speed
        self.gain = gain

    def __call__(self, observation: Mapping[str, Array]) -> Array:
        """Joint velocities ``(N, 7)`` [rad/s] from ``"joint_angle"`` and ``"goal"``."""
        pose = forward_kinematics(np.asarray(observation["joint_angle"], dtype=np.float64))
        outward = (np.asarray(observation["goal"], dtype=np.float64) - OBJECT_CENTRE) / GRASP_RADIUS
        radius = np.linalg.norm(pose.position - OBJECT_CENTRE, axis=1, keepdims=True)
        above = (pose.position - OBJECT_CENTRE) / radius
        way = radius * arc(above, outward) - (radius - GRASP_RADIUS) * above
        turn = arc(pose.normal, -outward)
        length = np.linalg.norm(np.concatenate([way, self.TURN_LENGTH * turn], axis=1), axis=1, keepdims=True)
        rate = np.minimum(self.gain, self.speed / np.maximum(length, 1e-9))
        jacobian = np.concatenate([pose.linear_jacobian(), pose.normal_jacobian()], axis=1)
        return damped_solve(jacobian, rate * np.concatenate([way, turn], axis=1))


def arc(start: Array, end: Array) -> Array:
    """The way from one unit vector to another, each ``(N, 3)``: a tangent at ``start``, as long as their angle [rad].

    It is 0 between opposite vectors, where no way is the shortest.
    """
    cosine = (start * end).sum(axis=1, keepdims=True)
    across = end - cosine * start
    sine = np.linalg.norm(across, axis=1, keepdims=True)
    return across / np.maximum(sine, 1e-9) * np.arctan2(sine, cosine)
