"""The hyperparameters of a search: their distributions, the draws from them, and the search's manifest."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np

from nht.reading import entry, known_entries, read_json
from nht.writing import replacing

Value = int | float | str
ROWS_FORMAT = 1
VERSION = f"{version('nht')}/{ROWS_FORMAT}"
"""Version of everything that a search writes: rows of different versions cannot be combined."""

GROWING = ("configs", "seeds", "best_seeds")
"""Settings that may be increased when a search is continued."""


@dataclass(frozen=True)
class Distribution:
    """The distribution of a hyperparameter (Bergstra & Bengio 2012 define the kinds).

    Args:
        kind: ``uniform``, ``integer`` (uniform, both ends included), ``exponential`` (uniform in the logarithm),
            ``geometric`` (the same, rounded to an integer) or ``choice`` (each equally likely).
        values: low and high, or the choices.
    """

    kind: str
    values: tuple[Value, ...]

    @classmethod
    def parse(cls, name: str, written: dict[str, Any]) -> Distribution:
        """From ``{kind: values}`` in a YAML file.

        Raises:
            ValueError: for an unknown kind, or values that do not fit it.
        """
        if len(written) != 1 or next(iter(written)) not in DISTRIBUTIONS:
            raise ValueError(
                f"search.space.{name} must be one of {list(DISTRIBUTIONS)}: [...], got {dict(written)}."
            )
        ((kind, values),) = written.items()
        if kind == "choice":
            if not values:
                raise ValueError(f"search.space.{name}: a choice needs values, got none.")
            return cls(kind, tuple(values))
        if len(values) != 2 or not values[0] < values[1]:
            raise ValueError(
                f"search.space.{name}: {kind} takes [low, high] with low < high, got {list(values)}."
            )
        if kind in ("exponential", "geometric") and values[0] <= 0:
            raise ValueError(f"search.space.{name}: {kind} needs positive bounds, got {list(values)}.")
        return cls(kind, tuple(values))

    def at(self, quantile: float) -> Value:
        """The value of the quantile in [0, 1)."""
        return (
            DISTRIBUTIONS[self.kind](quantile, *self.values)
            if self.kind != "choice"
            else self._chosen(quantile)
        )

    def _chosen(self, quantile: float) -> Value:
        return self.values[int(quantile * len(self.values))]


def _uniform(quantile: float, low: float, high: float) -> float:
    return low + quantile * (high - low)


def _integer(quantile: float, low: int, high: int) -> int:
    return low + int(quantile * (high + 1 - low))


def _exponential(quantile: float, low: float, high: float) -> float:
    return math.exp(_uniform(quantile, math.log(low), math.log(high)))


def _geometric(quantile: float, low: int, high: int) -> int:
    return round(_exponential(quantile, low, high))


DISTRIBUTIONS: dict[str, Any] = {
    "uniform": _uniform,
    "integer": _integer,
    "exponential": _exponential,
    "geometric": _geometric,
    "choice": None,
}


Space = dict[str, dict[str, dict[str, list[Any]]]]
"""By interface, and under ``agent`` for all of them: each hyperparameter's name as on the command line, its kind of
distribution, its values."""


def draw_settings(space: Space, seed: int, configuration: int, interface: str) -> dict[str, Value]:
    """One configuration of an interface: a value for each of its hyperparameters.

    Every hyperparameter has a generator of its own, seeded by its name, the search's seed and the configuration's
    number. So a value depends neither on what else is drawn nor on how many configurations there are; all interfaces
    share the agent's; an interface with its own range gets the same quantile of it.

    Args:
        space: the distributions.
        seed: of the search.
        configuration: its number.
        interface: its name.

    Raises:
        ValueError: for a distribution that does not exist.
    """
    distributions = space["agent"] | space.get(interface, {})
    return {
        name: Distribution.parse(f"{interface}.{name}", written).at(quantile(seed, configuration, name))
        for name, written in distributions.items()
    }


def quantile(seed: int, configuration: int, name: str) -> float:
    """The draw of one hyperparameter's generator, in [0, 1)."""
    return float(np.random.default_rng([seed, configuration, crc32(name.encode())]).random())


def write_search_manifest(path: Path, settings: dict[str, Any]) -> None:
    """Write the search's manifest; an existing one must be of the same search.

    Args:
        path: of the JSON file.
        settings: everything that decides what is run.

    Raises:
        ValueError: if the file is of another search or version; names each difference.
    """
    manifest = {"version": VERSION, "settings": settings}
    if path.exists():
        _check_same(path, read_search_manifest(path), manifest)
    with replacing(path) as scratch:
        scratch.write_text(json.dumps(manifest, indent=1))


def read_search_manifest(path: Path) -> dict[str, Any]:
    """The manifest of a search, with ``version`` and ``settings``. Raises ValueError for any other file."""
    manifest = read_json(path)
    known_entries(manifest, ("version", "settings"), str(path))
    entry(manifest, "version", str, str(path))
    entry(manifest, "settings", dict, str(path))
    return manifest


def _check_same(path: Path, old: dict[str, Any], new: dict[str, Any]) -> None:
    if old["version"] != new["version"]:
        raise ValueError(
            f"{path} was written by version {old['version']}, this is {new['version']}: choose another folder."
        )
    before, now = old["settings"], new["settings"]
    changed = [
        f"{name} was {before.get(name)}, is {now.get(name)}"
        for name in sorted(before.keys() | now.keys())
        if before.get(name) != now.get(name) and not (name in GROWING and _grows(before.get(name), now[name]))
    ]
    if changed:
        raise ValueError(f"{path} is of another search: {'; '.join(changed)}. Choose another search.folder.")


def _grows(before: Any, now: int) -> bool:
    return type(before) is int and now >= before
