"""Deterministic test episodes, and their video."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type

from nht.envs.foreign import ForeignTask
from nht.envs.rendering import ForeignRenderer, SceneRenderer

Policy = Callable[[TensorDictBase], TensorDictBase]


@dataclass(frozen=True)
class Evaluation:
    """Outcome of a number of test episodes, one value each, ``(episodes,)``."""

    success: torch.Tensor
    """Whether the episode was successful at its last step."""
    failure: torch.Tensor
    """Whether it ever failed."""
    episode_return: torch.Tensor
    """Sum of its rewards."""

    def metrics(self) -> dict[str, float]:
        """Means over the episodes."""
        return {
            "eval_success": float(self.success.double().mean()),
            "eval_failure": float(self.failure.double().mean()),
            "eval_return": float(self.episode_return.mean()),
        }


@torch.no_grad()
def evaluate(env: TransformedEnv, policy: Policy, on_step: Callable[[], None] | None = None) -> Evaluation:
    """Run one episode in every copy of ``env`` without exploration.

    Args:
        env: batched environment; its first episode end in each copy is the one that counts.
        policy: reads the observation, writes ``"action"``.
        on_step: called after the reset and after every step.
    """
    current = env.reset()
    running = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    success, failure = torch.zeros_like(running), torch.zeros_like(running)
    total = torch.zeros(env.batch_size, device=env.device)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        while running.any():
            if on_step is not None:
                on_step()
            stepped, current = env.step_and_maybe_reset(policy(current))
            outcome = stepped["next"]
            success = torch.where(running, outcome["success"][..., 0], success)
            failure |= running & outcome["failure"][..., 0]
            total += running * outcome["reward"][..., 0]
            running &= ~outcome["done"][..., 0]
    return Evaluation(success, failure, total)


def record_video(env: TransformedEnv, policy: Policy, path: Path) -> Evaluation:
    """Write one episode of every copy of ``env``, side by side, as an MP4 at the speed of real time.

    Raises:
        RuntimeError: if this machine cannot render offscreen.
    """
    task = env.base_env.task
    of_its_kind = ForeignRenderer if isinstance(task, ForeignTask) else SceneRenderer
    renderer = of_its_kind(task, width=480, height=360)
    frames_per_second = round(1 / task.time_per_step)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        with imageio.get_writer(path, fps=frames_per_second, macro_block_size=8) as writer:
            video: Any = writer  # its stub lacks append_data

            def film() -> None:
                rows = [renderer.frame(row) for row in range(task.num_envs)]
                video.append_data(np.concatenate(rows, axis=1))

            return evaluate(env, policy, on_step=film)
    finally:
        renderer.close()
