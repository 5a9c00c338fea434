"""What a search and its runs are called on W&B: no other search has these names, whatever its folder is called."""

from __future__ import annotations

import os
import uuid
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from nht.reading import read_text
from nht.recipes.overrides import quoted
from nht.recipes.run.artifacts import valid_name
from nht.writing import scratch

ID_FILE = "search-id.txt"
"""In the folder of a search: what tells it from others of the same name. All machines that share the folder read it."""


def search_name(folder: Path) -> str:
    """The name of the search in a folder: the folder's, and an id that the first process draws."""
    file = folder / ID_FILE
    if not file.exists():
        with scratch(file) as place:
            place.write_text(uuid.uuid4().hex[:8])
            with suppress(FileExistsError):  # then another process was first
                os.link(place, file)
    return valid_name(f"{folder.resolve().name}-{read_text(file).strip()[:8]}")


class RunOfSearch(Protocol):
    """What tells the runs of a search apart."""

    @property
    def stage(self) -> str:
        """``search`` or ``best``."""

    @property
    def interface(self) -> str:
        """The interface of the run."""

    @property
    def configuration(self) -> int:
        """Its number."""

    @property
    def seed(self) -> int:
        """Of map and agent."""


def names_of(job: RunOfSearch, folder: Path) -> Sequence[str]:
    """Overrides for a run's recipe: a group for each configuration, and a name that says which run it is."""
    search = search_name(folder)
    said = {
        "run.wandb_group": f"{search}-{job.stage}-{job.configuration:03d}",
        "run.wandb_name": f"{search}-{job.stage}-{job.interface}-{job.configuration:03d}-seed{job.seed}",
    }
    return [f"{name}={quoted(value)}" for name, value in said.items()] + [
        f"run.wandb_tags=[{quoted(search)},{quoted(job.stage)}]"
    ]
