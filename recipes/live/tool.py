"""The tool of a robot: where it is, and how actuations move it."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from nht.envs.arrays import Array
from nht.recipes.live.mirror import Mirror

SITES = ("tool", "grasp", "grip", "pinch", "end_effector", "ee", "tip")
"""Words in the names of sites that are taken for the tool, the first one first."""
NUDGE = 1e-6
"""Of the controls, for derivatives."""


class Tool:
    """A point of a robot that people look at.

    Args:
        mirror: the robot.
        name: of a site, body or geom of the model; None takes a site that sounds like a tool, or else the body at the
            end of the longest chain of joints.
        velocities: whether actuations are the velocities of all joints, as of an arm that moves kinematically;
            otherwise they are the model's controls.

    Raises:
        ValueError: if the model has no such part; names some that it has.
    """

    def __init__(self, mirror: Mirror, name: str | None = None, *, velocities: bool = False) -> None:
        self._mirror, self._velocities = mirror, velocities
        self.kind, self.id = _found(mirror.model, name) if name else _likely(mirror.model)

    @property
    def position(self) -> Array:
        """Where it is [m], ``(3,)``."""
        data = self._mirror.data
        places = {
            mujoco.mjtObj.mjOBJ_SITE: data.site_xpos,
            mujoco.mjtObj.mjOBJ_BODY: data.xpos,
            mujoco.mjtObj.mjOBJ_GEOM: data.geom_xpos,
        }
        return np.array(places[self.kind][self.id])

    def jacobian(self) -> Array:
        """Linear [m/s] and angular [rad/s] velocity of the tool per joint velocity, in the world, ``(6, nv)``."""
        model, data = self._mirror.model, self._mirror.data
        found = np.zeros((6, model.nv))
        compute = {
            mujoco.mjtObj.mjOBJ_SITE: mujoco.mj_jacSite,
            mujoco.mjtObj.mjOBJ_BODY: mujoco.mj_jacBody,
            mujoco.mjtObj.mjOBJ_GEOM: mujoco.mj_jacGeom,
        }
        compute[self.kind](model, data, found[:3], found[3:], self.id)
        return found

    @property
    def moves_by(self) -> str:
        """What an actuation gives the tool at once: ``"velocity"``, ``"acceleration"`` or, if unknown, ``""``."""
        if self._velocities:
            return "velocity"
        return "acceleration" if self._mirror.model.nu else ""

    def motion(self, motors: int) -> Array | None:
        """What each motor gives the tool, ``(6, n)``: linear above angular.

        An arm's joint velocities give it a velocity, J(q) u. Controls of a model with dynamics give it an acceleration,
        J dv/du over one simulation step, by finite differences of the simulator.

        Args:
            motors: n.

        Returns:
            None if that is unknown.
        """
        model, data = self._mirror.model, self._mirror.data
        if self._velocities and model.nv == motors:
            return self.jacobian()
        if model.nu != motors:
            return None
        size = 2 * model.nv + model.na
        effect = np.zeros((size, model.nu))
        mujoco.mjd_transitionFD(model, data, NUDGE, False, None, effect, None, None)
        return self.jacobian() @ effect[model.nv : 2 * model.nv] / model.opt.timestep


def angle_to_jacobian(effects: Array, jacobian: Array) -> float:
    """The largest angle between what actions do to the joints and the joint motions that move the tool [rad].

    It is 0 if every action moves the tool as economically as the Jacobian's pseudo-inverse would, and grows with the
    share of an action that only moves the arm within itself.

    Args:
        effects: the map's Q, ``(n, k)``.
        jacobian: J, ``(6, n)``.
    """
    span, rows = _orthonormal(effects), _orthonormal(jacobian.T)
    if not span.shape[1] or not rows.shape[1]:
        return 0.0
    outside = span - rows @ (rows.T @ span)
    return math.asin(min(1.0, float(np.linalg.norm(outside, ord=2))))


def rises(velocity: Array) -> float:
    """The angle by which a motion ``(3,)`` leaves the horizontal plane [rad], downwards negative."""
    length = float(np.linalg.norm(velocity))
    return math.asin(min(1.0, max(-1.0, float(velocity[2] / length)))) if length > 1e-9 else 0.0


def _orthonormal(columns: Array) -> Array:
    """Orthonormal columns with the span of ``columns``."""
    left, singular, _ = np.linalg.svd(columns, full_matrices=False)
    return left[:, singular > 1e-6 * max(singular.max(initial=0.0), 1e-12)]


def _found(model: mujoco.MjModel, name: str) -> tuple[mujoco.mjtObj, int]:
    kinds = (mujoco.mjtObj.mjOBJ_SITE, mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_GEOM)
    for kind in kinds:
        if (number := mujoco.mj_name2id(model, kind, name)) >= 0:
            return kind, number
    sites = [model.site(i).name for i in range(model.nsite)]
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    raise ValueError(f"the model has no part {name!r}: its sites are {sites[:30]}, its bodies {bodies[:60]}.")


def _likely(model: mujoco.MjModel) -> tuple[mujoco.mjtObj, int]:
    names = [model.site(i).name.lower() for i in range(model.nsite)]
    for word in SITES:
        for number, name in enumerate(names):
            if word in name.replace("-", "_").split("_") and model.body_weldid[model.site_bodyid[number]]:
                return mujoco.mjtObj.mjOBJ_SITE, number
    joints = [_joints_before(model, body) for body in range(model.nbody)]
    return mujoco.mjtObj.mjOBJ_BODY, int(np.argmax(joints))


def _joints_before(model: mujoco.MjModel, body: int) -> int:
    """Number of degrees of freedom between the world and a body."""
    count = 0
    while body:
        count += int(model.body_dofnum[body])
        body = int(model.body_parentid[body])
    return count
