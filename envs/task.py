"""N copies of one MuJoCo task in numpy: one native call advances all of them.

A task is the physics-facing half of an environment. It knows neither TorchRL nor Gymnasium; the adapters in
``mujoco_batch.py`` and ``gymnasium_env.py`` turn it into theirs.
"""

from __future__ import annotations

import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np
from mujoco import rollout
from numpy.typing import NDArray

from nht.envs.mujoco_log import warnings_logged
from nht.envs.simulation import DEFAULT_SIZE

if TYPE_CHECKING:
    from nht.envs.rendering import SceneRenderer

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Rows = NDArray[np.intp]
"""Indices of copies."""

ASSETS = Path(__file__).parent / "assets"


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


OUTCOME_FLAGS = ("terminated", "truncated", "success", "failure", "diverged")


class BatchedTask(ABC):
    """N copies of a task, each a row of one state array, stepped together by ``mujoco.rollout``.

    A subclass says how an actuation enters the simulation, where episodes start, what is observed and what counts
    as success and failure. Quantities that differ between copies (goals, flags) live in arrays of the task, not
    in the model, so that all copies share one ``MjModel``.

    A task can be copied and pickled: what comes of it goes on bit for bit, on its own.

    Args:
        model: the compiled model, shared by all copies.
        num_envs: number of copies N, at least 1.
        substeps: simulation steps in one environment step.
        max_episode_steps: environment steps after which an episode is truncated.
        num_threads: native threads that share the copies; the result does not depend on it.
        seed: seeds the generator that every random draw of the task comes from; None takes one that nobody else has.

    Raises:
        ValueError: if a count is below 1.
    """

    can_resume: ClassVar[bool] = True
    resume_obstacle: ClassVar[str] = ""
    reward_range: ClassVar[tuple[float, float]] = (-math.inf, math.inf)
    """Smallest and largest reward of a step."""
    reads_sensors: ClassVar[bool] = False
    """Whether ``sensors`` is kept, the values of the model's sensors in the state before the last substep."""

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        num_envs: int,
        substeps: int,
        max_episode_steps: int,
        num_threads: int = 1,
        seed: int | None = None,
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
        self._flags: Flags = np.zeros((num_envs, len(OUTCOME_FLAGS)), dtype=bool)  # of each copy's last step
        self._control: Array = np.zeros((num_envs, substeps, model.nu))
        self._trajectory: Array = np.zeros((num_envs, substeps, self.state.shape[1]))
        self.sensors: Array = np.zeros((num_envs, model.nsensordata if self.reads_sensors else 0))
        self._sensor_trajectory = np.zeros((num_envs, substeps, self.sensors.shape[1]))
        self._open()

    def _open(self) -> None:
        """Make what belongs to this object alone: views into its arrays, and native memory and threads."""
        model = self.model
        # mjSTATE_FULLPHYSICS is laid out as time, qpos, qvel, act, ...
        self.qpos: Array = self.state[:, 1 : 1 + model.nq]
        self.qvel: Array = self.state[:, 1 + model.nq : 1 + model.nq + model.nv]
        self._models = [model] * self.num_envs
        self._data = [mujoco.MjData(model) for _ in range(self.num_threads)]
        threads = self.num_threads if self.num_threads > 1 else 0
        self._rollout: rollout.Rollout | None = rollout.Rollout(nthread=threads)

    def __getstate__(self) -> dict[str, Any]:
        own = ("qpos", "qvel", "_models", "_data", "_rollout")
        state = {name: value for name, value in self.__dict__.items() if name not in own}
        return state | {"closed": self.closed}

    def __setstate__(self, state: dict[str, Any]) -> None:
        closed = state.pop("closed")
        self.__dict__.update(state)
        self._open()
        if closed:
            self.close()

    def seed(self, seed: int | None) -> None:
        """Start the generator of all random draws anew; None takes a seed from the operating system."""
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
    def _draw_start(self, rows: Rows) -> None:
        """Put the copies ``rows`` at the start of an episode: write ``qpos``, ``qvel`` and the task's own arrays."""

    @abstractmethod
    def observe(self) -> dict[str, Array]:
        """Observations of all copies by key, each ``(N, size)``, in arrays that later steps leave alone."""

    @abstractmethod
    def _judge(self, actuation: Array) -> tuple[Array, Flags, Flags, Flags]:
        """Reward, terminated, success and failure ``(N,)`` after ``actuation`` was carried out."""

    def _note_diverged(self, diverged: Flags) -> None:
        """Take note of the copies ``(N,)`` that diverged, before they are judged; by default nothing."""

    def _apply(self, actuation: Array) -> None:
        """Hand the actuation ``(N, n)`` to the simulation: by default as the control of all substeps."""
        self._control[:] = actuation[:, None, :]

    # What every task shares.

    @warnings_logged()
    def reset(self, rows: Rows | None = None) -> None:
        """Start a new episode in the copies ``rows`` (all by default) and leave the others alone."""
        self._check_open()
        rows = np.arange(self.num_envs) if rows is None else rows
        if not len(rows):
            return
        self.state[rows] = 0.0
        # Not at 0, where MuJoCo puts the clock after bad numbers: one substep later both would look alike.
        self.state[rows, 0] = self.model.opt.timestep
        self.steps[rows] = 0
        self._flags[rows] = False
        self._draw_start(rows)

    @warnings_logged()
    def step(self, actuation: NDArray[np.floating[Any]], rows: Rows | None = None) -> Outcome:
        """Advance the copies ``rows`` (all by default) by one environment step, and leave the others alone.

        A copy that stands still keeps its state, its clock and the task's own arrays, and costs no simulation. It gets
        the reward 0 and the flags of its last step.

        Args:
            actuation: ``(N, n)``, clipped to its bounds. A row that is not finite ends that copy's episode as a
                failure and leaves the other copies alone. Rows of copies that stand still are not read.
            rows: indices of the copies to step.

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
        if rows is not None:
            return self._step_some(applied, invalid, rows)
        diverged = invalid | self._advance(applied)
        self.steps += 1
        return self._conclude(applied, diverged)

    def _step_some(self, applied: Array, invalid: Flags, rows: Rows) -> Outcome:
        """Step the copies ``rows``; what was written to the others on the way is taken back."""
        still = np.ones(self.num_envs, dtype=bool)
        still[rows] = False
        if still.all():
            return self._still_outcome()
        state, flags = self.state[still], self._flags[still]
        kept = {name: getattr(self, name)[still] for name in self._episode_arrays}
        diverged = (invalid & ~still) | self._advance(applied, np.flatnonzero(~still))
        self.state[still] = state
        self.steps += ~still
        outcome = self._conclude(applied, diverged)
        for name, values in kept.items():
            getattr(self, name)[still] = values
        self._flags[still] = flags
        outcome.reward[still] = 0.0
        for name, values in zip(OUTCOME_FLAGS, flags.T, strict=True):
            getattr(outcome, name)[still] = values
        return outcome

    def _still_outcome(self) -> Outcome:
        return Outcome(np.zeros(self.num_envs), *self._flags.T.copy())

    def _conclude(self, applied: Array, diverged: Flags) -> Outcome:
        """What the step brought that the copies have made."""
        self._note_diverged(diverged)
        reward, terminated, success, failure = self._judge(applied)
        flags = (
            terminated | diverged,
            self.steps >= self.max_episode_steps,
            success & ~diverged,
            failure | diverged,
            diverged,
        )
        for column, values in enumerate(flags):
            self._flags[:, column] = values
        return Outcome(reward, *flags)

    def _advance(self, applied: Array, rows: Rows | None = None) -> Flags:
        """Simulate all substeps of the copies ``rows``, all by default.

        Returns:
            ``(N,)`` which copies diverged: they keep their last good state.
        """
        self._apply(applied)
        assert self._rollout is not None
        some = slice(None) if rows is None else rows
        before, control = self.state[some], self._control[some]
        count = len(before)
        trajectory, sensed = self._trajectory[:count], self._sensor_trajectory[:count]
        self._rollout.rollout(
            self._models[:count],
            self._data,
            before,
            control,
            control_spec=mujoco.mjtState.mjSTATE_CTRL.value,
            skip_checks=True,
            nstep=control.shape[1],
            state=trajectory,
            sensordata=sensed if self.reads_sensors else None,
        )
        after = self._complete(trajectory, control, some)
        # MuJoCo answers bad numbers by a reset of the simulation and then stands still: its clock falls behind.
        elapsed = after[:, 0] - before[:, 0]
        expected = (1 - 0.5 / self.substeps) * self.time_per_step
        diverged = ~(np.isfinite(after).all(axis=1) & (elapsed > expected))
        if diverged.any():
            after = np.where(diverged[:, None], before, after)
        self.state[some] = after
        if self.reads_sensors:
            self.sensors[some] = np.where(diverged[:, None], self.sensors[some], sensed[:, -1])
        if rows is None:
            return diverged
        everywhere = np.zeros(self.num_envs, dtype=bool)
        everywhere[rows] = diverged
        return everywhere

    def _complete(self, trajectory: Array, control: Array, rows: Rows | slice) -> Array:
        """The state ``(M, ..)`` after the step: the last one of ``rollout``, unless a task takes substeps itself.

        Args:
            trajectory: the states ``(M, substeps, ..)`` that ``rollout`` went through.
            control: the controls ``(M, substeps, nu)``.
            rows: which copies the M are.
        """
        return trajectory[:, -1]

    def set_state(
        self, qpos: Array, qvel: Array, rows: Rows | None = None, *, tolerance: float = 0.1
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
        return {**arrays, "flags": self._flags.copy(), "rng": self.rng.bit_generator.state}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        for name in ("state", "steps", *self._episode_arrays):
            getattr(self, name)[:] = saved[name]
        self._flags[:] = saved.get("flags", False)  # older files lack them
        self.rng.bit_generator.state = saved["rng"]

    _episode_arrays: ClassVar[tuple[str, ...]] = ()
    """Names of the subclass's own per-copy arrays, each with N rows: saved, and kept where a copy stands still."""

    def decorate(self, scene: mujoco.MjvScene, row: int) -> None:
        """Add what the model does not hold (goals, marks) of copy ``row`` to a rendered scene."""

    def renderer(
        self, width: int = DEFAULT_SIZE[0], height: int = DEFAULT_SIZE[1], camera: str | int | None = None
    ) -> SceneRenderer:
        """Takes pictures of the copies, of this size [pixel], through this camera of the model (the first one).

        Raises:
            RuntimeError: if this machine has no OpenGL for offscreen rendering; the message says what to install.
            ValueError: if the model has no such camera.
        """
        from nht.envs.rendering import SceneRenderer

        return SceneRenderer(self, width, height, 0 if camera is None else camera)

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

    Raises:
        ValueError: if it does not compile: the file's name, and MuJoCo's message.
    """
    return compile_model(str(path), lambda: mujoco.MjModel.from_xml_path(str(path)))


def compile_model(name: str, build: Callable[[], mujoco.MjModel]) -> mujoco.MjModel:
    """What ``build`` compiles.

    MuJoCo's warnings go to the log, as mere information: the model is no work of whoever asks for it.

    Raises:
        ValueError: if it does not compile: the name, and MuJoCo's message.
    """
    try:
        with warnings_logged(logging.INFO, others=True):
            return build()
    except ValueError as error:
        raise ValueError(f"{name} does not compile: {error}") from error


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
