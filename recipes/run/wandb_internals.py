"""Private parts of W&B, in this module alone: ``tests/recipes/run/test_wandb_internals.py`` says what they must do."""

from __future__ import annotations

from typing import Any


def use_offline(run: Any, artifact: Any) -> None:
    """Note that an offline run takes an artifact: its contents go into the run's file, to be found again on the server.

    ``Run.use_artifact`` refuses offline, as it asks the server. What it does for a new artifact, though, is to log it
    with ``use_after_commit``; the record of that can wait for ``wandb sync``. Contents that the server knows under that
    name become no new version, so that the run is tied to the one that another run has logged.

    Relies on ``Run._log_artifact`` and its arguments ``is_user_created`` and ``use_after_commit``.

    Args:
        run: offline.
        artifact: a new ``wandb.Artifact`` with all its files.
    """
    run._log_artifact(artifact, is_user_created=True, use_after_commit=True)
