"""The cheetah of dm_control's suite on the batched engine."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array, Flags, Seed
from nht.envs.dm_control import suite_module, tolerance
from nht.envs.suite_task import SuiteTask

RUN_SPEED = 10.0
"""Speed of the centre of mass that earns the full reward [m/s]."""
SETTLING_STEPS = 200
"""Simulation steps without control before an episode starts."""


class CheetahRun(SuiteTask):
    """dm_control's cheetah-run: 6 motors, 17 observed numbers, 0.01 s a step.

    Actuation: the motors' controls ``(N, 6)``, in [-1, 1]. Reward: the forward speed of the centre of mass, in units of
    10 m/s, within [0, 1]. Episodes start with joint angles anywhere within their limits, settled for 2 s.

    Args:
        num_envs: number of copies N.
        num_threads: native threads that share the copies.
        seed: seed of the starts.
        max_episode_steps: environment steps in an episode.

    Raises:
        ImportError: if dm_control is not installed.
        ValueError: if a count is below 1.
    """

    def __init__(
        self,
        num_envs: int = 1,
        num_threads: int = 1,
        seed: Seed = None,
        *,
        max_episode_steps: int = 1_000,
    ) -> None:
        xml, assets = suite_module("cheetah").get_model_and_assets()
        super().__init__(
            "cheetah-run",
            xml,
            assets,
            control_timestep=0.01,
            num_envs=num_envs,
            num_threads=num_threads,
            seed=seed,
            max_episode_steps=max_episode_steps,
        )
        self._limited = np.flatnonzero(self.model.jnt_limited)
        self._first_step = mujoco.MjData(self.model)
        mujoco.mj_step(self.model, self._first_step)
        self._links = Links(self.model)
        self.reset()

    @property
    def observation_sizes(self) -> dict[str, int]:
        """Length of every observation by its key."""
        return {"observation": 17, "position": 8, "velocity": 9}

    def _entries(self) -> dict[str, Array]:
        return {"position": self.qpos[:, 1:].copy(), "velocity": self.qvel.copy()}

    def _draw_start(self, rows: NDArray[np.intp]) -> None:
        low, high = self.model.jnt_range[self._limited].T
        self.settle(rows, self.rng.uniform(low, high, (len(rows), len(low))))

    def settle(self, rows: NDArray[np.intp], joint_angle: Array) -> None:
        """Start episodes of the copies ``rows`` from joint angles ``(len(rows), 6)`` [rad], after they came to rest.

        As in the suite, the first step moves with the accelerations of the model's reference posture.
        """
        first = self._first_step
        self.qpos[rows] = self.model.qpos0
        self.qpos[np.ix_(rows, self._limited)] = joint_angle
        self.qpos[rows] += self.model.opt.timestep * first.qvel
        self.qvel[rows] = first.qvel
        assert self._rollout is not None
        states, _ = self._rollout.rollout(
            [self.model] * len(rows),
            self._data,
            self.state[rows],
            np.zeros((len(rows), SETTLING_STEPS - 1, self.model.nu)),  # else it keeps the last step's control
            nstep=SETTLING_STEPS - 1,
            initial_warmstart=np.tile(first.qacc_warmstart, (len(rows), 1)),
        )
        self.state[rows, 1:] = states[:, -1, 1:]

    def _judge(self, actuation: Array) -> tuple[Array, Flags, Flags, Flags]:
        speed = self._links.forward_speed(self.qpos, self.qvel)
        reward = tolerance(
            speed, bounds=(RUN_SPEED, np.inf), margin=RUN_SPEED, value_at_margin=0.0, sigmoid="linear"
        )
        never = np.zeros(self.num_envs, dtype=bool)
        return reward, never, never.copy(), never.copy()


class Links:
    """Masses and lengths of a planar tree of hinges, for the speed of its centre of mass.

    The sensor that the suite reads belongs, in a batched rollout, to the state before the last simulation step.

    Args:
        model: its joints are two slides, along x and z, and hinges about y; bodies are not turned in their parents.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        bodies, hinges = model.nbody - 1, model.nv - 2
        # Which hinges turn a body: its own and those of all bodies that it hangs on.
        self._turned_by: Array = np.zeros((hinges, bodies))
        share = model.body_mass[1:] / model.body_mass.sum()
        # Where the masses are, seen from each body's frame: its own, and those that hang on it.
        self._lever: Array = share[:, None] * model.body_ipos[1:]
        for body in range(bodies):
            parent = model.body_parentid[body + 1] - 1
            if parent >= 0:
                self._turned_by[:, body] = self._turned_by[:, parent]
            self._turned_by[model.body_dofadr[body + 1] + model.body_dofnum[body + 1] - 3, body] = 1.0
            if parent >= 0:
                hanging = model.body_subtreemass[body + 1] / model.body_mass.sum()
                self._lever[parent] += hanging * model.body_pos[body + 1]

    def forward_speed(self, qpos: Array, qvel: Array) -> Array:
        """Speed of the centre of mass along x [m/s], ``(N,)``."""
        angle, rate = qpos[:, 2:] @ self._turned_by, qvel[:, 2:] @ self._turned_by
        x, _, z = self._lever.T
        return qvel[:, 0] + np.einsum("nb,nb->n", rate, z * np.cos(angle) - x * np.sin(angle))
