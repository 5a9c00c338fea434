"""Any task of dm_control's suite, through TorchRL's ``DMControlEnv``."""

from __future__ import annotations

from functools import partial
from typing import Any

import torch
from torchrl.data import Bounded
from torchrl.envs import DMControlEnv, EnvBase

from nht.envs.foreign import ForeignEnv, MujocoCopy
from nht.envs.task import Array


def make_dm_control(
    name: str, num_envs: int = 1, seed: int = 0, device: torch.device | str = "cpu", **options: Any
) -> ForeignEnv:
    """Copies of a task of dm_control's suite.

    Args:
        name: domain and task, ``"cheetah-run"``.
        num_envs: number of copies.
        seed: seed of every random draw of the task.
        device: where the tensors go.
        options: arguments of the task itself, e.g. ``time_limit=20`` [s].

    Raises:
        ImportError: if dm_control is not installed.
        ValueError: for an unknown domain or task; the message lists those that exist.
    """
    domain, task = _domain_and_task(name)
    return ForeignEnv(partial(_suite_env, domain, task, options), SuiteCopy, num_envs, seed, device)


def suite_module(domain: str) -> Any:
    """The module of dm_control's suite that a domain lives in.

    Raises:
        ImportError: if dm_control is not installed; the message says how to.
    """
    try:
        from dm_control import suite
    except ImportError as error:
        raise ImportError("tasks of dm_control need its package: pip install 'nht[dm_control]'.") from error
    return getattr(suite, domain)


def tolerance(values: Array, bounds: tuple[float, float], margin: float, **options: Any) -> Array:
    """The suite's building block of rewards: 1 within the bounds, falling to 0 outside, for many values at once."""
    from dm_control.utils import rewards

    return rewards.tolerance(values, bounds, margin, **options)


def _domain_and_task(name: str) -> tuple[str, str]:
    known: dict[str, tuple[str, ...]] = suite_module("TASKS_BY_DOMAIN")
    domain, _, task = name.partition("-")
    if domain not in known:
        raise ValueError(
            f"dm_control's suite has no domain {domain!r}, as in {name!r}: choose from {sorted(known)}."
        )
    if task not in known[domain]:
        tasks = [f"{domain}-{each}" for each in sorted(known[domain])]
        raise ValueError(f"dm_control's suite has no task {name!r}: the domain {domain!r} has {tasks}.")
    return domain, task


def _suite_env(domain: str, task: str, options: dict[str, Any]) -> EnvBase:
    # What a task draws when it is built, lqr its springs, is the same in all copies and runs.
    env = DMControlEnv(domain, task, **({"random": 0} | options))
    if domain != "lqr":  # alone in the suite its rewards have no such bounds
        env.reward_spec = Bounded(0.0, 1.0, shape=(1,), dtype=torch.float64)
    return env


class SuiteCopy(MujocoCopy):
    """The simulator behind one ``DMControlEnv``."""

    def __init__(self, env: EnvBase) -> None:
        self._env = env._env  # dm_control's own
        self.model, self.data = self._env.physics.model.ptr, self._env.physics.data.ptr
        self.time_per_step = self._env.control_timestep()
        self.max_episode_steps = self._env._step_limit

    def progress(self) -> dict[str, Any]:
        """Generator and clock."""
        return {
            "random": self._env.task.random.get_state(legacy=False),
            "steps": self._env._step_count,
            "ended": self._env._reset_next_step,
        }

    def set_progress(self, saved: dict[str, Any]) -> None:
        """Go on from what ``progress`` returned."""
        self._env.task.random.set_state(saved["random"])
        self._env._step_count = saved["steps"]
        self._env._reset_next_step = saved["ended"]
