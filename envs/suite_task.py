"""The base class of tasks of dm_control's suite on the batched engine."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any

import mujoco
import numpy as np

from nht.envs.arrays import Array, Seed
from nht.envs.models import compile_model
from nht.envs.task import BatchedTask


class SuiteTask(BatchedTask):
    """A task of the suite: its model, its clock and rewards in [0, 1]; nothing counts as success or failure.

    From equal states one step equals the suite's to 1e-9 in float64, if its solver starts without a guess of the
    accelerations, as ours does. The suite's own solver starts from the last step's accelerations, which changes a step
    by the solver's tolerance. Whole episodes drift apart, since contacts are chaotic.

    Args:
        name: domain and task, for messages.
        xml: the model.
        assets: files that it includes, by name.
        control_timestep: duration of an environment step [s].
        num_envs: number of copies N.
        num_threads: native threads that share the copies.
        seed: seed of the starts.
        max_episode_steps: environment steps in an episode.

    Raises:
        ValueError: if a count is below 1.
    """

    reward_range = (0.0, 1.0)

    def __init__(
        self,
        name: str,
        xml: bytes | str,
        assets: dict[str, Any],
        *,
        control_timestep: float,
        num_envs: int,
        num_threads: int,
        seed: Seed,
        max_episode_steps: int,
    ) -> None:
        text = xml if isinstance(xml, str) else xml.decode()
        model = compile_model(f"dm_control's {name}", lambda: mujoco.MjModel.from_xml_string(text, assets))
        super().__init__(
            model,
            num_envs=num_envs,
            substeps=round(control_timestep / model.opt.timestep),
            max_episode_steps=max_episode_steps,
            num_threads=num_threads,
            seed=seed,
        )
        low, high = model.actuator_ctrlrange.T.copy()
        self._bounds = low, high

    @property
    def actuation_bounds(self) -> tuple[Array, Array]:
        """The motors' control ranges."""
        return self._bounds

    @abstractmethod
    def _entries(self) -> dict[str, Array]:
        """The suite's observations, in its order, each ``(N, size)`` in an array of its own."""

    def observe(self) -> dict[str, Array]:
        """The suite's observations, and all of them side by side."""
        entries = self._entries()
        return {"observation": np.concatenate(list(entries.values()), axis=1), **entries}
