"""Where environments and maps meet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torchrl.envs import TransformedEnv

import nht
from nht.envs import make_env
from nht.recipes.config import DDPG, EnvConfig
from nht.recipes.train_map import load_kind, train_map
from nht.transforms import ActionMapTransform


def mapped_env(
    env: EnvConfig,
    map: nht.ActionMap,
    action_scale: float | None,
    *,
    seed: int,
    num_envs: int | None = None,
    device: torch.device | str = "cpu",
) -> TransformedEnv:
    """The task, driven through an action map: its policy acts in [-1, 1]^k.

    Args:
        env: which task.
        map: from action and context to actuation.
        action_scale: actuation per unit of action; None takes the map's own.
        seed: of the task's random draws.
        num_envs: number of copies, if another than the configuration's.
        device: where the tensors go.
    """
    base = make_env(
        env.name, num_envs or env.num_envs, env.num_threads, seed=seed, device=device, **env.options
    )
    return TransformedEnv(base, ActionMapTransform(map, env.context_keys, action_scale=action_scale))


TEST_SEED = 1_000_000
"""Added to a run's seed, so that test episodes are never those of the training."""


def test_env(config: DDPG, map: nht.ActionMap, episodes: int) -> TransformedEnv:
    """One copy for each test episode, on seeds of its own; failures do not end episodes, they last."""
    env = replace(config.env, options=config.env.options | {"terminate_on_failure": False})
    scale, seed = config.map.action_scale, config.seed + TEST_SEED
    return mapped_env(env, map, scale, seed=seed, num_envs=episodes, device=config.device)


def run_map(config: DDPG, folder: Path) -> nht.ActionMap:
    """The run's action map, which the run's folder keeps: the given file, else one trained on demonstrations.

    Raises:
        ValueError: if the given file is not a readable map, or one of another kind.
    """
    kept = folder / "map.safetensors"
    if not kept.exists():
        if config.map.file is None:
            map = train_map(config.map, config.env, config.demos, config.seed).map
        else:
            map = load_kind(config.map.file, config.map.kind, config.map.residual)
        nht.save_map(map, kept)
    return nht.load_map(kept, device=config.device)
