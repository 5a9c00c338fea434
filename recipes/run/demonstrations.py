"""The demonstrations that a run learns from, as steps of its own task: their actuations, seen through its map."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

import nht
from nht.episodes import key_name, listed
from nht.reading import entry, read_json
from nht.recipes.agents.returns import reward_range
from nht.recipes.data.recording import record_expert
from nht.recipes.maps.kinds import task_context_keys
from nht.recipes.run.environments import base_env
from nht.recipes.run.metrics import DEMOS_CLIPPED, DEMOS_MISSED
from nht.recipes.sections import AlgoDemosConfig, EnvConfig, ReplayDemosConfig, Training
from nht.transforms import ActionMapTransform
from nht.writing import replacing

DEMOS_FOLDER, DEMOS_FILE = "demos", "demos.json"
"""In a run's folder: what was recorded for the run, and how well its map expresses what it learns from."""

REPLAYED = ("reward", "terminated", ("next", "observation"))
"""What a replay buffer needs of demonstrations, beside what imitation does: observations, actuations, a context."""

REWARD_TOLERANCE = 1e-6
"""How far a reward in single precision may lie beyond the task's bounds, as a share of these."""

WARNED, REFUSED = 0.1, 1.0
"""Shares of energy that the stored actions may miss. From 1 on they say no more than that nothing moved; below, a poor
map is a baseline that one may want to see, so it is warned about only."""


def asked_for(config: Training) -> AlgoDemosConfig:
    """The demonstrations that the run's algorithm learns from; none where it has no such option."""
    demos = getattr(config.algo, "demos", None)
    return demos if isinstance(demos, AlgoDemosConfig) else AlgoDemosConfig()


def replays(config: Training) -> bool:
    """Whether the run's algorithm learns from demonstrations as from steps that it collected."""
    return isinstance(asked_for(config), ReplayDemosConfig)


def transitions_asked(config: Training) -> int:
    """How many demonstrated transitions the run's algorithm learns from."""
    return asked_for(config).transitions


def demos_path(config: Training) -> Path:
    """The folder of the run's demonstrations: the given one, or the one in its folder that they are recorded in."""
    return Path(config.run.folder) / DEMOS_FOLDER if config.demos.path is None else Path(config.demos.path)


def provide_demos(config: Training, resuming: bool) -> Training:
    """See to it that the demonstrations to learn from are there and are of use, before anything is trained.

    Without ``demos.path`` the task's expert records them in the run's folder: for the map, too.

    Args:
        config: of the run.
        resuming: whether they may have been recorded already.

    Returns:
        the configuration for the training of the map, which says where they are.

    Raises:
        FileExistsError: if there are others where they are to be recorded.
        FileNotFoundError: if there are none.
        KeyError: if they lack what learning needs; names it.
        ValueError: if they are too few or of another task: its name, widths or rewards.
    """
    count, path = transitions_asked(config), demos_path(config)
    if not count:
        return config
    if config.demos.path is None:
        if count > config.demos.transitions:
            raise ValueError(
                f"algo.demos.transitions={count} must be at most demos.transitions={config.demos.transitions}, which "
                "the expert records."
            )
        if not (resuming and path.exists()):
            record_expert(config.env, config.demos, config.seed, path)
    check_demos(nht.load_demos(path, env=config.env.name), count, config, str(path))
    return replace(config, demos=replace(config.demos, path=config.demos.path or str(path)))


def check_demos(demos: nht.Demos, count: int, config: Training, name: str) -> None:
    """Check that a run can learn from demonstrations. Raises as ``provide_demos`` does; ``name`` is theirs."""
    data, env, replayed = demos.data, config.env, replays(config)
    needed = ("observation", *(REPLAYED if replayed else ()))
    if missing := [key_name(key) for key in needed if data.get(key, None) is None]:
        raise KeyError(f"{name} lacks {missing}, which algo.demos needs: it has {listed(data)}.")
    if count > len(demos):
        raise ValueError(f"algo.demos.transitions={count} must be at most the {len(demos)} of {name}.")
    task = base_env(env, seed=0, num_envs=1)
    task.close()
    seen = task.observation_spec["observation"].shape[-1]
    widths: dict[Any, int] = {"observation": seen, "actuation": task.action_spec.shape[-1]}
    if replayed:
        widths["next", "observation"] = seen
    for key, width in widths.items():
        if data[key].shape[-1] != width:
            raise ValueError(
                f"{name} does not fit {env.name}: {key_name(key)!r} has {data[key].shape[-1]} entries, the task's "
                f"{width}."
            )
    if not replayed:
        return
    low, high = reward_range(task)
    rewards = data["reward"][:count]
    least, most = float(rewards.min()), float(rewards.max())
    if least < low - REWARD_TOLERANCE * abs(low) or most > high + REWARD_TOLERANCE * abs(high):
        raise ValueError(
            f"{name} has rewards from {least:.6g} to {most:.6g}, those of {env.name} lie in [{low:.6g}, {high:.6g}]."
        )


def note_demos(config: Training, map: nht.ActionMap) -> dict[str, float]:
    """Write down, beside the run's map, how well it expresses the demonstrations; or check that they are still those.

    Returns:
        the columns that the run's table has about them; none without them.

    Raises:
        ValueError: if the map does not express them at all, or if they were changed since the run began.
    """
    if not transitions_asked(config):
        return {}
    file, path = Path(config.run.folder) / DEMOS_FILE, demos_path(config)
    fingerprint = nht.load_demos(path).fingerprint
    if file.exists():
        if entry(read_json(file), "fingerprint", str, str(file)) != fingerprint:
            raise ValueError(f"{path} no longer holds the demonstrations that the run began with.")
        found = read_json(file)
        return {name: entry(found, name, float, str(file)) for name in (DEMOS_CLIPPED, DEMOS_MISSED)}
    _, measured = demo_steps(config, map)
    missed = measured[DEMOS_MISSED]
    told = f"the actions for {path} miss {missed:.1%} of the demonstrated actuations' energy, and " + (
        f"{measured[DEMOS_CLIPPED]:.1%} of their numbers are clipped to [-1, 1]"
    )
    if not missed < REFUSED:
        raise ValueError(
            f"the map cannot express the demonstrations: {told}. Take a larger map.action_dim, map.action_scale or "
            "map.residual."
        )
    if missed > WARNED:
        warnings.warn(
            f"{told}: what followed in the demonstrations is not what these actions do.", stacklevel=2
        )
    with replacing(file) as scratch:
        scratch.write_text(json.dumps(measured | {"fingerprint": fingerprint}))
    return measured


def demo_steps(config: Training, map: nht.ActionMap) -> tuple[TensorDict, dict[str, float]]:
    """The first demonstrated transitions as steps ``(T,)`` that a collector could have made through the map.

    An action is what the map makes of the recorded actuation, ``map.encode``, clipped to [-1, 1]. What an algorithm
    that replays nothing gets ends there. Else ends are those that were recorded; a failure is what is called so, or
    else an end without success.

    Returns:
        the steps; and the share of the actions' numbers that were clipped and the share of energy
        ``|u - decode(a)|^2 / |u|^2`` that is missed by the actuations that these actions stand for, both within
        the motors' limits. It is measured on what is learned from, clipping included, whatever the map was trained on.
    """
    device = map.action_scale.device
    data = nht.load_demos(demos_path(config)).data[: transitions_asked(config)].to(device)
    keys = map.context_keys if map.context_keys is not None else task_context_keys(config.env)
    keys = keys if map.context_dim else []
    with torch.no_grad():
        free = ActionMapTransform(map, keys, actuation_key="actuation", forward_only=True)(data)["action"]
        action = free.clamp(-1.0, 1.0)
        measured = {
            DEMOS_CLIPPED: float((free != action).double().mean()),
            DEMOS_MISSED: _missed(config.env, map, action, data, keys),
        }
    seen = {"observation": data["observation"].float(), "action": action.float()}
    steps = TensorDict(seen, [len(data)], device=device)
    return (steps.set("next", _outcomes(data)) if replays(config) else steps), measured


def _missed(
    env: EnvConfig, map: nht.ActionMap, action: Tensor, data: TensorDictBase, keys: Sequence[Any]
) -> float:
    """The share of energy of the actuations, within the motors' limits, that decoded actions miss."""
    task = base_env(env, seed=0, num_envs=1)
    task.close()
    bounds = task.action_spec.space
    low, high = (
        bound.reshape(-1, bound.shape[-1])[0].to(action.device) for bound in (bounds.low, bounds.high)
    )
    context = torch.cat([action[:, :0], *(data[key].to(action.dtype) for key in keys)], dim=-1)
    wanted = data["actuation"].to(low.dtype).clamp(low, high)
    error = (map.decode(action, context, low, high) - wanted).double().square().sum()
    energy = wanted.double().square().sum()
    return float(error / energy) if energy > 0 else float(error)


def _outcomes(data: TensorDictBase) -> TensorDict:
    rows = len(data), 1
    episode = data["episode"]
    last = torch.cat([episode[1:] != episode[:-1], torch.ones_like(episode[:1], dtype=torch.bool)])
    terminated = data["terminated"].reshape(rows).bool()
    success = data["success"].reshape(rows).bool() if "success" in data else torch.zeros_like(terminated)
    failure = data["failure"].reshape(rows).bool() if "failure" in data else terminated & ~success
    outcomes = {
        "observation": data["next", "observation"].float(),
        "reward": data["reward"].reshape(rows).float(),
        "done": terminated | last.unsqueeze(-1),
        "terminated": terminated,
        "failure": failure,
    }
    return TensorDict(outcomes, [len(data)])


def demonstrated(configs: Sequence[Training], maps: Sequence[nht.ActionMap]) -> TensorDictBase | None:
    """The demonstrations that a run learns from as a batch ``(1, T)`` of steps; of several learners, ``(L, 1, T)``.

    Args:
        configs: of each learner.
        maps: of each learner.

    Returns:
        None if the algorithm learns from none.
    """
    if not transitions_asked(configs[0]):
        return None
    found = [demo_steps(config, map)[0].unsqueeze(0) for config, map in zip(configs, maps, strict=True)]
    return found[0] if len(found) == 1 else torch.stack(found)
