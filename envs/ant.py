"""Gymnasium's Ant on the batched engine, as in its version 5, with contact forces."""

from __future__ import annotations

import math
from typing import ClassVar

import mujoco
import numpy as np

from nht.envs.arrays import Array, Flags, Rows, Seed
from nht.envs.free_motion import moved, stage_velocity
from nht.envs.locomotion import Locomotion, Range, gymnasium_model

# Of a contact sensor: force, torque and position (bits 1, 2 and 4), of all contacts together.
CONTACT_FIELDS, NET_FORCE = 1 << 1 | 1 << 2 | 1 << 4, 3


class Ant(Locomotion):
    """Gymnasium's Ant-v5: 8 motors on four legs, 105 observed numbers, 0.05 s a step.

    Of the observation the last 78 numbers are ``cfrc_ext``: torque and force [N m, N] of the contacts on each of the
    13 bodies, clipped; ``include_cfrc_ext_in_observation=False`` leaves 27. Version 4 is that, with
    ``contact_cost_weight=0``, and pays the healthy reward also when falling.

    Gymnasium reads the torso's position and the forces where MuJoCo computed them last. With Ant's Runge-Kutta
    integrator that is not the state in which a step ends, but the fourth stage of its last substep, and
    ``mujoco.rollout`` returns states only. So that substep is taken here, stage by stage, for all copies at once.

    Args:
        num_envs, num_threads, seed, forward_reward_weight, ctrl_cost_weight, reset_noise_scale, max_episode_steps:
            as of every ``Locomotion``.
        contact_cost_weight: cost of the sum of the squared, clipped ``cfrc_ext``.
        healthy_reward: reward of a step that leaves the robot healthy.
        terminate_when_unhealthy: end the episode at a fall, or a jump.
        healthy_z_range: heights of the torso that are healthy [m].
        contact_force_range: bounds of every entry of ``cfrc_ext``.
        include_cfrc_ext_in_observation: observe the contact forces.
    """

    file = "ant.xml"
    frame_skip = 5
    default_ctrl_cost_weight = 0.5
    default_reset_noise_scale = 0.1
    gaussian_velocity = True
    hidden = 2
    _episode_arrays: ClassVar[tuple[str, ...]] = ("torso_x", "contact_force")

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        seed: Seed = None,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float | None = None,
        contact_cost_weight: float = 5e-4,
        healthy_reward: float = 1.0,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: Range = (0.2, 1.0),
        contact_force_range: Range = (-1.0, 1.0),
        reset_noise_scale: float | None = None,
        include_cfrc_ext_in_observation: bool = True,
        max_episode_steps: int = 1_000,
    ) -> None:
        self.contact_cost_weight = contact_cost_weight
        self.healthy_reward = healthy_reward
        self.terminate_when_unhealthy = terminate_when_unhealthy
        self.healthy_z_range = healthy_z_range
        self.contact_force_range = contact_force_range
        self.include_cfrc_ext_in_observation = include_cfrc_ext_in_observation
        super().__init__(
            num_envs,
            num_threads,
            seed,
            forward_reward_weight=forward_reward_weight,
            ctrl_cost_weight=ctrl_cost_weight,
            reset_noise_scale=reset_noise_scale,
            max_episode_steps=max_episode_steps,
        )

    def _prepare(self) -> None:
        kept_back = 1  # substep
        self._control = self._control[:, kept_back:].copy()
        self._trajectory = self._trajectory[:, kept_back:].copy()
        self._sensing = sensing_model(self.file)
        self._sensing_data = [mujoco.MjData(self._sensing) for _ in range(self.num_threads)]
        self._after: Array = np.zeros((self.num_envs, 1, self.state.shape[1]))
        self._sensed: Array = np.zeros((self.num_envs, 1, self._sensing.nsensordata))
        self.torso_x: Array = np.zeros(self.num_envs)
        self.contact_force: Array = np.zeros((self.num_envs, 6 * (self.model.nbody - 1)))

    @property
    def observation_sizes(self) -> dict[str, int]:
        """Length of every observation by its key."""
        sizes = super().observation_sizes
        forces = self.contact_force.shape[1] * self.include_cfrc_ext_in_observation
        return sizes | {"observation": sizes["observation"] + forces}

    def observe(self) -> dict[str, Array]:
        """Positions but x and y, velocities and contact forces; also positions and velocities of the driven joints."""
        observed = super().observe()
        if self.include_cfrc_ext_in_observation:
            parts = [observed["observation"], self.contact_force]
            observed["observation"] = np.concatenate(parts, axis=1)
        return observed

    def _draw_start(self, rows: Rows) -> None:
        super()._draw_start(rows)
        self._forget_last_step(rows)

    def set_state(
        self, qpos: Array, qvel: Array, rows: Rows | None = None, *, tolerance: float = 0.1
    ) -> None:
        """Set states as every task does; contact forces read 0 until the next step, as after Gymnasium's reset."""
        super().set_state(qpos, qvel, rows, tolerance=tolerance)
        self._forget_last_step(np.arange(self.num_envs) if rows is None else rows)

    def _forget_last_step(self, rows: Rows) -> None:
        self.torso_x[rows] = self.qpos[rows, 0]
        self.contact_force[rows] = 0.0

    def _position(self) -> Array:
        return self.torso_x

    def _healthy(self) -> Flags:
        low, high = self.healthy_z_range
        return (low <= self.qpos[:, 2]) & (self.qpos[:, 2] <= high)

    def _judge(self, actuation: Array) -> tuple[Array, Flags, Flags, Flags]:
        reward, *flags = super()._judge(actuation)
        squares = np.einsum("ij,ij->i", self.contact_force, self.contact_force)
        return reward - self.contact_cost_weight * squares, *flags

    def _advance(self, applied: Array, rows: Rows | None = None) -> Flags:
        diverged = super()._advance(applied, rows)
        self._forget_last_step(np.flatnonzero(diverged))
        return diverged

    def _complete(self, trajectory: Array, control: Array, rows: Rows | slice) -> Array:
        """Take the last substep by the four stages of the classical Runge-Kutta method, as MuJoCo does."""
        after = trajectory[:, -1]
        time, q, v_1 = after[:, :1], after[:, 1 : 1 + self.model.nq], after[:, 1 + self.model.nq :]
        step, before = self.model.opt.timestep, trajectory[:, -2, 1 + self.model.nq :]
        a_1 = self._acceleration(q, v_1, control, guess=(v_1 - before) / step)
        v_2 = v_1 + step / 2 * a_1
        a_2 = self._acceleration(moved(q, v_1, step / 2), v_2, control, guess=a_1)
        w_2 = stage_velocity(v_2, v_1, step / 2)
        v_3 = v_1 + step / 2 * a_2
        a_3 = self._acceleration(moved(q, w_2, step / 2), v_3, control, guess=a_2)
        w_3 = stage_velocity(v_3, w_2, step / 2)
        v_4 = v_1 + step * a_3
        q_4 = moved(q, w_3, step)
        a_4 = self._acceleration(q_4, v_4, control, guess=a_3)
        w_4 = stage_velocity(v_4, w_3, step)
        self.torso_x[rows] = q_4[:, 0]
        self.contact_force[rows] = self._external_forces(len(q)).clip(*self.contact_force_range)

        position = moved(q, (v_1 + 2 * w_2 + 2 * w_3 + w_4) / 6, step)
        velocity = v_1 + step / 6 * (a_1 + 2 * a_2 + 2 * a_3 + a_4)
        return np.concatenate([time + step, position, velocity], axis=1)

    def _acceleration(self, q: Array, v: Array, control: Array, guess: Array) -> Array:
        """Acceleration ``(M, nv)`` of M copies at a state; leaves behind what the sensors read there.

        Args:
            q: positions ``(M, nq)``.
            v: velocities ``(M, nv)``.
            control: of the substeps before, ``(M, substeps, nu)``.
            guess: acceleration ``(M, nv)`` that the solver starts from.
        """
        assert self._rollout is not None
        count = len(q)
        time = np.ones((count, 1))
        self._rollout.rollout(
            [self._sensing] * count,
            self._sensing_data,
            np.concatenate([time, q, v], axis=1),
            control[:, :1].copy(),
            control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            skip_checks=True,
            nstep=1,
            initial_warmstart=guess,
            state=self._after[:count],
            sensordata=self._sensed[:count],
        )
        after = self._after[:count, 0]
        acceleration = (after[:, -v.shape[1] :] - v) / self.model.opt.timestep
        acceleration[after[:, 0] < 1] = math.nan  # MuJoCo answers bad numbers by a reset, of the clock too
        return acceleration

    def _external_forces(self, count: int) -> Array:
        """MuJoCo's ``cfrc_ext``: torque about the robot's centre of mass and force on each body, ``(M, 6 bodies)``."""
        centre, contacts = self._sensed[:count, 0, :3], self._sensed[:count, 0, 3:].reshape(count, -1, 9)
        force, torque, point = np.split(contacts, 3, axis=2)
        about_centre = torque + np.cross(point - centre[:, None], force)
        return np.concatenate([about_centre, force], axis=2).reshape(count, -1)


def sensing_model(file: str) -> mujoco.MjModel:
    """Gymnasium's model with sensors of the centre of mass and of the contacts on each body.

    Its steps are Euler's without implicit damping, so that they show the acceleration: v + h a.
    """
    spec = mujoco.MjSpec.from_file(str(gymnasium_model(file)))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    _, *bodies = spec.bodies  # the first is the world
    for number, body in enumerate(bodies):
        body.name = body.name or f"unnamed {number}"
    spec.add_sensor(
        type=mujoco.mjtSensor.mjSENS_SUBTREECOM, objtype=mujoco.mjtObj.mjOBJ_BODY, objname=bodies[0].name
    )
    for body in bodies:
        spec.add_sensor(
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            reftype=mujoco.mjtObj.mjOBJ_BODY,
            refname=body.name,
            intprm=[CONTACT_FIELDS, NET_FORCE, 1],
        )
    return spec.compile()
