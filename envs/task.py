"""N copies of one MuJoCo task in numpy: one native call advances all of them.

A task is the physics-facing half of an environment. It knows neither TorchRL nor Gymnasium; the adapters in
``mujoco_batch.py`` and ``gymnasium_env.py`` turn it into theirs.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

ASSETS = Path(__file__).parent / "assets"
LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Outcome:
    """What one environment step brought, a row per copy; every array is the caller's own.

    ``truncated`` is the time limit, ``terminated`` an end that belongs to the task; they are never merged.
    ``diverged`` marks copies whose actuation or physics was not finite: they failed and wait for a reset.
    """

    reward: Array
    terminated: Flags
    truncated: Flags
    success: Flags
    failure: Flags
    diverged: Flags


class BatchedTask(ABC):
    """N copies of a task, each a row of one state array, stepped together by ``mujoco.rollout``.

    A subclass says how an actuation enters the simulation, where episodes start, what is observed and what counts
    as success and failure. Quantities that differ between copies (goals, flags) live in arrays of the task, not
    in the model, so that all copies share one ``MjModel``.

    Args:
        model: the compiled model, shared by all copies.
        num_envs: number of copies N, at least 1.
        substeps: simulation steps in one environment step.
        max_episode_steps: environment steps after which an episode is truncated.
        num_threads: native threads that share the copies; the result does not depend on it.
        seed: seeds the generator that every random draw of the task comes from.

    Raises:
        ValueError: if a count is below 1.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        num_envs: int,
        substeps: int,
        max_episode_steps: int,
        num_threads: int = 1,
        seed: int = 0,
    ) -> None:
        counts = {"num_envs": num_envs, "substeps": substeps, "num_threads": num_threads}
        for name, count in (counts | {"max_episode_steps": max_episode_steps}).items():
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count}.")
        self.model = model
        self.num_envs = num_envs
        self.substeps = substeps
        self.max_episode_steps = max_episode_steps
        self.num_threads = num_threads
        self.time_per_step: float = substeps * model.opt.timestep
        """Simulated time of one environment step [s]."""
        self.seed(seed)

        full_physics = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self.state: Array = np.zeros((num_envs, mujoco.mj_stateSize(model, full_physics)))
        self.steps: NDArray[np.int64] = np.zeros(num_envs, dtype=np.int64)
        # mjSTATE_FULLPHYSICS is laid out as time, qpos, qvel, act, ...
        self.qpos: Array = self.state[:, 1 : 1 + model.nq]
        self.qvel: Array = self.state[:, 1 + model.nq : 1 + model.nq + model.nv]

        self._models = [model] * num_envs
        self._data = [mujoco.MjData(model) for _ in range(num_threads)]
        self._control: Array = np.zeros((num_envs, substeps, model.nu))
        self._trajectory: Array = np.zeros((num_envs, substeps, self.state.shape[1]))
        self._rollout: rollout.Rollout | None = rollout.Rollout(nthread=num_threads if num_threads > 1 else 0)

    def seed(self, seed: int) -> None:
        """Start the generator of all random draws anew."""
        self.rng = np.random.default_rng(seed)

    # What a task adds.

    @property
    @abstractmethod
    def observation_sizes(self) -> dict[str, int]:
        """Length of every observation by its key; ``"observation"`` is what a policy sees."""

    @property
    @abstractmethod
    def actuation_bounds(self) -> tuple[Array, Array]:
        """Lowest and highest actuation, each ``(n,)``."""

    @abstractmethod
    def _draw_start(self, rows: NDArray[np.intp]) -> None:
        """Put the copies ``rows`` at the start of an episode: write ``qpos``, ``qvel`` and the task's own arrays."""

    @abstractmethod
    def observe(self) -> dict[str, Array]:
        """Observations of all copies by key, each ``(N, size)``, in arrays that later steps leave alone."""

    @abstractmethod
    def _judge(self, actuation: Array) -> tuple[Array, Flags, Flags, Flags]:
        """Reward, terminated, success and failure ``(N,)`` after ``actuation`` was carried out."""

    def _apply(self, actuation: Array) -> None:
        """Hand the actuation ``(N, n)`` to the simulation: by default as the control of all substeps."""
        self._control[:] = actuation[:, None, :]

    # What every task shares.

    def reset(self, rows: NDArray[np.intp] | None = None) -> None:
        """Start a new episode in the copies ``rows`` (all by default) and leave the others alone."""
        self._check_open()
        rows = np.arange(self.num_envs) if rows is None else rows
        self.state[rows] = 0.0
        self.steps[rows] = 0
        self._draw_start(rows)

    def step(self, actuation: NDArray[np.floating[Any]]) -> Outcome:
        """Advance all copies by one environment step.

        Args:
            actuation: ``(N, n)``, clipped to its bounds. A row that is not finite ends that copy's episode as a
                failure and leaves the other copies alone.

        Raises:
            ValueError: if the shape of ``actuation`` is another one.
            RuntimeError: if the task is closed.
        """
        self._check_open()
        low, high = self.actuation_bounds
        if actuation.shape != (self.num_envs, low.size):
            raise ValueError(
                f"expected actuation of shape {(self.num_envs, low.size)}, got {actuation.shape}."
            )
        applied = np.clip(actuation, low, high)
        invalid = ~np.isfinite(actuation).all(axis=1)
        applied[invalid] = 0.0
        diverged = invalid | self._advance(applied)
        self.steps += 1

        reward, terminated, success, failure = self._judge(applied)
        return Outcome(
            reward=reward,
            terminated=terminated | diverged,
            truncated=self.steps >= self.max_episode_steps,
            success=success & ~diverged,
            failure=failure | diverged,
            diverged=diverged,
        )

    def _advance(self, applied: Array) -> Flags:
        """Simulate all substeps of all copies; a copy that diverges keeps its last good state and is flagged."""
        self._apply(applied)
        assert self._rollout is not None
        self._rollout.rollout(
            self._models,
            self._data,
            self.state,
            self._control,
            control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            skip_checks=True,
            nstep=self._control.shape[1],
            state=self._trajectory,
        )
        after = self._complete(self._trajectory[:, -1])
        # MuJoCo answers bad numbers by a reset of the simulation and then stands still: its clock falls behind.
        elapsed = after[:, 0] - self.state[:, 0]
        expected = (1 - 0.5 / self.substeps) * self.time_per_step
        diverged = ~(np.isfinite(after).all(axis=1) & (elapsed > expected))
        if diverged.any():
            after = np.where(diverged[:, None], self.state, after)
        self.state[:] = after
        return diverged

    def _complete(self, after: Array) -> Array:
        """Take the substeps that a task keeps from ``rollout``, none by default, from the state ``(N, ..)`` it left."""
        return after

    def set_state(
        self, qpos: Array, qvel: Array, rows: NDArray[np.intp] | None = None, *, tolerance: float = 0.1
    ) -> None:
        """Put the copies ``rows`` (all by default) into states from outside; their episodes go on from there.

        Args:
            qpos: positions ``(len(rows), nq)`` in the model's order [m, rad].
            qvel: velocities ``(len(rows), nv)`` [m/s, rad/s].
            rows: indices of the copies.
            tolerance: how far beyond its limits a joint may stand [m, rad]. MuJoCo's limits give way: strong motors
                push a joint past them by some 0.5 rad.

        Raises:
            ValueError: for another shape, a number that is not finite or a joint beyond its limits. No copy is changed.
            RuntimeError: if the task is closed.
        """
        self._check_open()
        rows = np.arange(self.num_envs) if rows is None else rows
        for name, given, size in (("qpos", qpos, self.model.nq), ("qvel", qvel, self.model.nv)):
            if given.shape != (len(rows), size):
                raise ValueError(f"expected {name} of shape {(len(rows), size)}, got {given.shape}.")
            if not np.isfinite(given).all():
                raise ValueError(
                    f"{name} must be finite: row {np.argwhere(~np.isfinite(given))[0, 0]} is not."
                )
        _check_limits(self.model, qpos, tolerance)
        saved = self.state_dict()
        saved["state"][rows, 1:] = 0.0
        saved["state"][rows, 1 : 1 + self.model.nq + self.model.nv] = np.concatenate([qpos, qvel], axis=1)
        self.load_state_dict(saved)  # where a task also renews what it derives from the state

    def state_dict(self) -> dict[str, Any]:
        """Everything a later ``load_state_dict`` needs to go on bit for bit: physics, episode and generator."""
        arrays = {name: getattr(self, name).copy() for name in ("state", "steps", *self._episode_arrays)}
        return {**arrays, "rng": self.rng.bit_generator.state}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        for name in ("state", "steps", *self._episode_arrays):
            getattr(self, name)[:] = saved[name]
        self.rng.bit_generator.state = saved["rng"]

    _episode_arrays: ClassVar[tuple[str, ...]] = ()
    """Names of the subclass's own per-copy arrays, each with N rows."""

    def decorate(self, scene: mujoco.MjvScene, row: int) -> None:
        """Add what the model does not hold (goals, marks) of copy ``row`` to a rendered scene."""

    @property
    def closed(self) -> bool:
        """Whether ``close`` was called."""
        return self._rollout is None

    def close(self) -> None:
        """Release the native threads. A second call does nothing."""
        if self._rollout is not None:
            self._rollout.close()
            self._rollout = None

    def _check_open(self) -> None:
        if self.closed:
            raise RuntimeError("the environment is closed: make a new one.")


def load_model(path: Path) -> mujoco.MjModel:
    """Compile an MJCF file.

    MuJoCo's warnings, which it would also write to a file in the working folder, go to this module's logger.

    Raises:
        ValueError: if it does not compile: the file's name, and MuJoCo's message.
    """
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(LOGGER.info)
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ValueError(f"{path} does not compile: {error}") from error
    finally:
        mujoco.set_mju_user_warning(previous)


def _check_limits(model: mujoco.MjModel, qpos: Array, tolerance: float) -> None:
    limited = np.flatnonzero(model.jnt_limited)
    angle = qpos[:, model.jnt_qposadr[limited]]
    low, high = model.jnt_range[limited].T
    beyond = np.maximum(low - angle, angle - high)
    if beyond.size and beyond.max() > tolerance:
        row, joint = np.unravel_index(beyond.argmax(), beyond.shape)
        raise ValueError(
            f"joint {model.joint(limited[joint]).name!r} stands at {angle[row, joint]:.4g} in row {row}, more than "
            f"{tolerance} beyond its limits [{low[joint]:.4g}, {high[joint]:.4g}]."
        )
