"""The columns of ``metrics.csv``: their names are spelled here and nowhere else."""

from __future__ import annotations

FRAMES, UPDATES, SECONDS = "frames", "updates", "seconds"
SUCCESS, FAILURE, RETURN = "success", "failure", "return"
EPISODE_OUTCOMES = (SUCCESS, FAILURE, RETURN)
"""The outcomes of an episode."""
DIVERGED, CLIPPED = "diverged", "clipped"
DEMOS_CLIPPED, DEMOS_MISSED = "demos_clipped", "demos_missed"
"""Of demonstrations in replay: the share of the actions' numbers that are clipped, and of energy that they miss."""


def tested(outcome: str) -> str:
    """The column of an outcome's mean over the test episodes."""
    return f"eval_{outcome}"


def trained(outcome: str) -> str:
    """The column of an outcome's mean over the episodes of training that ended since the last row."""
    return f"train_{outcome}"


TESTED = tuple(map(tested, EPISODE_OUTCOMES))
EVERY_RUN = (FRAMES, *TESTED, SECONDS)
"""Columns that every run has, whatever the algorithm."""


def check_outcome(name: str, given: str) -> None:
    """Raise ValueError unless runs can be compared by the outcome.

    Args:
        name: of the setting.
        given: its value.
    """
    if given not in (SUCCESS, RETURN):
        raise ValueError(f"{name} must be {SUCCESS} or {RETURN}, got {given!r}.")
