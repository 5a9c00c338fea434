"""Gymnasium's side of a batched task: N copies as a native ``gymnasium.vector.VectorEnv``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from nht.envs.arrays import Array, Flags
from nht.envs.gymnasium_env import check_render_mode, metadata_of, spaces_of
from nht.envs.outcome import INFO_FLAGS
from nht.envs.pictures import Pictures
from nht.envs.registry import make_task
from nht.envs.simulation import DEFAULT_SIZE

Observations = NDArray[np.float32]


class GymnasiumVectorEnv(VectorEnv[Observations, NDArray[np.float32], NDArray[Any]]):
    """N copies of a task that one native call steps together, with what ``SyncVectorEnv`` returns.

    One generator draws for all copies, so that one seed repeats them, or a list of one for each. ``infos`` holds
    arrays with N rows: the flags ``success``, ``failure`` and ``diverged`` and the task's raw keys; a mask ``_key``
    beside each names the rows that are of this call. What is returned belongs to the caller.

    A copy whose episode has ended is reset as ``autoreset_mode`` says:

    - ``NEXT_STEP``: the next step ignores its action, resets it and gives the reward 0.
    - ``SAME_STEP``: at once. ``infos["final_obs"]`` and ``["final_info"]`` hold the last step of the episode.
    - ``DISABLED``: by ``reset(options={"reset_mask": mask})``, which leaves the other copies alone. The other modes
      take it, too.

    It can be copied and pickled; a copy is independent and goes on bit for bit like the original.

    Args:
        task: a key of ``nht.envs.TASKS``.
        num_envs: number of copies N.
        render_mode: ``"rgb_array"``, or None.
        autoreset_mode: an ``AutoresetMode``, or its name or value: ``"SAME_STEP"``, ``"same_step"``, ``"SameStep"``.
        width: of a picture [pixel].
        height: of a picture [pixel].
        camera: name or number of a camera of the model; None is the first one.
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
        width: int = DEFAULT_SIZE[0],
        height: int = DEFAULT_SIZE[1],
        camera: str | int | None = None,
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
        self._view = (width, height, camera)
        self._pictures = Pictures(self.task)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observations, dict[str, Any]]:
        """Start episodes; a seed makes them and those after them repeatable.

        Args:
            seed: of the generator that all copies share; or N seeds, one for each copy, which starts where a single
                environment with this seed does. A copy whose seed is None starts anywhere. Later episodes come from
                the shared generator, which then begins with all these seeds together; if one is None, it goes on.
            options: ``"reset_mask"`` ``(N,)`` bool names the copies to reset; all by default.

        Raises:
            TypeError: if a seed is no integer, or the mask no array of bool.
            ValueError: if there are not N seeds, or the mask has another shape or names no copy.
        """
        seeds = self._checked_seeds(seed)
        everyone = np.ones(self.num_envs, dtype=bool)
        mask = (options or {}).get("reset_mask", everyone)
        self._check_mask(mask)
        if isinstance(seeds, list):
            self._start_from(seeds, mask)
        else:
            super().reset(seed=seeds)
            if seeds is not None:
                self.task.seed(seeds)
            self.task.reset(np.flatnonzero(mask))
        self._ended = ~mask & (everyone if self._ended is None else self._ended)
        observations, raw = self._observe()
        off = {name: np.zeros(self.num_envs, dtype=bool) for name in INFO_FLAGS}
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
        some = resetting.any()
        outcome = self.task.step(
            np.asarray(actions, dtype=np.float64), np.flatnonzero(~resetting) if some else None
        )
        if some:
            self.task.reset(np.flatnonzero(resetting))
        rewards = np.where(resetting, 0.0, outcome.reward)
        terminations, truncations = outcome.terminated & ~resetting, outcome.truncated & ~resetting
        flags = {name: getattr(outcome, name) & ~resetting for name in INFO_FLAGS}
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

    def _checked_seeds(self, seed: Any) -> int | list[int | None] | None:
        if seed is None or isinstance(seed, int | np.integer):
            return None if seed is None else int(seed)
        given = seed.tolist() if isinstance(seed, np.ndarray) else seed
        if not isinstance(given, list | tuple) or not all(
            each is None or isinstance(each, int | np.integer) for each in given
        ):
            raise TypeError(f"seed must be an int, or {self.num_envs} of them, got {seed!r}.")
        if len(given) != self.num_envs:
            raise ValueError(
                f"seed must be one int, or one for each of the {self.num_envs} copies, got {len(given)}."
            )
        return [None if each is None else int(each) for each in given]

    def _start_from(self, seeds: list[int | None], mask: Flags) -> None:
        """Start the copies of the mask, each from its own seed."""
        shared = self.task.rng
        for row in np.flatnonzero(mask):
            if seeds[row] is None:
                self.task.rng = shared
            else:
                self.task.seed(seeds[row])
            self.task.reset(np.array([row]))
        given = [each for each in seeds if each is not None]
        self.task.rng = shared if len(given) < len(seeds) else np.random.default_rng(given)

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
        return None if self.render_mode is None else tuple(self._pictures.take(*self._view))

    def close_extras(self, **_: Any) -> None:
        """Release the renderer and the native threads; ``close`` calls this once."""
        self._pictures.close()
        self.task.close()


def _with_masks(values: Mapping[str, Any], rows: Flags) -> dict[str, Any]:
    """The entries and, as in Gymnasium, beside each a mask of the rows that have it."""
    return dict(values) | {f"_{key}": rows.copy() for key in values}


def _as_mode(mode: AutoresetMode | str) -> AutoresetMode:
    if isinstance(mode, AutoresetMode):
        return mode
    known = {each.value.lower(): each for each in AutoresetMode}
    plain = str(mode).replace("_", "").replace("-", "").lower()
    if plain not in known:
        allowed = [each.value for each in AutoresetMode]
        raise ValueError(f"autoreset_mode must be one of {allowed}, or its name, got {mode!r}.")
    return known[plain]
