"""Gymnasium's side of a batched task: one copy as a ``gymnasium.Env``."""

from __future__ import annotations

import sys
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from gymnasium.spaces import Box
from numpy.typing import NDArray

from nht.envs.outcome import INFO_FLAGS
from nht.envs.pictures import Pictures
from nht.envs.registry import make_task
from nht.envs.simulation import DEFAULT_SIZE
from nht.envs.task import BatchedTask

METADATA: dict[str, Any] = {"render_modes": ["rgb_array"]}


class GymnasiumEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """One copy of a task. ``info`` holds the flags ``success``, ``failure`` and ``diverged``, and the raw keys.

    It truncates only if ``options`` has ``max_episode_steps``: ``gymnasium.make`` adds the task's time limit, or its
    own ``max_episode_steps`` in its place. None is the task's own limit.

    It can be copied and pickled; a copy is independent and goes on bit for bit like the original.

    Args:
        task: a key of ``nht.envs.TASKS``.
        render_mode: ``"rgb_array"``, or None.
        width: of a picture [pixel].
        height: of a picture [pixel].
        camera: name or number of a camera of the model; None is the first one.
        options: further arguments of the task.

    Raises:
        ValueError: for an unknown task, option or render mode.
    """

    metadata = METADATA
    spec: EnvSpec | None

    def __init__(
        self,
        task: str,
        render_mode: str | None = None,
        width: int = DEFAULT_SIZE[0],
        height: int = DEFAULT_SIZE[1],
        camera: str | int | None = None,
        **options: Any,
    ) -> None:
        check_render_mode(render_mode)
        # Gymnasium's rule: without a seed, every environment draws its own.
        options.setdefault("seed", int(self.np_random.integers(2**31)))
        options = {"max_episode_steps": sys.maxsize} | options
        if options["max_episode_steps"] is None:
            del options["max_episode_steps"]
        self.task = make_task(task, num_envs=1, **options)
        self.metadata = metadata_of(self.task)
        self.render_mode = render_mode
        self.observation_space, self.action_space = spaces_of(self.task)
        self._view = (width, height, camera)
        self._pictures = Pictures(self.task)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start an episode; a seed makes it and those after it repeatable."""
        super().reset(seed=seed)
        if seed is not None:
            self.task.seed(seed)
        self.task.reset()
        observation, raw = self._observe()
        return observation, raw | dict.fromkeys(INFO_FLAGS, False)

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Advance by one environment step with the actuation ``action`` ``(n,)``."""
        outcome = self.task.step(np.asarray(action, dtype=np.float64)[None])
        observation, raw = self._observe()
        flags = {name: bool(getattr(outcome, name)[0]) for name in INFO_FLAGS}
        reward = float(outcome.reward[0])
        return observation, reward, bool(outcome.terminated[0]), bool(outcome.truncated[0]), raw | flags

    def _observe(self) -> tuple[NDArray[np.float32], dict[str, Any]]:
        values = {key: value[0].astype(np.float32) for key, value in self.task.observe().items()}
        return values.pop("observation"), values

    def render(self) -> NDArray[np.uint8] | None:
        """The scene as ``(height, width, 3)`` in ``rgb_array`` mode."""
        return None if self.render_mode is None else self._pictures.take(*self._view)[0]

    def close(self) -> None:
        """Release the renderer and the native threads. A second call does nothing."""
        self._pictures.close()
        self.task.close()


def check_render_mode(render_mode: str | None) -> None:
    """Raise ValueError for a render mode that tasks do not have."""
    if render_mode not in (None, *METADATA["render_modes"]):
        raise ValueError(
            f"render_mode must be None or one of {METADATA['render_modes']}, got {render_mode!r}."
        )


def metadata_of(task: BatchedTask) -> dict[str, Any]:
    """Gymnasium's metadata: videos run at real time."""
    return METADATA | {"render_fps": round(1 / task.time_per_step)}


def spaces_of(task: BatchedTask) -> tuple[Box[np.float32], Box[np.float32]]:
    """Observation and action space of one copy."""
    low, high = (bound.astype(np.float32) for bound in task.actuation_bounds)
    size = task.observation_sizes["observation"]
    return Box(-np.inf, np.inf, (size,), dtype=np.float32), Box(low, high, dtype=np.float32)
