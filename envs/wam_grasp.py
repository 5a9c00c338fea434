"""WAMGrasp: reach a point beside an object with the tool face turned to it, without touching anything (A.1.2)."""

from __future__ import annotations

import math
from functools import cache
from typing import ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array, Flags, Seed
from nht.envs.models import ASSETS, load_model
from nht.envs.wam import BRAKE_HIGH, BRAKE_LOW, WAMTask
from nht.envs.wam_collision import ArmGeoms, Placed
from nht.envs.wam_kinematics import damped_solve, forward_kinematics, tool_pose

HOME = np.array([0.0, 0.5, 0.0, 2.1, 0.0, 0.3, 0.0])
"""Middle of the start postures [rad]: the tool hangs a quarter of a metre over the object."""
OBJECT_CENTRE = np.array([0.55, 0.0, -0.196])
"""Centre of the object in the shoulder's frame [m], 0.15 m above the base plate."""
OBJECT_RADIUS = 0.08
"""Radius of the object, a ball [m]; it lies on the table."""
TABLE_TOP = -0.276
"""Height of the table over the shoulder [m]."""
GRASP_RADIUS = 0.14
"""Distance of every grasp point from the object's centre [m]."""
GRASP_POLAR_ANGLE = math.pi / 3
"""Largest angle between straight up and the direction from the object to a grasp point [rad]."""


class WAMGrasp(WAMTask):
    """Bring the tool face to a random grasp point around an object, facing its centre (section A.1.2).

    Actuation: joint velocities ``(N, 7)`` [rad/s]. Reward: -1 a step, 0 while the tool is within ``success_radius`` of
    the grasp point and its face normal within ``tilt_tolerance`` of the line from there to the object's centre. A
    collision of the arm or the tool with the object or the table is a failure: from then on every step costs -1 and
    the episode cannot succeed. The object never moves, and the arm passes through what it collided with.

    Grasp points are uniform over the part of their sphere that is less than ``GRASP_POLAR_ANGLE`` from straight up and
    that the arm can reach exactly, clear of collisions and of its brakes: see ``reachable_polar_angle``.

    Args:
        num_envs: number of copies N.
        num_threads: native threads that share the copies.
        seed: seed of grasp points and starts.
        start_noise: largest distance of every joint from ``HOME`` at the start [rad].
        tilt_tolerance: allowed angle between the face normal and the direction to the object's centre [rad].
        success_radius: distance to the grasp point that counts as reached [m].
        terminate_on_failure: end an episode at a collision; by default it goes on, absorbing.
        terminate_on_success: end an episode at the goal, for demonstrations; by default it goes on.
        max_episode_steps: environment steps of 0.02 s in an episode.

    Raises:
        ValueError: if a tolerance or radius is not positive, or the start noise is not in [0, 0.25] rad.
    """

    observation_sizes: ClassVar[dict[str, int]] = {
        "observation": 13,
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
        start_noise: float = 0.2,
        tilt_tolerance: float = math.pi / 16,
        success_radius: float = 0.03,
        terminate_on_failure: bool = False,
        terminate_on_success: bool = False,
        max_episode_steps: int = 200,
    ) -> None:
        if not 0 <= start_noise <= 0.25:
            raise ValueError(f"start_noise must lie in [0, 0.25] rad, got {start_noise}.")
        super().__init__(
            grasp_model(),
            num_envs=num_envs,
            num_threads=num_threads,
            seed=seed,
            success_radius=success_radius,
            tilt_tolerance=tilt_tolerance,
            terminate_on_failure=terminate_on_failure,
            terminate_on_success=terminate_on_success,
            max_episode_steps=max_episode_steps,
        )
        self.start_noise = start_noise
        self._arm = ArmGeoms(self.model)
        self.reset()

    def _draw_start(self, rows: NDArray[np.intp]) -> None:
        self.goal[rows] = draw_grasp_points(self.rng, len(rows))
        self.failed[rows] = False
        # No posture that near to HOME collides or touches a brake.
        self.qpos[rows] = HOME + self.start_noise * self.rng.uniform(-1.0, 1.0, (len(rows), 7))
        self._update_pose()

    def observe(self) -> dict[str, Array]:
        """Joint angles [rad], tool position and grasp point [m], and all of them in one (13 numbers)."""
        parts = [self.qpos, self._position, self.goal]
        return {"observation": np.concatenate(parts, axis=1), **self._observe_arm()}

    def _update_pose(self) -> None:
        self._placed = self._arm.place(self.qpos)
        self._position, self._normal = self._placed.tool_position, self._placed.tool_axis

    def _violates(self) -> Flags:
        return clearance(self._arm, self._placed) < 0

    def _at_goal(self) -> Flags:
        to_goal = self.goal - self._position
        near = np.einsum("ij,ij->i", to_goal, to_goal) < self.success_radius**2
        to_centre = (OBJECT_CENTRE - self.goal) / GRASP_RADIUS
        return near & (np.einsum("ij,ij->i", to_centre, self._normal) > math.cos(self.tilt_tolerance))

    def decorate(self, scene: mujoco.MjvScene, row: int) -> None:
        """Draw the grasp point, in a halo wider than the tool, and the line on which the tool's axis has to lie.

        Orange, green once the goal is reached, red after a collision.
        """
        colour = self._colour(row)
        sphere, line = mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE
        goal = self.goal[row]
        outward = (goal - OBJECT_CENTRE) / GRASP_RADIUS
        for radius, opacity in ((self.success_radius, 0.6), (1.8 * self.success_radius, 0.3)):
            _add_geom(scene, sphere, radius, goal, (*colour, opacity))
        pin = _add_geom(scene, line, 0.0, goal, (*colour, 1.0))
        ends = OBJECT_CENTRE + np.outer([OBJECT_RADIUS, 2 * GRASP_RADIUS - OBJECT_RADIUS], outward)
        mujoco.mjv_connector(pin, line, 0.004, *ends)


def _add_geom(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, size: float, position: Array, colour: tuple[float, ...]
) -> mujoco.MjvGeom:
    scene.ngeom += 1
    geom = scene.geoms[scene.ngeom - 1]
    rgba = np.array(colour, dtype=np.float32)
    mujoco.mjv_initGeom(geom, kind, np.full(3, size), position, np.eye(3).ravel(), rgba)
    return geom


def grasp_model() -> mujoco.MjModel:
    """The arm, the table and the object."""
    return load_model(ASSETS / "wam_grasp.xml")


def clearance(arm: ArmGeoms, placed: Placed) -> Array:
    """Distance ``(N,)`` [m] of the whole moving arm from object and table; negative where it cuts into one of them."""
    to_object = arm.distance_to_sphere(placed, OBJECT_CENTRE, OBJECT_RADIUS)
    return np.minimum(to_object, arm.distance_to_floor(placed, TABLE_TOP)).min(axis=1)


def grasp_point(polar: Array, azimuth: Array) -> Array:
    """Points ``(N, 3)`` [m] of the grasp sphere: polar angle from straight up, azimuth from the far side."""
    direction = [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    return OBJECT_CENTRE + GRASP_RADIUS * np.stack(direction, axis=-1)


def draw_grasp_points(rng: np.random.Generator, count: int) -> Array:
    """Grasp points ``(count, 3)`` [m], uniform over the part of the sphere that can be reached."""
    azimuths, limits = reachable_polar_angle()
    polar, azimuth = np.empty((2, count))
    missing = np.arange(count)
    while len(missing):
        polar[missing] = np.arccos(rng.uniform(math.cos(GRASP_POLAR_ANGLE), 1.0, len(missing)))
        azimuth[missing] = rng.uniform(-math.pi, math.pi, len(missing))
        missing = missing[polar[missing] > np.interp(azimuth[missing], azimuths, limits)]
    return grasp_point(polar, azimuth)


@cache
def reachable_polar_angle() -> tuple[Array, Array]:
    """How far from straight up grasp points can be reached, by azimuth [rad]: the wrist pitch sets the limit.

    From ``HOME`` the tool is led over the top of the object and down every meridian, degree by degree, until the exact
    posture would collide or stand in a brake's zone. One degree is kept as a margin for what lies between the
    meridians.

    Returns:
        azimuths and the largest polar angle on each, both ``(121,)``.
    """
    degree, count = math.pi / 180, 121
    arm, azimuth = ArmGeoms(grasp_model()), np.linspace(-math.pi, math.pi, count)
    posture, limit = np.tile(HOME, (count, 1)), np.zeros(count)
    going = np.ones(count, dtype=bool)
    for polar in np.arange(0.0, GRASP_POLAR_ANGLE + 1e-9, degree):
        posture, exact = grasp_posture(grasp_point(np.full(count, polar), azimuth), posture, iterations=6)
        inside = ((posture > BRAKE_LOW) & (posture < BRAKE_HIGH)).all(axis=1)
        going &= exact & inside & (clearance(arm, arm.place(posture)) > 0)
        limit[going] = polar
    return azimuth, np.where(going, GRASP_POLAR_ANGLE, limit - degree)


def grasp_posture(target: Array, start: Array, iterations: int = 20) -> tuple[Array, Flags]:
    """Postures with the tool face at ``target``, facing the object's centre: Newton steps of least norm.

    Args:
        target: grasp points [m], ``(N, 3)``.
        start: where the steps begin, joint angles ``(N, 7)`` [rad].
        iterations: Newton steps.

    Returns:
        joint angles ``(N, 7)`` [rad], and ``(N,)`` whether they solve the task to 1e-6. Limits are not looked at.
    """
    posture, facing = (
        start,
        (OBJECT_CENTRE - target) / np.linalg.norm(OBJECT_CENTRE - target, axis=1)[:, None],
    )
    for _ in range(iterations):
        pose = forward_kinematics(posture)
        error = np.concatenate([target - pose.position, facing - pose.normal], axis=1)
        jacobian = np.concatenate([pose.linear_jacobian(), pose.normal_jacobian()], axis=1)
        posture = posture + np.clip(damped_solve(jacobian, error), -0.3, 0.3)
    position, normal = tool_pose(posture)
    error = np.linalg.norm(target - position, axis=1) + np.linalg.norm(facing - normal, axis=1)
    return posture, error < 1e-6
