"""The Jacobian's pseudo-inverse as an action map: the action is the velocity of the tool (A.5)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor

from nht.geometry import solve
from nht.maps import LinearActionMap


class JacobianPinv(LinearActionMap):
    """Resolved-rate control of a serial arm with revolute joints: u = J(q)^+ a, nothing is learned.

    Action: velocity of the tool, (*batch, 6): linear [m/s], then angular [rad/s], both in the base frame. Actuation:
    joint velocities [rad/s], (*batch, n). Context: the n joint angles q [rad] and nothing else.

    The pseudo-inverse is damped, J^T (J J^T + damping^2 I)^-1: near a singular posture the arm falls behind, rather
    than move its joints without bound. No action of unit length asks for more than 1 / (2 damping) [rad/s].

    The arm is given by its Denavit-Hartenberg parameters in the standard (Spong) convention, joint by joint. From one
    frame to the next: turn about z by the joint angle, shift along z by ``offsets``, shift along the new x by
    ``lengths``, turn about it by ``twists``. The last frame is the tool.

    Args:
        lengths: DH link lengths a [m], n of them, at least 6.
        twists: DH twists alpha [rad].
        offsets: DH link offsets d [m].
        damping: of the pseudo-inverse; 1e-3 or more in single precision. Directions in which the tool moves by less
            than this per unit of joint velocity are given up.

    Raises:
        ValueError: on lists of different or too small length, or a damping that is not positive.
    """

    learns = False

    def __init__(
        self,
        lengths: Sequence[float],
        twists: Sequence[float],
        offsets: Sequence[float],
        damping: float = 0.01,
    ) -> None:
        counts = (len(lengths), len(twists), len(offsets))
        if len(set(counts)) > 1 or counts[0] < 6:
            raise ValueError(
                "lengths, twists and offsets need one number per joint, at least 6 each for a six-dimensional "
                f"action, got {counts[0]}, {counts[1]} and {counts[2]}."
            )
        if not 0 < damping < math.inf:
            raise ValueError(f"damping must be a positive number, got {damping}.")
        joints = counts[0]
        super().__init__(context_dim=joints, actuation_dim=joints, action_dim=6)
        self.lengths = tuple(float(value) for value in lengths)
        self.twists = tuple(float(value) for value in twists)
        self.offsets = tuple(float(value) for value in offsets)
        self.damping = damping
        self.network_gain = math.inf  # too large to be worth proving: it goes with 1 / damping^2

    def jacobian(self, joint_angle: Tensor) -> Tensor:
        """Linear [m/s] and angular [rad/s] velocity of the tool per joint velocity [rad/s].

        Args:
            joint_angle: q [rad], (*batch, n).

        Returns:
            J(q), (*batch, 6, n). Columns are (z x (p - o), z): joint axis z through o, tool at p.
        """
        cosines, sines = joint_angle.cos().unsqueeze(-1), joint_angle.sin().unsqueeze(-1)
        identity = torch.eye(3, dtype=joint_angle.dtype, device=joint_angle.device)
        x, y, z = (axis.expand(*joint_angle.shape[:-1], 3) for axis in identity)
        position = torch.zeros_like(x)
        axes, origins = [], []
        for joint, (length, twist, offset) in enumerate(
            zip(self.lengths, self.twists, self.offsets, strict=True)
        ):
            axes.append(z)
            origins.append(position)
            cos, sin = cosines[..., joint, :], sines[..., joint, :]
            x, y = cos * x + sin * y, cos * y - sin * x
            position = position + offset * z + length * x
            y, z = math.cos(twist) * y + math.sin(twist) * z, math.cos(twist) * z - math.sin(twist) * y
        axis = torch.stack(axes, dim=-2)
        lever = position.unsqueeze(-2) - torch.stack(origins, dim=-2)
        return torch.cat([torch.linalg.cross(axis, lever), axis], dim=-1).mT

    def basis(self, context: Tensor) -> Tensor:
        """The damped pseudo-inverse of J(q), (*batch, n, 6)."""
        jacobian = self.jacobian(context)
        return solve(self._damped_gram(jacobian), jacobian).mT

    def basis_norm(self) -> float:
        """1 / (2 damping)."""
        return 1 / (2 * self.damping)

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        """J(q)^+ a: the least joint velocity that moves the tool as asked."""
        jacobian = self.jacobian(context)
        solved = solve(self._damped_gram(jacobian), action.unsqueeze(-1))
        return (jacobian.mT @ solved).squeeze(-1)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        """J(q) u, the velocity of the tool that the actuation gives: least squares, but for the damping."""
        return (self.jacobian(context) @ actuation.unsqueeze(-1)).squeeze(-1)

    def fit(self, batch: TensorDictBase) -> bool:
        """There is nothing to learn."""
        return True

    def _damped_gram(self, jacobian: Tensor) -> Tensor:
        identity = torch.eye(6, dtype=jacobian.dtype, device=jacobian.device)
        return jacobian @ jacobian.mT + self.damping**2 * identity
