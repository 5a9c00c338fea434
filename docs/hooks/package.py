"""Lets mkdocstrings find the package: folders of links, which look as the package does once it is installed."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.plugins import event_priority

PLACE = Path("build/package")
"""Where the folder is, below the root; ``mkdocs.yml`` names it as the path of mkdocstrings."""


@event_priority(100)  # before mkdocstrings looks whether the folder is there
def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Make the folder anew."""
    root = Path(config.config_file_path).parent
    project = tomllib.loads((root / "pyproject.toml").read_text())
    folders = project["tool"]["setuptools"]["package-dir"]
    place = root / PLACE
    shutil.rmtree(place, ignore_errors=True)
    for package, folder in folders.items():
        made = place.joinpath(*package.split("."))
        made.mkdir(parents=True)
        for file in (root / folder).glob("*.py"):
            (made / file.name).symlink_to(file)
    return config
