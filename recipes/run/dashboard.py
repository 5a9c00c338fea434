"""A run on Weights and Biases: offline unless the user has logged in, and never needed for a run to work."""

from __future__ import annotations

import os
from dataclasses import asdict
from netrc import NetrcParseError, netrc
from pathlib import Path
from urllib.parse import urlsplit

import wandb

from nht.recipes.run.metrics import FRAMES
from nht.recipes.sections import Training

SERVER = "https://api.wandb.ai"
"""W&B's own, unless ``WANDB_BASE_URL`` names another."""


class Dashboard:
    """One run on W&B, whose files are in the run's folder.

    Args:
        folder: of the run.
        config: its whole configuration; every key of it is found again in W&B.
        mode: ``online``, ``offline`` or ``shared``.
    """

    def __init__(self, folder: Path, config: Training, mode: str) -> None:
        os.environ.setdefault("WANDB_SILENT", "true")
        if not os.environ.get("WANDB_API_KEY", "-"):
            del os.environ["WANDB_API_KEY"]  # empty, as compose files leave it: W&B would refuse to start
        self._folder = folder
        self._run = wandb.init(
            name=folder.name,
            dir=str(folder),
            project=config.run.wandb_project,
            group=config.run.wandb_group,
            job_type=config.run.wandb_job_type,
            config=asdict(config),
            mode=mode,  # type: ignore[arg-type]
        )

    def log(self, frames: int, row: dict[str, float]) -> None:
        """A row of metrics, against environment steps."""
        self._run.log(row | {FRAMES: frames}, step=frames)

    def finish(self, map_file: Path, video: Path) -> None:
        """Hand over the map, and the video if there is one."""
        if video.exists():
            self._run.log({"video": wandb.Video(str(video), format="mp4")})
        artifact = wandb.Artifact(f"map-{self._folder.name}", type="action-map")
        artifact.add_file(str(map_file))
        self._run.log_artifact(artifact)
        self._run.finish()


def open_dashboard(folder: Path, config: Training) -> Dashboard | None:
    """The run's dashboard; None where W&B is not wanted: ``run.wandb=false``, or ``WANDB_MODE=disabled``."""
    mode = os.environ.get("WANDB_MODE") or ("online" if logged_in() else "offline")
    if not config.run.wandb or mode == "disabled":
        return None
    return Dashboard(folder, config, mode)


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
