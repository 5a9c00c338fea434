"""Gymnasium's planar runners on the batched engine: HalfCheetah, Hopper and Walker2d as in their version 5.

Model files, observations, rewards, reset noise, ends, option names and defaults are those of ``gymnasium``. From equal
states one step equals Gymnasium's to 1e-9 in float64; whole episodes drift apart, since contacts are chaotic. Where
version 4 differs from version 5, the task's docstring says so.
"""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array, Flags, Seed
from nht.envs.models import load_model
from nht.envs.task import BatchedTask

Range = tuple[float, float]
T = TypeVar("T")


class Locomotion(BatchedTask):
    """Run along x, for speed less the cost of the actuation, and for being healthy where one can fall.

    Actuation: the motors' controls ``(N, n)``, in [-1, 1]. Nothing counts as success; being unhealthy is the failure.
    An option that is None takes Gymnasium's default, which the class states.

    Args:
        num_envs: number of copies N.
        num_threads: native threads that share the copies.
        seed: seed of the starts.
        forward_reward_weight: reward per speed along x [s/m].
        ctrl_cost_weight: cost of the sum of the squared actuation.
        reset_noise_scale: spread of the noise on positions and velocities at the start.
        max_episode_steps: environment steps in an episode.

    Raises:
        ValueError: if a count is below 1, or the noise negative.
    """

    file: ClassVar[str]
    """The model's file among Gymnasium's assets."""
    frame_skip: ClassVar[int]
    """Simulation steps in one environment step."""
    default_ctrl_cost_weight: ClassVar[float]
    default_reset_noise_scale: ClassVar[float]
    gaussian_velocity: ClassVar[bool] = False
    """Start velocities are normal instead of uniform."""
    velocity_clip: ClassVar[float] = math.inf
    """Observed velocities are clipped to this absolute value [m/s, rad/s]."""
    hidden: ClassVar[int] = 1
    """Number of coordinates that are not observed: the robot's place on the floor."""

    # Those who can fall have these as options.
    healthy_reward = 0.0
    terminate_when_unhealthy = False

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        seed: Seed = None,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float | None = None,
        reset_noise_scale: float | None = None,
        max_episode_steps: int = 1_000,
    ) -> None:
        super().__init__(
            load_model(gymnasium_model(self.file)),
            num_envs=num_envs,
            substeps=self.frame_skip,
            max_episode_steps=max_episode_steps,
            num_threads=num_threads,
            seed=seed,
        )
        self.forward_reward_weight = forward_reward_weight
        self.ctrl_cost_weight = or_default(ctrl_cost_weight, self.default_ctrl_cost_weight)
        self.reset_noise_scale = or_default(reset_noise_scale, self.default_reset_noise_scale)
        if not self.reset_noise_scale >= 0:
            raise ValueError(f"reset_noise_scale must not be negative, got {reset_noise_scale}.")
        low, high = self.model.actuator_ctrlrange.T.copy()
        self._bounds = low, high
        self._prepare()
        self.reset()

    def _prepare(self) -> None:
        """Set up what a subclass needs before the first reset."""

    @property
    def observation_sizes(self) -> dict[str, int]:
        """Length of every observation by its key."""
        driven = self.model.nu
        whole = self.model.nq - self.hidden + self.model.nv
        return {"observation": whole, "joint_angle": driven, "joint_velocity": driven}

    @property
    def actuation_bounds(self) -> tuple[Array, Array]:
        """The motors' control ranges."""
        return self._bounds

    def _draw_start(self, rows: NDArray[np.intp]) -> None:
        noise, count = self.reset_noise_scale, len(rows)
        self.qpos[rows] = self.model.qpos0 + self.rng.uniform(-noise, noise, (count, self.model.nq))
        if self.gaussian_velocity:
            self.qvel[rows] = noise * self.rng.standard_normal((count, self.model.nv))
        else:
            self.qvel[rows] = self.rng.uniform(-noise, noise, (count, self.model.nv))

    def observe(self) -> dict[str, Array]:
        """Positions but those on the floor, and velocities [m, rad, m/s, rad/s]; also those of the driven joints."""
        clip = self.velocity_clip
        velocity = self.qvel if clip == math.inf else self.qvel.clip(-clip, clip)
        driven = self.model.nu
        return {
            "observation": np.concatenate([self.qpos[:, self.hidden :], velocity], axis=1),
            "joint_angle": self.qpos[:, -driven:].copy(),
            "joint_velocity": velocity[:, -driven:].copy(),
        }

    def _apply(self, actuation: Array) -> None:
        super()._apply(actuation)
        self._x_before = self._position().copy()

    def _position(self) -> Array:
        """Position of each copy along x [m], ``(N,)``; its change is the progress."""
        return self.qpos[:, 0]

    def _judge(self, actuation: Array) -> tuple[Array, Flags, Flags, Flags]:
        healthy = self._healthy()
        speed = (self._position() - self._x_before) / self.time_per_step
        cost = self.ctrl_cost_weight * np.einsum("ij,ij->i", actuation, actuation)
        reward = self.forward_reward_weight * speed + self.healthy_reward * healthy - cost
        ended = ~healthy & self.terminate_when_unhealthy
        return reward, ended, np.zeros_like(healthy), ~healthy

    def _healthy(self) -> Flags:
        """Which copies are healthy, ``(N,)``."""
        return np.ones(self.num_envs, dtype=bool)


class HalfCheetah(Locomotion):
    """Gymnasium's HalfCheetah: 6 motors, 17 observed numbers, 0.05 s a step. Versions 4 and 5 are the same."""

    file = "half_cheetah.xml"
    frame_skip = 5
    default_ctrl_cost_weight = 0.1
    default_reset_noise_scale = 0.1
    gaussian_velocity = True


class Walker2d(Locomotion):
    """Gymnasium's Walker2d-v5: 6 motors on two legs, 17 observed numbers, 0.008 s a step.

    Version 4 has a model of its own, whose right foot slips more, and pays the healthy reward also when falling.

    Args:
        num_envs, num_threads, seed, forward_reward_weight, ctrl_cost_weight, reset_noise_scale, max_episode_steps:
            as of every ``Locomotion``.
        healthy_reward: reward of a step that leaves the robot healthy.
        terminate_when_unhealthy: end the episode at a fall.
        healthy_z_range: heights of the torso that are healthy [m].
        healthy_angle_range: pitches of the torso that are healthy [rad].
    """

    file = "walker2d_v5.xml"
    frame_skip = 4
    default_ctrl_cost_weight = 1e-3
    default_reset_noise_scale = 5e-3
    velocity_clip = 10.0
    default_healthy_z_range: ClassVar[Range] = (0.8, 2.0)
    default_healthy_angle_range: ClassVar[Range] = (-1.0, 1.0)

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        seed: Seed = None,
        *,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float | None = None,
        healthy_reward: float = 1.0,
        terminate_when_unhealthy: bool = True,
        healthy_z_range: Range | None = None,
        healthy_angle_range: Range | None = None,
        reset_noise_scale: float | None = None,
        max_episode_steps: int = 1_000,
    ) -> None:
        super().__init__(
            num_envs,
            num_threads,
            seed,
            forward_reward_weight=forward_reward_weight,
            ctrl_cost_weight=ctrl_cost_weight,
            reset_noise_scale=reset_noise_scale,
            max_episode_steps=max_episode_steps,
        )
        self.healthy_reward = healthy_reward
        self.terminate_when_unhealthy = terminate_when_unhealthy
        self.healthy_z_range = or_default(healthy_z_range, self.default_healthy_z_range)
        self.healthy_angle_range = or_default(healthy_angle_range, self.default_healthy_angle_range)

    def _healthy(self) -> Flags:
        _, z, angle = self.qpos[:, :3].T
        return within(z, self.healthy_z_range) & within(angle, self.healthy_angle_range)


class Hopper(Walker2d):
    """Gymnasium's Hopper-v5: 3 motors on one leg, 11 observed numbers, 0.008 s a step. Options as of ``Walker2d``.

    Unhealthy is also a joint angle or a velocity beyond 100. Version 4 pays the healthy reward also when falling.
    """

    file = "hopper.xml"
    default_healthy_z_range = (0.7, math.inf)
    default_healthy_angle_range = (-0.2, 0.2)

    def _healthy(self) -> Flags:
        # Laid out as time, qpos, qvel: the height has a range of its own.
        moderate = within(self.state[:, 3:], (-100.0, 100.0)).all(axis=1)
        return super()._healthy() & moderate


def within(values: Array, bounds: Range) -> Flags:
    """Which values lie strictly between the bounds."""
    low, high = bounds
    return (low < values) & (values < high)


def or_default(value: T | None, default: T) -> T:
    """``value``, or ``default`` in place of None."""
    return default if value is None else value


def gymnasium_model(file: str) -> Path:
    """Path of a model file that ``gymnasium`` brings with it."""
    return Path(str(resources.files("gymnasium") / "envs" / "mujoco" / "assets" / file))
