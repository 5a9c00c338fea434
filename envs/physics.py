"""N copies of one MuJoCo model in numpy: one native call advances all of them."""

from __future__ import annotations

from typing import Any, ClassVar

import mujoco
import numpy as np
from mujoco import rollout

from nht.envs.arrays import Array, Flags, Rows


class BatchedPhysics:
    """N copies of a model, each a row of one state array, advanced together by ``mujoco.rollout``.

    It can be copied and pickled; a copy is independent and goes on bit for bit like the original.

    Args:
        model: the compiled model, shared by all copies.
        num_envs: number of copies N.
        substeps: simulation steps in one environment step.
        num_threads: native threads that share the copies; the result does not depend on it.
    """

    reads_sensors: ClassVar[bool] = False
    """Whether ``sensors`` is kept, the values of the model's sensors in the state before the last substep."""

    def __init__(self, model: mujoco.MjModel, num_envs: int, substeps: int, num_threads: int) -> None:
        self.model = model
        self.num_envs = num_envs
        self.substeps = substeps
        self.num_threads = num_threads
        self.time_per_step: float = substeps * model.opt.timestep
        """Simulated time of one environment step [s]."""
        full_physics = mujoco.mjtState.mjSTATE_FULLPHYSICS
        self.state: Array = np.zeros((num_envs, mujoco.mj_stateSize(model, full_physics)))
        self.sensors: Array = np.zeros((num_envs, model.nsensordata if self.reads_sensors else 0))
        self._control: Array = np.zeros((num_envs, substeps, model.nu))
        self._trajectory: Array = np.zeros((num_envs, substeps, self.state.shape[1]))
        self._sensor_trajectory = np.zeros((num_envs, substeps, self.sensors.shape[1]))
        self._open()

    def _open(self) -> None:
        """Create what copies do not share: views into the arrays, and native memory and threads."""
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

    def _apply(self, actuation: Array) -> None:
        """Hand the actuation ``(N, n)`` to the simulation: by default as the control of all substeps."""
        self._control[:] = actuation[:, None, :]

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
