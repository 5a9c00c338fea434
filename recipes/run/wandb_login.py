"""Whether a run is to be written to Weights & Biases, and as whom."""

from __future__ import annotations

import os
from netrc import NetrcParseError, netrc
from pathlib import Path
from types import ModuleType
from urllib.parse import urlsplit

from nht.recipes.sections import ChartsConfig

SERVER = "https://api.wandb.ai"
"""W&B's own server, unless ``WANDB_BASE_URL`` names another."""


def wanted(charts: ChartsConfig) -> bool:
    """Whether something is written to W&B: not with ``run.wandb=false``, nor with ``WANDB_MODE=disabled``.

    Raises:
        ImportError: if it is, and ``wandb`` is not installed.
    """
    if not charts.wandb or os.environ.get("WANDB_MODE") == "disabled":
        return False
    import_wandb()
    return True


def chosen_mode() -> str:
    """What ``WANDB_MODE`` says; or else online for those who have logged in, and offline for others."""
    return os.environ.get("WANDB_MODE") or ("online" if logged_in() else "offline")


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
