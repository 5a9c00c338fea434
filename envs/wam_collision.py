"""Exact distances from the moving geoms of an arm to what stands around it, for many postures at once."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array

SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE.value
CAPSULE = mujoco.mjtGeom.mjGEOM_CAPSULE.value
CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER.value


class Placed(NamedTuple):
    """The G geoms of an arm and its tool, in N postures."""

    centre: Array
    """Centres of the geoms [m], ``(3, G, N)``."""
    axis: Array
    """Unit vectors along the geoms, ``(3, G, N)``."""
    tool_position: Array
    """Origin of the tool's frame [m], ``(N, 3)``."""
    tool_axis: Array
    """Its z axis, ``(N, 3)``."""


class ArmGeoms:
    """The spheres, capsules and cylinders that a serial arm of hinges moves, placed for N postures together.

    Every geom is a cylinder grown by a margin: a capsule's has no radius, a sphere's no length either, and a cylinder
    has no margin. All are stored at joint angles 0; a posture turns them about the joint axes, also as at joint angles
    0, the last joint first (product of exponentials). Geoms that no joint moves are left out.

    Args:
        model: every joint is a hinge, in a body below that of the joint before; the last one moves a site ``"tool"``.

    Raises:
        ValueError: if the joints are others, a moving geom is of another type or there is no such site.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        depth = _moving_joints(model)
        moving = np.flatnonzero(depth[model.geom_bodyid])
        # From the hand to the shoulder: what a joint moves are then always the first geoms.
        geoms = moving[np.argsort(-depth[model.geom_bodyid[moving]], kind="stable")]
        for geom in geoms:
            if model.geom_type[geom] not in (SPHERE, CAPSULE, CYLINDER):
                raise ValueError(
                    f"the moving geom {model.geom(geom).name!r} must be a sphere, a capsule or a cylinder, "
                    f"got {mujoco.mjtGeom(model.geom_type[geom]).name}."
                )
        tool = _tool_site(model, depth)
        self.names: list[str] = [model.geom(geom).name for geom in geoms]
        """The geoms in the order of all distances."""
        self._moved = [
            1 + int((depth[model.geom_bodyid[geoms]] > joint).sum()) for joint in range(model.njnt)
        ]

        data = mujoco.MjData(model)
        data.qpos[:] = 0.0
        mujoco.mj_kinematics(model, data)
        # The tool goes first: every joint moves it. (3, 1 + G, 2, 1)
        centres = np.concatenate([data.site_xpos[tool, None], data.geom_xpos[geoms]])
        axes = np.concatenate([data.site_xmat[tool, None, 2::3], data.geom_xmat[geoms, 2::3]])
        self._at_zero = np.stack([centres.T, axes.T], axis=-1)[..., None]
        self._planes = [_turned_plane(axis) for axis in data.xaxis]
        # Centres turn about the hinge, directions about the origin: (3, 1, 2, 1) for each hinge beside the origin.
        shifts = [
            anchor - (anchor @ axis) * axis for anchor, axis in zip(data.xanchor, data.xaxis, strict=True)
        ]
        beside = [np.stack([shift, np.zeros(3)], axis=-1)[:, None, :, None] for shift in shifts]
        self._anchors = [anchor if np.abs(anchor).max() > 1e-12 else None for anchor in beside]

        types, radius = model.geom_type[geoms], model.geom_size[geoms, 0]
        self._half: Array = np.where(types == SPHERE, 0.0, model.geom_size[geoms, 1])[:, None]
        self._radius: Array = np.where(types == CYLINDER, radius, 0.0)[:, None]
        self._margin: Array = np.where(types == CYLINDER, 0.0, radius)[:, None]

    def place(self, joint_angle: Array) -> Placed:
        """Positions of geoms and tool at the joint angles ``(N, joints)`` [rad]."""
        cos, sin = np.cos(joint_angle.T), np.sin(joint_angle.T)
        placed = np.repeat(self._at_zero, len(joint_angle), axis=-1)
        for joint in reversed(range(len(self._moved))):
            moved, anchor = placed[:, : self._moved[joint]], self._anchors[joint]
            i, j = self._planes[joint]
            x, y = moved[i], moved[j]
            if anchor is not None:
                x, y = x - anchor[i], y - anchor[j]
            moved[i], moved[j] = cos[joint] * x - sin[joint] * y, sin[joint] * x + cos[joint] * y
            if anchor is not None:
                moved += anchor
        centre, axis = placed[:, :, 0], placed[:, :, 1]
        return Placed(centre[:, 1:], axis[:, 1:], centre[:, 0].T.copy(), axis[:, 0].T.copy())

    def distance_to_sphere(self, placed: Placed, centre: Array, radius: float) -> Array:
        """Signed distances ``(N, G)`` [m] to a ball, negative where a geom cuts into it.

        Args:
            placed: what ``place`` returned.
            centre: of the ball [m], ``(3,)``.
            radius: of the ball [m].
        """
        to_ball = centre[:, None, None] - placed.centre
        along = np.einsum("ign,ign->gn", to_ball, placed.axis)
        beside = np.einsum("ign,ign->gn", to_ball, to_ball) - along * along
        # How far beyond the cylinder's side and its cap, negative within.
        side = np.sqrt(np.maximum(beside, 0.0)) - self._radius
        cap = np.abs(along) - self._half
        outside = np.hypot(np.maximum(side, 0.0), np.maximum(cap, 0.0))
        return (outside + np.minimum(np.maximum(side, cap), 0.0) - (self._margin + radius)).T

    def distance_to_floor(self, placed: Placed, height: float) -> Array:
        """Signed distances ``(N, G)`` [m] to everything below a height [m], negative where a geom dips into it."""
        upright = np.abs(placed.axis[2])
        rim = self._radius * np.sqrt(np.maximum(1.0 - upright * upright, 0.0))
        return (placed.centre[2] - self._half * upright - rim - (self._margin + height)).T


def _turned_plane(axis: Array) -> tuple[int, int]:
    """The coordinates (i, j) that a positive turn about a coordinate axis mixes: i goes towards j."""
    along = int(np.argmax(np.abs(axis)))
    if abs(abs(axis[along]) - 1.0) > 1e-9:
        raise ValueError(f"the arm's hinges must lie along x, y or z at joint angles 0, got {axis}.")
    plane = (along + 1) % 3, (along + 2) % 3
    return plane if axis[along] > 0 else plane[::-1]


def _tool_site(model: mujoco.MjModel, depth: NDArray[np.intp]) -> int:
    """The index of the site ``"tool"``, which all joints have to move."""
    site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, "tool")
    if site < 0 or depth[model.site_bodyid[site]] < model.njnt:
        raise ValueError('the arm must have a site "tool" that its last joint moves.')
    return site


def _moving_joints(model: mujoco.MjModel) -> NDArray[np.intp]:
    """How many joints move each body: 0 for the world, and the number of the deepest joint plus one for others."""
    if (model.jnt_type != mujoco.mjtJoint.mjJNT_HINGE.value).any():
        raise ValueError("the arm's joints must all be hinges.")
    depth = np.zeros(model.nbody, dtype=np.intp)
    for body in range(1, model.nbody):
        first, count = model.body_jntadr[body], model.body_jntnum[body]
        above = depth[model.body_parentid[body]]
        if count and first != above:
            raise ValueError(f"the arm must be one chain: body {model.body(body).name!r} starts a branch.")
        depth[body] = above + count
    return depth
