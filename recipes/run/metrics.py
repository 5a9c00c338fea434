"""The names of metrics: columns of ``metrics.csv``, and what they are called in W&B. They are spelled nowhere else."""

from __future__ import annotations

import math
from collections.abc import Mapping

FRAMES, UPDATES, SECONDS = "frames", "updates", "seconds"
SUCCESS, FAILURE, RETURN, LENGTH = "success", "failure", "return", "length"
EPISODE_OUTCOMES = (SUCCESS, FAILURE, RETURN)
"""The outcomes of an episode."""
DIVERGED, CLIPPED = "diverged", "clipped"
DEMOS_CLIPPED, DEMOS_MISSED = "demos_clipped", "demos_missed"
"""Of demonstrations in replay: the share of the actions' numbers that are clipped, and of energy that they miss."""
VALUE = "value"
"""The mean of what the critics learn to predict, a sample of the updates."""
GRADIENT_NORM = "gradient_norm"
"""The root mean square of the gradient's length over about the last thousand updates."""
FRAMES_PER_SECOND, UPDATES_PER_SECOND = "frames_per_second", "updates_per_second"


def tested(outcome: str) -> str:
    """The column of an outcome's mean over the test episodes."""
    return f"eval_{outcome}"


def trained(outcome: str) -> str:
    """The column of an outcome's mean over the episodes of training that ended since the last row."""
    return f"train_{outcome}"


def gradient_norm(network: str = "") -> str:
    """The column of the gradient's length, of one network where several are trained apart."""
    return f"{GRADIENT_NORM}_{network}" if network else GRADIENT_NORM


TESTED = tuple(map(tested, EPISODE_OUTCOMES))
EVERY_RUN = (FRAMES, *TESTED, SECONDS)
"""Columns that every run has, whatever the algorithm."""

ENV_STEPS = "env_steps"
"""The axis of all charts in W&B: environment steps."""
MAP_STEPS = "map_steps"
"""The axis of charts of a map's training: gradient steps."""
IN_TIME = (SECONDS, FRAMES_PER_SECOND, UPDATES_PER_SECOND)
SECTIONS = {"eval": "eval_", "train": "train_"}
"""Sections of charts in W&B, and the beginnings of the columns that belong there."""
BEST = {SUCCESS: "max", RETURN: "max", FAILURE: "min"}
"""Which of a run's tests is the best by an outcome."""


def charted(column: str) -> str:
    """The name of a column in W&B: ``eval/success``, ``train/loss_value``, ``time/seconds``."""
    if column == FRAMES:
        return ENV_STEPS
    for section, start in SECTIONS.items():
        if column.startswith(start):
            return f"{section}/{column.removeprefix(start)}"
    return f"time/{column}" if column in IN_TIME else f"train/{column}"


def chart_row(row: Mapping[str, float]) -> dict[str, float]:
    """A row of metrics as W&B gets it; what is not a number, for lack of an episode or update, is left out."""
    return {charted(name): value for name, value in row.items() if not math.isnan(value)}


def check_outcome(name: str, given: str) -> None:
    """Raise ValueError unless runs can be compared by the outcome.

    Args:
        name: of the setting.
        given: its value.
    """
    if given not in (SUCCESS, RETURN):
        raise ValueError(f"{name} must be {SUCCESS} or {RETURN}, got {given!r}.")
