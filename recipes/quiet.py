"""What libraries tell their own developers does not reach the user of a recipe."""

from __future__ import annotations

import logging
import os
import warnings

LEVEL = "RL_LOGGING_LEVEL"
"""The variable by which TorchRL takes the level of its log; one that the user has set stays."""


def quiet_libraries() -> None:
    """Leave out TorchRL's reports of storages it has made, and its warning of targets that we move ourselves.

    Worker processes that start later inherit both.
    """
    if LEVEL not in os.environ:
        os.environ[LEVEL] = "WARNING"
        logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message="No target network updater has been associated")
