"""Adapts any environment of TorchRL with continuous actions to the recipes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torchrl.envs import DMControlWrapper, EnvBase, GymWrapper

from nht.envs.foreign import ForeignEnv
from nht.envs.foreign_copies import LONGEST_EPISODE, ForeignCopy
from nht.envs.gymnasium_copies import FRAME_RATE, gymnasium_copy
from nht.envs.simulation import CopyRenderer
from nht.envs.suite_copy import SuiteCopy
from nht.envs.table import imported


def make_torchrl(
    factory: Callable[..., EnvBase] | str,
    num_envs: int = 1,
    seed: int | None = None,
    device: torch.device | str = "cpu",
    *,
    max_episode_steps: int = LONGEST_EPISODE,
    time_per_step: float = 1.0 / FRAME_RATE,
    **options: Any,
) -> ForeignEnv:
    """Copies of an environment of TorchRL.

    Its actions must be a vector of numbers under ``"action"``, its observations numbers, not nested. TorchRL's wrappers
    of Gymnasium and dm_control are saved as by ``make_gymnasium`` and ``make_dm_control``, unless transforms surround
    them; for others ``task.resume_obstacle`` says why not. They are drawn by their own ``render()``, if they have one.

    Args:
        factory: makes one copy, of batch size ``()``: a function, or an import path, ``"my_package.robots:make"``.
        num_envs: number of copies.
        seed: seed of every random draw; None draws one, so that no two environments are alike.
        device: where the tensors go.
        max_episode_steps: steps after which an episode is truncated, where the environment itself knows no limit.
        time_per_step: simulated time of a step [s], where the environment does not say; films run at that speed.
        options: arguments of the factory.

    Raises:
        ImportError: if there is nothing at the import path.
        ValueError: for actions or observations of other kinds, or copies that are batches.
    """
    make: Callable[..., EnvBase] = imported(factory) if isinstance(factory, str) else factory
    name = factory if isinstance(factory, str) else getattr(make, "__qualname__", type(make).__qualname__)
    simulator = partial(_copy, longest_episode=max_episode_steps, time_per_step=time_per_step)
    made = partial(make, **options) if options else make
    return ForeignEnv(made, simulator, num_envs, seed, device, f"the environment of {name}")


def _copy(env: EnvBase, longest_episode: int, time_per_step: float) -> ForeignCopy:
    if isinstance(env, GymWrapper):
        copy: ForeignCopy = gymnasium_copy(env)
    elif isinstance(env, DMControlWrapper):
        copy = SuiteCopy(env)
    else:
        copy = TorchRLCopy(env, time_per_step)
    copy.longest_episode = longest_episode
    return copy


class TorchRLCopy(ForeignCopy):
    """An environment that TorchRL can step, but that cannot be saved.

    Args:
        env: the environment.
        time_per_step: simulated time of a step [s].
    """

    def __init__(self, env: EnvBase, time_per_step: float) -> None:
        self.env = env
        self.resume_obstacle = f"nothing says how to save the simulator of a {type(env).__name__}"
        self.time_per_step = time_per_step

    def state_dict(self) -> dict[str, Any]:
        """Empty: there is nothing that can be saved."""
        return {}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Do nothing."""

    def renderer(self, width: int, height: int, camera: str | int | None) -> CopyRenderer:
        """Takes the pictures that the environment's ``render()`` returns, stretched to this size.

        Raises:
            RuntimeError: if it has no such method.
        """
        if not callable(draw := getattr(self.env, "render", None)):
            raise RuntimeError(f"a {type(self.env).__name__} cannot be drawn: it has no method render().")
        from nht.envs.own_pictures import OwnRenderer

        return OwnRenderer(draw, width, height, camera)
