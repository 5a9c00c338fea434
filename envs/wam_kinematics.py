"""Kinematics of the Barrett WAM for many postures at once.

Frames follow the standard (Spong) Denavit-Hartenberg convention with the maker's constants; the world frame stands
in the shoulder, 0.346 m above the base plate. ``assets/wam_arm.xml`` is the same chain for MuJoCo.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from nht.envs.arm import Arm
from nht.envs.arrays import Array

A = np.array([0.0, 0.0, 0.045, -0.045, 0.0, 0.0, 0.0])
"""DH link lengths [m]."""
QUARTER_TURNS = np.array([-1, 1, -1, 1, -1, 1, 0])
"""DH twists alpha in units of pi / 2."""
D = np.array([0.0, 0.0, 0.55, 0.0, 0.3, 0.0, 0.18])
"""DH link offsets [m]; the last one reaches to the tool face."""
ARM = Arm(tuple(A.tolist()), tuple((QUARTER_TURNS * math.pi / 2).tolist()), tuple(D.tolist()))
"""The same parameters as a record for the table of tasks."""

JOINT_LOW = np.array([-2.6, -2.0, -2.8, -0.9, -1.24, -1.6, -3.0])
"""Lower joint limits [rad], the maker's; the wrist yaw is cut to +-1.24 as in the paper's tasks."""
JOINT_HIGH = np.array([2.6, 2.0, 2.8, 3.1, 1.24, 1.6, 3.0])
"""Upper joint limits [rad]."""
MAX_SPEED = 2.0
"""Largest speed of any joint [rad/s]."""


@dataclass(frozen=True)
class Pose:
    """Pose and Jacobians of the tool for a batch of N postures."""

    position: Array
    """Centre of the tool face [m], ``(N, 3)``."""
    normal: Array
    """Unit vector out of the tool face, ``(N, 3)``."""
    joint_axes: Array
    """World direction of every joint axis, ``(N, 7, 3)``."""
    joint_origins: Array
    """A point on every joint axis [m], ``(N, 7, 3)``."""

    def linear_jacobian(self) -> Array:
        """Tool velocity [m/s] per joint velocity [rad/s], ``(N, 3, 7)``."""
        lever = self.position[:, None] - self.joint_origins
        return np.cross(self.joint_axes, lever).swapaxes(1, 2)

    def angular_jacobian(self) -> Array:
        """Angular velocity of the tool [rad/s] per joint velocity [rad/s], ``(N, 3, 7)``."""
        return self.joint_axes.swapaxes(1, 2)

    def normal_jacobian(self) -> Array:
        """Rate of the face normal per joint velocity [rad/s], ``(N, 3, 7)``: each axis crossed with the normal."""
        return np.cross(self.joint_axes, self.normal[:, None]).swapaxes(1, 2)


def forward_kinematics(joint_angle: Array) -> Pose:
    """Tool pose and joint axes at the joint angles ``(N, 7)`` [rad]."""
    count = joint_angle.shape[0]
    cos, sin = np.cos(joint_angle)[..., None], np.sin(joint_angle)[..., None]
    x, y, z = (np.broadcast_to(axis, (count, 3)) for axis in np.eye(3))
    position = np.zeros((count, 3))
    axes, origins = np.empty((count, 7, 3)), np.empty((count, 7, 3))
    for joint in range(7):
        axes[:, joint], origins[:, joint] = z, position
        turned = cos[:, joint] * x + sin[:, joint] * y
        y = cos[:, joint] * y - sin[:, joint] * x
        x = turned
        position = position + D[joint] * z + A[joint] * x
        if QUARTER_TURNS[joint]:
            # A twist of +-pi/2 about x only swaps y and z, one of them negated.
            sign = QUARTER_TURNS[joint]
            y, z = sign * z, -sign * y
    return Pose(position, np.ascontiguousarray(z), axes, origins)


def tool_pose(joint_angle: Array) -> tuple[Array, Array]:
    """Position and normal of the tool face, without the joint axes: half the cost of ``forward_kinematics``.

    Carries the centre of the face and its normal from the tool's frame to the world's, one joint after the other.

    Args:
        joint_angle: ``(N, 7)`` [rad].

    Returns:
        Centre of the tool face [m] and unit vector out of it, each ``(N, 3)``.
    """
    angle = np.ascontiguousarray(joint_angle.T)
    cos, sin = np.cos(angle), np.sin(angle)
    # Row 0 is the point, which links shift; row 1 the direction. The last joint turns about both.
    x, y, z = np.zeros((3, 2, joint_angle.shape[0]))
    z[0], z[1] = D[6], 1.0
    for joint in reversed(range(6)):
        y, z = (-z, y) if QUARTER_TURNS[joint] > 0 else (z, -y)
        if A[joint]:
            x[0] += A[joint]
        if D[joint]:
            z[0] += D[joint]
        x, y = cos[joint] * x - sin[joint] * y, sin[joint] * x + cos[joint] * y
    position, normal = np.stack([x, y, z], axis=-1)
    return position, normal


def damped_solve(jacobian: Array, velocity: Array, damping: float = 1e-3) -> Array:
    """Joint velocity of least norm for a task velocity: J^T (J J^T + damping^2 I)^-1 velocity.

    Args:
        jacobian: ``(N, m, 7)``.
        velocity: ``(N, m)``.
        damping: keeps the joint velocity bounded near singular postures.

    Returns:
        ``(N, 7)``.
    """
    gram = jacobian @ jacobian.swapaxes(1, 2) + damping**2 * np.eye(jacobian.shape[1])
    return (jacobian.swapaxes(1, 2) @ np.linalg.solve(gram, velocity[..., None]))[..., 0]
