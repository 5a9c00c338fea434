"""Where a run comes from: versions, command line and git commit."""

from __future__ import annotations

import platform
import shlex
import subprocess
import sys
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import nht

VERSIONED = ("nht", "torch", "torchrl", "tensordict", "mujoco", "gymnasium", "numpy")


def provenance() -> dict[str, Any]:
    """Versions of what decides the numbers, the command that was typed, and the commits of our code and the user's."""
    return {
        "versions": {"python": platform.python_version()} | _versions(),
        "command": _command(),
        "git": {"nht": _commit(Path(nht.__file__).parent), "here": _commit(Path.cwd())},
    }


def _versions() -> dict[str, str]:
    found = {}
    for package in VERSIONED:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    return found


def _command() -> str:
    """The command line, with the module where Python was started with ``-m``."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    program = ["-m", spec.name] if spec is not None else sys.argv[:1]
    return shlex.join(["python", *program, *sys.argv[1:]])


@cache
def _commit(folder: Path) -> str | None:
    """The commit of the repository that a folder is in, with ``-dirty`` if files differ; None outside of one."""
    try:
        done = subprocess.run(
            ["git", "-C", str(folder), "describe", "--always", "--dirty", "--exclude=*", "--abbrev=40"],
            capture_output=True,
            text=True,
            timeout=10,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()
