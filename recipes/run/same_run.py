"""Checks that a resumed run is the one that was started: only some settings may differ."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from nht.recipes.agents.table import find_algorithm, name_of
from nht.recipes.sections import Training

TAKEN = (
    "algo.total_frames",
    "evaluation.every",
    "evaluation.video",
    "evaluation.video_every",
    "env.num_threads",
    "device",
    "torch_threads",
    "tf32",
    "run",
)
"""Settings that may differ in a resumed run; its checkpoints depend on all others."""


def check_same(folder: Path, config: Training, algorithm: str, saved: Training) -> None:
    """Check that a run can be resumed with a configuration, and fill in the settings that this leaves open.

    Args:
        folder: of the run.
        config: the configuration to go on with.
        algorithm: name of the run's algorithm.
        saved: the configuration that the run was started with.

    Raises:
        ValueError: if a setting differs that its checkpoints depend on; the message says which.
    """
    now = name_of(type(config))
    if find_algorithm(algorithm).schema is not type(config):
        raise ValueError(f"{folder} holds a run of {algorithm}: it cannot go on with {now}.")
    if config.env.context_keys is None:
        config.env.context_keys = saved.env.context_keys
    if not config.map.scale_is_set:
        config.map.action_scale = saved.map.action_scale
    before, after = _flat(asdict(saved)), _flat(asdict(config))
    changed = [name for name in after if before.get(name) != after[name] and not _is_taken(name)]
    if changed:
        old = ", ".join(f"{name}={before.get(name)}" for name in changed)
        new = ", ".join(f"{name}={after[name]}" for name in changed)
        raise ValueError(f"{folder} holds a run with {old}: it cannot go on with {new}.")


def _flat(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted names; free dictionaries, such as options, stay whole."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        if isinstance(value, dict) and not prefix:
            flat |= _flat(value, f"{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _is_taken(name: str) -> bool:
    return any(name == taken or name.startswith(f"{taken}.") for taken in TAKEN)
