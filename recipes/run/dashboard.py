"""Logs a run to Weights & Biases: offline unless the user has logged in, and never required.

``wandb`` is imported only if a run uses it.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from netrc import NetrcParseError, netrc
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import urlsplit

from nht.reading import shortened
from nht.recipes.run.metrics import FRAMES
from nht.recipes.sections import RunConfig

LONGEST_NAME = 128
"""Largest number of characters in the name of an artifact."""
SERVER = "https://api.wandb.ai"
"""W&B's own server, unless ``WANDB_BASE_URL`` names another."""


class Dashboard:
    """One run on W&B, whose files are in the run's folder.

    Args:
        folder: of the run.
        settings: of its ``config.yaml``; W&B shows them under the same keys.
        run: names of the project, group and so on in W&B.
        mode: ``online``, ``offline`` or ``shared``.

    Raises:
        ImportError: if ``wandb`` is not installed.
        RuntimeError: if W&B does not start.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], run: RunConfig, mode: str) -> None:
        os.environ.setdefault("WANDB_SILENT", "true")
        if not os.environ.get("WANDB_API_KEY", "-"):
            del os.environ["WANDB_API_KEY"]  # empty, as compose files leave it: W&B would refuse to start
        self._folder = folder
        self._wandb = wandb = import_wandb()
        try:
            self._run = wandb.init(
                name=folder.name,
                dir=str(folder),
                project=run.wandb_project,
                group=run.wandb_group,
                job_type=run.wandb_job_type,
                config=dict(settings),
                mode=mode,
                reinit="create_new",  # W&B would go on with a run of this process that was left, or is a caller's
            )
        except (wandb.Error, ValueError) as error:
            raise RuntimeError(
                f"W&B does not start: {shortened(error)}. Set WANDB_MODE=offline, or run.wandb=false."
            ) from error

    def log(self, frames: int, row: dict[str, float]) -> None:
        """Log a row of metrics against environment steps."""
        self._run.log(row | {FRAMES: frames}, step=frames)

    def finish(self, map_file: Path, video: Path) -> None:
        """Upload the map, and the video if there is one."""
        if video.exists():
            self._run.log({"video": self._wandb.Video(str(video), format="mp4")})
        name = re.sub(r"[^A-Za-z0-9_.-]", "-", f"map-{self._folder.name}")  # what W&B allows
        artifact = self._wandb.Artifact(name[:LONGEST_NAME], type="action-map")
        artifact.add_file(str(map_file))
        self._run.log_artifact(artifact)
        self._run.finish()

    def leave(self) -> None:
        """Close a run that stopped before its end: a process may go on to other runs."""
        self._run.finish(exit_code=1)


def open_dashboard(folder: Path, settings: Mapping[str, Any], run: RunConfig) -> Dashboard | None:
    """The run's dashboard; None where W&B is not ``wanted``. Arguments as of ``Dashboard``."""
    if not wanted(run):
        return None
    mode = os.environ.get("WANDB_MODE") or ("online" if logged_in() else "offline")
    return Dashboard(folder, settings, run, mode)


def wanted(run: RunConfig) -> bool:
    """Whether a run is logged to W&B: not with ``run.wandb=false``, nor with ``WANDB_MODE=disabled``.

    Raises:
        ImportError: if it is, and ``wandb`` is not installed.
    """
    if not run.wandb or os.environ.get("WANDB_MODE") == "disabled":
        return False
    import_wandb()
    return True


def import_wandb() -> ModuleType:
    """The module ``wandb``.

    Raises:
        ImportError: if it is not installed; says how to do without.
    """
    try:
        import wandb
    except ImportError as error:
        raise ImportError(
            "run.wandb=true needs wandb: pip install 'nht[recipes]', or set run.wandb=false."
        ) from error
    return wandb


def logged_in() -> bool:
    """Whether there is a key for the W&B server: in the environment, or from ``wandb login``."""
    if os.environ.get("WANDB_API_KEY"):
        return True
    host = urlsplit(os.environ.get("WANDB_BASE_URL") or SERVER).hostname
    file = os.environ.get("NETRC") or str(Path("~/.netrc").expanduser())
    try:
        return host in netrc(file).hosts  # an entry for any host is none for this one
    except (OSError, NetrcParseError):
        return False
