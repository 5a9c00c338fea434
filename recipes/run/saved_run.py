"""Reads a run's configuration and action map from its folder."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

import nht
from nht.reading import shortened
from nht.recipes.agents.table import find_algorithm
from nht.recipes.maps.kinds import find_kind
from nht.recipes.run.config_file import check_code, read_settings
from nht.recipes.sections import Training
from nht.storage import format_version

CONFIG_FILE, MAP_FILE = "config.yaml", "map.safetensors"
OLDEST_ALGORITHM = "ddpg"
"""The algorithm of old folders, whose configuration does not name it."""


def read_config(folder: Path, allow: Sequence[str] = ()) -> Training:
    """The configuration that a run was started with.

    Args:
        folder: of the run.
        allow: packages whose code it may name by import paths.

    Raises:
        FileNotFoundError: if the folder holds no run.
        ValueError: if its configuration cannot be read, or names code of other packages.
    """
    if not (folder / CONFIG_FILE).exists():
        raise FileNotFoundError(f"{folder} holds no run: it has no {CONFIG_FILE}.")
    return read_run(folder, allow)[1]


def read_run(folder: Path, allow: Sequence[str] = ()) -> tuple[str, Training]:
    """The name of a run's algorithm, and the run's configuration. Raises as ``read_config`` does."""
    settings = folder / CONFIG_FILE
    saved = read_settings(settings)
    check_code(saved, settings, allow)
    algorithm = saved.pop("recipe", OLDEST_ALGORITHM)
    try:
        schema = OmegaConf.structured(find_algorithm(algorithm).schema)
        return algorithm, cast(Training, OmegaConf.to_object(OmegaConf.merge(schema, saved)))
    except (OmegaConfBaseException, ValueError, TypeError, AttributeError, ArithmeticError) as error:
        raise ValueError(f"{settings} is no configuration of a run: {shortened(error)}.") from error


def kept_map(
    folder: Path, config: Training, device: torch.device | str = "cpu", allow: Sequence[str] = ()
) -> nht.ActionMap:
    """The action map of a run; if an earlier version made it, with the scale of the run's configuration.

    Args:
        folder: of the run.
        config: of the run.
        device: where the map goes.
        allow: packages whose classes the map's file may name, beside the package of the kind of map.

    Raises:
        FileNotFoundError, ValueError: as ``nht.load_map``.
    """
    path = folder / MAP_FILE
    own = find_kind(config.map.kind).map_class.__module__  # the configuration names it
    map = nht.load_map(path, device=device, allow=[*allow, own])
    scale = config.map.action_scale
    if format_version(path) == 1 and config.map.scale_is_set and scale is not None:
        map.action_scale.fill_(scale)
    return map
