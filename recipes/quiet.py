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


def quiet_storages() -> None:
    """Leave out of TorchRL's log, whatever its level, that a replay buffer got its storage: that is no news."""
    logger = logging.getLogger("torchrl")
    if not any(isinstance(known, _NoStorages) for known in logger.filters):
        logger.addFilter(_NoStorages())


class _NoStorages(logging.Filter):
    """Lets all records through but those of new storages."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is none of them."""
        return not record.getMessage().startswith("Initialized Lazy")
