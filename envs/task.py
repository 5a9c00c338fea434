"""N copies of one MuJoCo task in numpy: one native call advances all of them.

A task is the physics-facing half of an environment. It knows neither TorchRL nor Gymnasium; the adapters in
``mujoco_batch.py`` and ``gymnasium_env.py`` turn it into theirs.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import mujoco
import numpy as np
from numpy.typing import NDArray

from nht.envs.arrays import Array, Flags, Rows, Seed
from nht.envs.models import ASSETS, check_state, compile_model, load_model
from nht.envs.mujoco_log import warnings_logged
from nht.envs.outcome import OUTCOME_FLAGS, Outcome
from nht.envs.physics import BatchedPhysics
from nht.envs.simulation import DEFAULT_SIZE

if TYPE_CHECKING:
    from nht.envs.rendering import SceneRenderer

# What a task of one's own is written with, beside BatchedTask.
__all__ = [
    "ASSETS",
    "Array",
    "BatchedTask",
    "Flags",
    "Outcome",
    "Rows",
    "Seed",
    "compile_model",
    "load_model",
]


class BatchedTask(BatchedPhysics, ABC):
    """N copies of a task, each a row of one state array, stepped together by ``mujoco.rollout``.

    A subclass says how an actuation enters the simulation, where episodes start, what is observed and what counts
    as success and failure. Quantities that differ between copies (goals, flags) live in arrays of the task, not
    in the model, so that all copies share one ``MjModel``.

    A task can be copied and pickled; a copy is independent and goes on bit for bit like the original.

    Args:
        model: the compiled model, shared by all copies.
        num_envs: number of copies N, at least 1.
        substeps: simulation steps in one environment step.
        max_episode_steps: environment steps after which an episode is truncated.
        num_threads: native threads that share the copies; the result does not depend on it.
        seed: of the generator that every random draw of the task comes from; None takes one from the operating system.

    Raises:
        ValueError: if a count is below 1.
    """

    can_resume: ClassVar[bool] = True
    resume_obstacle: ClassVar[str] = ""
    reward_range: ClassVar[tuple[float, float]] = (-math.inf, math.inf)
    """Smallest and largest reward of a step."""

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        num_envs: int,
        substeps: int,
        max_episode_steps: int,
        num_threads: int = 1,
        seed: Seed = None,
    ) -> None:
        counts = {"num_envs": num_envs, "substeps": substeps, "num_threads": num_threads}
        for name, count in (counts | {"max_episode_steps": max_episode_steps}).items():
            if count < 1:
                raise ValueError(f"{name} must be at least 1, got {count}.")
        super().__init__(model, num_envs, substeps, num_threads)
        self.max_episode_steps = max_episode_steps
        self.seed(seed)
        self.steps: NDArray[np.int64] = np.zeros(num_envs, dtype=np.int64)
        self._flags: Flags = np.zeros((num_envs, len(OUTCOME_FLAGS)), dtype=bool)  # of each copy's last step

    def seed(self, seed: Seed) -> None:
        """Start the generator of all random draws anew; None takes a seed from the operating system.

        Several seeds start a generator each, for equal numbers of copies in order; what one generator draws does not
        depend on the others.

        Raises:
            ValueError: if the copies cannot be divided equally.
        """
        seeds = seed if isinstance(seed, Sequence) else [seed]
        if not seeds or self.num_envs % len(seeds):
            raise ValueError(f"{len(seeds)} seeds cannot share num_envs={self.num_envs} copies alike.")
        self._generators = [np.random.default_rng(each) for each in seeds]
        self.rng = self._generators[0]

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
        if len(self._generators) == 1:
            self._draw_start(rows)
            return
        owners = rows // (self.num_envs // len(self._generators))
        for owner in np.unique(owners):
            self.rng = self._generators[owner]
            self._draw_start(rows[owners == owner])

    @warnings_logged()
    def step(self, actuation: NDArray[np.floating[Any]], rows: Rows | None = None) -> Outcome:
        """Advance the copies ``rows`` (all by default) by one environment step, and leave the others alone.

        A copy that is not stepped keeps its state, its clock and the task's own arrays, and costs no simulation. It
        gets the reward 0 and the flags of its last step.

        Args:
            actuation: ``(N, n)``, clipped to its bounds. A row that is not finite ends that copy's episode as a failure
                and leaves the other copies alone. Rows of copies that are not stepped are not read.
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
        """Step the copies ``rows``, and restore what was written to the others on the way."""
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
        """The outcome of the step that the copies have made."""
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

    def set_state(
        self, qpos: Array, qvel: Array, rows: Rows | None = None, *, tolerance: float = 0.1
    ) -> None:
        """Set the states of the copies ``rows`` (all by default); their episodes go on from there.

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
        check_state(self.model, qpos, qvel, len(rows), tolerance)
        saved = self.state_dict()
        saved["state"][rows, 1:] = 0.0
        saved["state"][rows, 1 : 1 + self.model.nq + self.model.nv] = np.concatenate([qpos, qvel], axis=1)
        self.load_state_dict(saved)  # where a task also renews what it derives from the state

    def state_dict(self) -> dict[str, Any]:
        """Everything a later ``load_state_dict`` needs to go on bit for bit: physics, episode and generator."""
        arrays = {name: getattr(self, name).copy() for name in ("state", "steps", *self._episode_arrays)}
        states = [generator.bit_generator.state for generator in self._generators]
        random = self.rng.bit_generator.state if len(states) == 1 else states
        return {**arrays, "flags": self._flags.copy(), "rng": random}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        for name in ("state", "steps", *self._episode_arrays):
            getattr(self, name)[:] = saved[name]
        self._flags[:] = saved.get("flags", False)  # older files lack them
        if len(self._generators) == 1:
            self.rng.bit_generator.state = saved["rng"]
            return
        for generator, state in zip(self._generators, saved["rng"], strict=True):
            generator.bit_generator.state = state

    _episode_arrays: ClassVar[tuple[str, ...]] = ()
    """Names of the subclass's own arrays, each with N rows: saved, and kept for copies that are not stepped."""

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
