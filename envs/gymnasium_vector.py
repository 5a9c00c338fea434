"""Gymnasium's side of a batched task: N copies as a native ``gymnasium.vector.VectorEnv``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from nht.envs.gymnasium_env import FLAGS, check_render_mode, metadata_of, spaces_of
from nht.envs.registry import make_task
from nht.envs.rendering import SceneRenderer
from nht.envs.task import Array, Flags

Observations = NDArray[np.float32]


class GymnasiumVectorEnv(VectorEnv[Observations, NDArray[np.float32], NDArray[Any]]):
    """N copies of a task that one native call steps together, with what ``SyncVectorEnv`` returns.

    One generator draws for all copies, so that one seed repeats them. ``infos`` holds arrays with N rows: the flags
    ``success``, ``failure`` and ``diverged`` and the task's raw keys; a mask ``_key`` beside each names the rows that
    are of this call. What is returned belongs to the caller.

    A copy whose episode has ended is started anew as ``autoreset_mode`` says:

    - ``NEXT_STEP``: the next step ignores its action, resets it and gives the reward 0.
    - ``SAME_STEP``: at once. ``infos["final_obs"]`` and ``["final_info"]`` hold the last step of the episode.
    - ``DISABLED``: by ``reset(options={"reset_mask": mask})``, which leaves the other copies alone. The other modes
      take it, too.

    Args:
        task: a key of ``nht.envs.TASKS``.
        num_envs: number of copies N.
        render_mode: ``"rgb_array"``, or None.
        autoreset_mode: an ``AutoresetMode`` or its value, e.g. ``"SameStep"``.
        options: further arguments of the task, e.g. ``num_threads=2``.

    Raises:
        ValueError: for an unknown task, option, render mode or autoreset mode.
    """

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **options: Any,
    ) -> None:
        check_render_mode(render_mode)
        self.autoreset_mode = _as_mode(autoreset_mode)
        options.setdefault("seed", int(self.np_random.integers(2**31)))
        if options.get("max_episode_steps", 0) is None:  # the task's own
            del options["max_episode_steps"]
        self.task = make_task(task, num_envs=num_envs, **options)
        self.num_envs = num_envs
        self.metadata = metadata_of(self.task) | {"autoreset_mode": self.autoreset_mode}
        self.render_mode = render_mode
        self.single_observation_space, self.single_action_space = spaces_of(self.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._ended: Flags | None = None  # copies that wait for a reset; None before the first one
        self._renderer: SceneRenderer | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start episodes; a seed makes them and those after them repeatable.

        Args:
            seed: of the generator that all copies share.
            options: ``"reset_mask"`` ``(N,)`` bool names the copies to reset; all by default.

        Raises:
            TypeError: if the seed is no number, or the mask no array of bool.
            ValueError: if the mask has another shape, or names no copy.
        """
        if seed is not None and not isinstance(seed, int | np.integer):
            raise TypeError(f"one seed serves all {self.num_envs} copies: it must be an int, got {seed!r}.")
        everyone = np.ones(self.num_envs, dtype=bool)
        mask = (options or {}).get("reset_mask", everyone)
        self._check_mask(mask)
        super().reset(seed=None if seed is None else int(seed))
        if seed is not None:
            self.task.seed(int(seed))
        self.task.reset(np.flatnonzero(mask))
        self._ended = ~mask & (everyone if self._ended is None else self._ended)
        observations, raw = self._observe()
        off = {name: np.zeros(self.num_envs, dtype=bool) for name in FLAGS}
        return observations, _with_masks(raw | off, mask)

    def step(self, actions: NDArray[np.float32]) -> tuple[Observations, Array, Flags, Flags, dict[str, Any]]:
        """Advance all copies by one environment step with the actuations ``actions`` ``(N, n)``.

        Returns:
            Observations ``(N, size)``, rewards, terminations and truncations ``(N,)``, and infos.

        Raises:
            ResetNeeded: before the first reset; if ``autoreset_mode`` is ``DISABLED``, also for copies that ended.
            ValueError: if ``actions`` has another shape.
        """
        resetting = self._waiting()
        outcome = self.task.step(np.asarray(actions, dtype=np.float64))
        if resetting.any():  # these were stepped along, from where they ended
            self.task.reset(np.flatnonzero(resetting))
        rewards = np.where(resetting, 0.0, outcome.reward)
        terminations, truncations = outcome.terminated & ~resetting, outcome.truncated & ~resetting
        flags = {name: getattr(outcome, name) & ~resetting for name in FLAGS}
        self._ended = terminations | truncations
        final = {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and self._ended.any():
            final = self._final(flags)
            self.task.reset(np.flatnonzero(self._ended))
            flags = {name: values & ~self._ended for name, values in flags.items()}
            self._ended = np.zeros_like(resetting)
        observations, raw = self._observe()
        infos = _with_masks(raw | flags, np.ones_like(resetting)) | final
        return observations, rewards, terminations, truncations, infos

    def _waiting(self) -> Flags:
        """Which copies this step resets instead of stepping, ``(N,)``."""
        if self._ended is None:
            raise ResetNeeded("call reset before the first step.")
        if self.autoreset_mode is AutoresetMode.DISABLED and self._ended.any():
            raise ResetNeeded(
                f"the episodes of the copies {np.flatnonzero(self._ended).tolist()} have ended: "
                'reset(options={"reset_mask": mask}) starts new ones.'
            )
        return self._ended

    def _final(self, flags: Mapping[str, Flags]) -> dict[str, Any]:
        """Gymnasium's entries on the last step of the episodes that have ended."""
        assert self._ended is not None
        observations, raw = self._observe()
        last = np.full(self.num_envs, None, dtype=object)
        for row in np.flatnonzero(self._ended):
            last[row] = observations[row]
        info = _with_masks({**raw, **flags}, self._ended)
        return _with_masks({"final_obs": last, "final_info": info}, self._ended)

    def _observe(self) -> tuple[Observations, dict[str, Any]]:
        values = {key: value.astype(np.float32) for key, value in self.task.observe().items()}
        return values.pop("observation"), values

    def _check_mask(self, mask: Any) -> None:
        if not isinstance(mask, np.ndarray) or mask.dtype != bool:
            kind = mask.dtype if isinstance(mask, np.ndarray) else type(mask).__name__
            raise TypeError(f"reset_mask must be a numpy array of bool, got {kind}.")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(
                f"reset_mask must have the shape {(self.num_envs,)} and name a copy, got {mask.tolist()}."
            )

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A picture ``(height, width, 3)`` of every copy in ``rgb_array`` mode."""
        if self.render_mode is None:
            return None
        self._renderer = self._renderer or SceneRenderer(self.task)
        return tuple(self._renderer.frame(row) for row in range(self.num_envs))

    def close_extras(self, **_: Any) -> None:
        """Release the renderer and the native threads; ``close`` calls this once."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
        self.task.close()


def _with_masks(values: Mapping[str, Any], rows: Flags) -> dict[str, Any]:
    """The entries and, as Gymnasium has it, beside each of them a mask of the rows that have it."""
    return dict(values) | {f"_{key}": rows.copy() for key in values}


def _as_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError as error:
        allowed = [mode.value for mode in AutoresetMode]
        raise ValueError(f"autoreset_mode must be one of {allowed}, got {mode!r}.") from error
