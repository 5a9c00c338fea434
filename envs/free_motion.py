"""Integrates the motion of a free root and hinges as MuJoCo's Runge-Kutta integrator does."""

from __future__ import annotations

import mujoco
import numpy as np

from nht.envs.arrays import Array

FOURTH_ORDER = int(mujoco.__version__.split(".")[0]) >= 4
"""Whether MuJoCo integrates orientations by Munthe-Kaas's method; MuJoCo 3 adds angular velocities uncorrected."""


def moved(q: Array, v: Array, time: float) -> Array:
    """Positions ``(N, nq)`` of a free root and hinges after ``time`` [s] at the constant velocity ``v`` ``(N, nv)``."""
    half_turn = v[:, 3:6] * (time / 2)
    half_angle = np.linalg.norm(half_turn, axis=1, keepdims=True)
    turn = np.concatenate([np.cos(half_angle), half_turn * np.sinc(half_angle / np.pi)], axis=1)
    orientation = quaternion_product(q[:, 3:7], turn)
    orientation /= np.linalg.norm(orientation, axis=1, keepdims=True)
    return np.concatenate([q[:, :3] + time * v[:, :3], orientation, q[:, 7:] + time * v[:, 6:]], axis=1)


def stage_velocity(v: Array, way: Array, time: float, corrected: bool = FOURTH_ORDER) -> Array:
    """The velocity that a Runge-Kutta stage, reached by ``moved(q, way, time)``, contributes to the weighted sum.

    Rotations do not add up: at the end of a turn ``u`` the angular velocity ``w`` changes ``u`` itself by the inverse
    of the exponential map's derivative, ``w + u x w / 2 + (1 - |u|/2 cot(|u|/2)) u x (u x w) / |u|^2`` (Munthe-Kaas
    1998).

    Args:
        v: velocities ``(N, nv)`` at the stage, the angular ones in the root's frame.
        way: the constant velocities ``(N, nv)`` that led there.
        time: for how long [s].
        corrected: whether to correct, as MuJoCo 4 does; else ``v`` is returned.
    """
    if not corrected:
        return v
    u, w = way[:, 3:6] * time, v[:, 3:6]
    half = np.linalg.norm(u, axis=1, keepdims=True) / 2
    # half * cot(half), and its series where the quotient is 0 / 0
    cotangent = np.divide(half, np.tan(half), out=1 - half**2 / 3, where=half > 1e-4)
    factor = np.divide(1 - cotangent, 4 * half**2, out=np.full_like(half, 1 / 12), where=half > 1e-4)
    once = np.cross(u, w)
    turning = w + once / 2 + factor * np.cross(u, once)
    return np.concatenate([v[:, :3], turning, v[:, 6:]], axis=1)


def quaternion_product(left: Array, right: Array) -> Array:
    """Hamilton's product of quaternions ``(N, 4)``, the real part first."""
    a, u = left[:, :1], left[:, 1:]
    b, w = right[:, :1], right[:, 1:]
    real = a * b - (u * w).sum(axis=1, keepdims=True)
    return np.concatenate([real, a * w + b * u + np.cross(u, w)], axis=1)
