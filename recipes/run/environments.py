"""Where environments and maps meet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torchrl.envs import TransformedEnv

import nht
from nht.envs import FOREIGN, BatchedMujocoEnv, ForeignEnv, make_env
from nht.recipes.config import EnvConfig, Training
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

    Raises:
        KeyError, ValueError: if the map does not fit the task: the keys or widths of its context, its actuation.
    """
    base = base_env(env, seed=seed, num_envs=num_envs, device=device)
    context_keys = env.context_keys if map.context_dim else None
    mapped = TransformedEnv(base, ActionMapTransform(map, context_keys, action_scale=action_scale))
    if context_keys and map.context_keys is not None and list(map.context_keys) != context_keys:
        raise ValueError(
            f"the map was trained on the observations {list(map.context_keys)}, env.context_keys are {context_keys}."
        )
    return mapped


def base_env(
    env: EnvConfig, *, seed: int, num_envs: int | None = None, device: torch.device | str = "cpu"
) -> BatchedMujocoEnv | ForeignEnv:
    """The task itself, driven by actuations; arguments as of ``mapped_env``.

    Raises:
        ImportError: if the suite that the task belongs to is not installed.
        ValueError: for an unknown suite, task or option, or threads where copies are stepped one after the other.
    """
    copies = num_envs or env.num_envs
    if env.suite == "nht":
        return make_env(env.name, copies, env.num_threads, seed=seed, device=device, **env.options)
    if env.suite not in FOREIGN:
        raise ValueError(f"unknown env.suite {env.suite!r}: choose from {['nht', *FOREIGN]}.")
    if env.num_threads != 1:
        raise ValueError(
            f"{env.suite} steps its copies in one thread, got env.num_threads={env.num_threads}."
        )
    return FOREIGN[env.suite](env.name, copies, seed, device, **env.options)


TEST_SEED = 1_000_000
"""Added to a run's seed, so that test episodes are never those of the training."""


def lasting_failures(env: EnvConfig) -> EnvConfig:
    """The task as it is tested: failures do not end episodes, they last. Not every task knows them."""
    if "terminate_on_failure" not in env.options:
        return env
    return replace(env, options=env.options | {"terminate_on_failure": False})


def test_env(config: Training, map: nht.ActionMap, episodes: int) -> TransformedEnv:
    """One copy for each test episode, on seeds of its own; failures do not end episodes, they last."""
    env = lasting_failures(config.env)
    scale, seed = config.map.action_scale, config.seed + TEST_SEED
    return mapped_env(env, map, scale, seed=seed, num_envs=episodes, device=config.device)


def run_map(config: Training, folder: Path) -> nht.ActionMap:
    """The run's action map, which the run's folder keeps: the given file, else one trained on demonstrations.

    Raw actuation of a given scale needs no demonstrations.

    Raises:
        ValueError: if the given file is not a readable map, or one of another kind.
    """
    kept = folder / "map.safetensors"
    if not kept.exists():
        if config.map.file is not None:
            map = load_kind(config.map.file, config.map.kind, config.map.residual)
        elif (
            config.map.kind == "none" and config.map.residual is None and config.map.action_scale is not None
        ):
            map = raw_actuation(config.env)
        else:
            map = train_map(config.map, config.env, config.demos, config.seed).map
        nht.save_map(map, kept)
    return nht.load_map(kept, device=config.device)


def raw_actuation(env: EnvConfig) -> nht.Identity:
    """The motors themselves."""
    base = base_env(env, seed=0, num_envs=1)
    base.close()
    return nht.Identity(base.action_spec.shape[-1])
