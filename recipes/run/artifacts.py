"""What runs hand to each other as W&B's versioned artifacts: demonstrations, maps and policies.

Maps and demonstrations are named after what they are, so that whoever takes a file names the same artifact as whoever
made it; equal contents are one version. A policy is its run's, and named after that.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import nht
from nht.manifest import DEMOS_MANIFEST, read_manifest

LONGEST_NAME = 128
"""Largest number of characters in the name of an artifact."""
LATEST, BEST_ALIAS = "latest", "best"
ERROR = "validation_error"
"""The fact that tells which of the maps with one name fits best."""


@dataclass(frozen=True)
class FileSet:
    """Files with a name, a type and facts about them.

    Attributes:
        name: of all versions together.
        type: ``demonstrations``, ``action-map`` or ``policy``.
        files: by the name that they get.
        facts: W&B's metadata.
        aliases: of this version.
    """

    name: str
    type: str
    files: Mapping[str, Path]
    facts: Mapping[str, Any] = field(default_factory=dict)
    aliases: Sequence[str] = (LATEST,)


def map_files(
    file: Path, map: nht.ActionMap, metrics: Mapping[str, float] | None = None, *, best: bool = False
) -> FileSet:
    """A map's file, with what it is and how well it fits.

    The name stands for all maps with k axes that were trained on the same demonstrations.

    Args:
        file: of the map.
        map: what is in it.
        metrics: of its training, if that is known.
        best: whether it fits best among those.
    """
    source = map.data_fingerprint[:8] if map.data_fingerprint else type(map).__name__.lower()
    facts = {
        "class": type(map).__name__,
        "action_dim": map.action_dim,
        "actuation_dim": map.actuation_dim,
        "context_dim": map.context_dim,
        "context_keys": [str(key) for key in map.context_keys or ()],
        "action_scale": float(map.action_scale),
        "data_fingerprint": map.data_fingerprint,
        "nht": nht.__version__,
    }
    return FileSet(
        valid_name(f"map-k{map.action_dim}-{source}"),
        "action-map",
        {"map.safetensors": file},
        facts | finite(metrics or {}),
        (LATEST, BEST_ALIAS) if best else (LATEST,),
    )


def demos_files(folder: Path) -> FileSet:
    """Demonstrations: their manifest alone, as the data may be large; its fingerprint says which they are."""
    manifest = read_manifest(folder)
    name = valid_name(f"demos-{manifest['env']}-{manifest['fingerprint'][:8]}")
    return FileSet(name, "demonstrations", {DEMOS_MANIFEST: folder / DEMOS_MANIFEST}, manifest)


def policy_files(file: Path, run: str, facts: Mapping[str, float], *, best: bool) -> FileSet:
    """The policy of a run.

    Args:
        file: of the policy.
        run: the run's id.
        facts: of its last test.
        best: whether no earlier test was better.
    """
    aliases = (LATEST, BEST_ALIAS) if best else (LATEST,)
    return FileSet(valid_name(f"policy-{run}"), "policy", {file.name: file}, finite(facts), aliases)


def fits_best(facts: Mapping[str, Any], known: Mapping[str, Any] | None) -> bool:
    """Whether a map's error is no larger than that of the best one so far; None is that there is none."""
    error = facts.get(ERROR)
    return isinstance(error, float) and (known is None or error <= float(known.get(ERROR, math.inf)))


def valid_name(name: str) -> str:
    """The name with the characters that W&B allows."""
    return re.sub(r"[^A-Za-z0-9_.-]", "-", name)[:LONGEST_NAME]


def finite(facts: Mapping[str, Any]) -> dict[str, Any]:
    """The facts that JSON can say: numbers that are not finite as text."""
    return {
        name: value if not isinstance(value, float) or math.isfinite(value) else str(value)
        for name, value in facts.items()
    }
