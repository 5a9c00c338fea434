"""Silences messages of libraries that are for their developers, not for the users of recipes."""

from __future__ import annotations

import logging
import os
import warnings

LEVEL = "RL_LOGGING_LEVEL"
"""The environment variable with TorchRL's log level; a value that the user has set stays."""


def quiet_libraries() -> None:
    """Silence TorchRL's reports of new storages, and its warning about target networks that we update ourselves.

    Worker processes that start later inherit both.
    """
    if LEVEL not in os.environ:
        os.environ[LEVEL] = "WARNING"
        logging.getLogger("torchrl").setLevel(logging.WARNING)
    warnings.filterwarnings("ignore", message="No target network updater has been associated")
