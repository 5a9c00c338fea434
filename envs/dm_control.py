"""Any task of dm_control's suite, through TorchRL's ``DMControlEnv``."""

from __future__ import annotations

import warnings
from functools import partial
from typing import TYPE_CHECKING, Any

from nht.envs.arrays import Array

if TYPE_CHECKING:
    import torch
    from torchrl.envs import EnvBase

    from nht.envs.foreign import ForeignEnv


MISSING = (
    "tasks of dm_control need its package: pip install 'nht[dm_control]', and on Python 3.13 or newer, for which its "
    "labmaze has no wheel, pip install --no-deps dm_control after that."
)


def make_dm_control(
    name: str, num_envs: int = 1, seed: int | None = None, device: torch.device | str = "cpu", **options: Any
) -> ForeignEnv:
    """Copies of a task of dm_control's suite.

    Args:
        name: domain and task, ``"cheetah-run"``.
        num_envs: number of copies.
        seed: seed of every random draw of the task; None draws one, so that no two environments are alike.
        device: where the tensors go.
        options: arguments of the task itself, e.g. ``time_limit=20`` [s].

    Raises:
        ImportError: if dm_control is not installed.
        ValueError: for an unknown domain or task; the message lists those that exist.
    """
    domain, task = _domain_and_task(name)
    from nht.envs.foreign import ForeignEnv
    from nht.envs.suite_copy import SuiteCopy

    return ForeignEnv(partial(_suite_env, domain, task, options), SuiteCopy, num_envs, seed, device, name)


def suite_module(domain: str) -> Any:
    """The module of dm_control's suite that a domain lives in.

    Raises:
        ImportError: if dm_control is not installed; the message says how to.
    """
    try:
        with warnings.catch_warnings():
            # It looks for a window system at once, and GLFW complains where there is none.
            warnings.filterwarnings("ignore", message=".*(DISPLAY|GLFW)", module="glfw")
            from dm_control import suite
    except ImportError as error:
        raise ImportError(MISSING) from error
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
    from torchrl.envs import DMControlEnv

    # What a task draws when it is built, lqr its springs, is the same in all copies and runs.
    return DMControlEnv(domain, task, **({"random": 0} | options))
