"""Reads ``config.yaml`` of a run as plain settings: nothing that it names is imported or looked up."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from nht.reading import read_text, shortened

MOST = 20_000
"""Largest number of values in a configuration, counted as often as YAML aliases repeat them."""

NAMES = (("recipe",), ("env", "name"), ("env", "suite"), ("map", "kind"))
"""Settings that may be import paths, ``package.module:Name``."""


def read_settings(file: Path) -> dict[str, Any]:
    """The settings in a YAML file: numbers, text, lists and mappings.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no YAML, has values of other types, or too many; says where.
    """
    text = read_text(file)
    try:
        settings = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ValueError(f"{file} is not YAML that can be read: {shortened(error)}.") from None
    if not isinstance(settings, dict):
        raise ValueError(f"{file} holds a {type(settings).__name__}, expected settings by name.")
    _check_values(settings, file)
    return settings


def _check_values(settings: dict[str, Any], file: Path) -> None:
    left: list[Any] = [settings]
    count = 0
    while left:
        value, count = left.pop(), count + 1
        if count > MOST:
            raise ValueError(f"{file} holds more than {MOST:,} values, expected a configuration.")
        if isinstance(value, dict):
            if not all(isinstance(name, str) for name in value):
                raise ValueError(f"{file} has a setting whose name is no text: {shortened(list(value), 80)}.")
            left += value.values()
        elif isinstance(value, list):
            left += value
        elif isinstance(value, str) and "${" in value:
            raise ValueError(
                f"{file} holds {shortened(value, 80)!r}: a run's configuration is written out, and ${{...}} is not "
                "looked up."
            )
        elif value is not None and not isinstance(value, (str, int, float, bool)):
            raise ValueError(
                f"{file} holds a {type(value).__name__}, expected numbers, text, lists and names."
            )


def check_code(settings: dict[str, Any], file: Path, allow: Sequence[str]) -> None:
    """Check that what a configuration names by import paths is in packages that the caller allows.

    Raises:
        ValueError: for other packages, whose code reading would run.
    """
    for path in NAMES:
        value: Any = settings
        for part in path:
            value = value.get(part) if isinstance(value, dict) else None
        if not isinstance(value, str) or ":" not in value:
            continue
        module = value.partition(":")[0]
        if not any(module == package or module.startswith(f"{package}.") for package in allow):
            raise ValueError(
                f"{file} names {'.'.join(path)}={shortened(value, 80)}, code that would be run. If you trust it, allow "
                f"its package: allow=[{module.partition('.')[0]}], or read_config(folder, allow=[...])."
            )
