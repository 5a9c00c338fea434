"""Gymnasium's side of a batched task: one copy as a ``gymnasium.Env``."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from numpy.typing import NDArray

from nht.envs.registry import TASKS, make_task
from nht.envs.rendering import SceneRenderer

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"]}


class GymnasiumEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One copy of a task. ``info`` holds the flags ``success``, ``failure`` and ``diverged``, and the raw keys.

    Args:
        task: a key of ``nht.envs.TASKS``.
        render_mode: ``"rgb_array"``, or None.
        options: further arguments of the task.

    Raises:
        ValueError: for an unknown task, option or render mode.
    """

    metadata = METADATA
    spec: EnvSpec | None

    def __init__(self, task: str, render_mode: str | None = None, **options: Any) -> None:
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(
                f"render_mode must be None or one of {self.metadata['render_modes']}, got {render_mode!r}."
            )
        # Gymnasium's rule: without a seed, every environment draws its own.
        options.setdefault("seed", int(self.np_random.integers(2**31)))
        self.task = make_task(task, num_envs=1, **options)
        self.metadata = METADATA | {"render_fps": round(1 / self.task.time_per_step)}
        self.render_mode = render_mode
        low, high = (bound.astype(np.float32) for bound in self.task.actuation_bounds)
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        size = self.task.observation_sizes["observation"]
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (size,), dtype=np.float32)
        self._renderer: SceneRenderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; a seed makes it and those after it repeatable."""
        super().reset(seed=seed)
        if seed is not None:
            self.task.seed(seed)
        self.task.reset()
        observation, raw = self._observe()
        return observation, raw | {"success": False, "failure": False, "diverged": False}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by one environment step with the actuation ``action`` ``(n,)``."""
        outcome = self.task.step(np.asarray(action, dtype=np.float64)[None])
        observation, raw = self._observe()
        flags = {name: bool(getattr(outcome, name)[0]) for name in ("success", "failure", "diverged")}
        reward = float(outcome.reward[0])
        return observation, reward, bool(outcome.terminated[0]), bool(outcome.truncated[0]), raw | flags

    def _observe(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        values = {key: value[0].astype(np.float32) for key, value in self.task.observe().items()}
        return values.pop("observation"), values

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as ``(height, width, 3)`` in ``rgb_array`` mode."""
        if self.render_mode is None:
            return None
        self._renderer = self._renderer or SceneRenderer(self.task)
        return self._renderer.frame(row=0)

    def close(self) -> None:
        """Release the renderer and the native threads. A second call does nothing."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.task.close()


GYMNASIUM_IDS = {
    "ant": "nht/Ant-v0",
    "half_cheetah": "nht/HalfCheetah-v0",
    "hopper": "nht/Hopper-v0",
    "walker2d": "nht/Walker2d-v0",
    "wam_wipe": "nht/WAMWipe-v0",
}
"""Gymnasium's id of every task."""


def register() -> None:
    """Make every task known to ``gymnasium.make``. The tasks truncate by themselves."""
    for task in TASKS:
        if GYMNASIUM_IDS[task] not in gymnasium.registry:
            gymnasium.register(
                GYMNASIUM_IDS[task],
                entry_point="nht.envs.gymnasium_env:GymnasiumEnv",
                kwargs={"task": task},
                order_enforce=True,
            )
