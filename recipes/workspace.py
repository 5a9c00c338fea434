"""Lay out the charts of training runs on W&B: a saved view of a project, with a section for each thing to look at.

python -m nht.recipes.workspace entity=my-team project=nht
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

from nht.recipes.config import Workspace
from nht.recipes.launch import launch
from nht.recipes.run.dashboard import FILM
from nht.recipes.run.metrics import (
    CLIPPED,
    DIVERGED,
    ENV_STEPS,
    FAILURE,
    FRAMES_PER_SECOND,
    LENGTH,
    MAP_STEPS,
    RETURN,
    SECONDS,
    SUCCESS,
    UPDATES_PER_SECOND,
    VALUE,
    charted,
    gradient_norm,
    tested,
    trained,
)


@dataclass(frozen=True)
class Panel:
    """A chart of metrics against an axis.

    Attributes:
        title: of the chart.
        metrics: by their names on W&B.
        axis: of the chart.
    """

    title: str
    metrics: tuple[str, ...]
    axis: str = ENV_STEPS


def layout() -> dict[str, list[Panel]]:
    """The sections of the view, and their panels; runs without a metric leave its panel empty."""
    losses = ("loss_actor", "loss_value", "loss_qvalue", "loss_objective", "loss_critic")
    norms = [gradient_norm(network) for network in ("actor", "critic", "")]
    return {
        "Tests": [Panel(outcome, (charted(tested(outcome)),)) for outcome in (SUCCESS, RETURN, FAILURE)],
        "Training": [
            Panel(f"{outcome} while training", (charted(trained(outcome)),))
            for outcome in (SUCCESS, FAILURE, RETURN, LENGTH)
        ]
        + [Panel("share of steps with a motor at its limit", (charted(CLIPPED),))]
        + [Panel("copies that diverged", (charted(DIVERGED),))],
        "Learning": [Panel(name.replace("_", " "), (charted(name),)) for name in losses]
        + [Panel("what the critics learn to predict", (charted(VALUE),))]
        + [Panel("length of the gradient", tuple(map(charted, norms)))],
        "Speed": [
            Panel("environment steps a second", (charted(FRAMES_PER_SECOND),)),
            Panel("updates a second", (charted(UPDATES_PER_SECOND),)),
            Panel("seconds", (charted(SECONDS),)),
        ],
        "Maps": [
            Panel("held-out error", ("map/validation_error",), MAP_STEPS),
            Panel("training error", ("map/training_error",), MAP_STEPS),
        ],
    }


def main(config: Workspace) -> None:
    """Save the view, and print where it is."""
    view = build(config)
    view.save()
    print(view.url)


def build(config: Workspace) -> Any:
    """The view, unsaved.

    Raises:
        ImportError: if ``wandb-workspaces`` is not installed.
        ValueError: if nobody is named whose project it is.
    """
    if not config.entity:
        raise ValueError("entity must be your name or your team's on W&B: entity=my-team.")
    try:
        reports: Any = import_module("wandb_workspaces.reports.v2")
        workspaces: Any = import_module("wandb_workspaces.workspaces")
    except ImportError as error:
        raise ImportError(
            "laying out a view needs wandb-workspaces: pip install 'nht[workspace]'."
        ) from error
    sections = [
        workspaces.Section(
            name=title,
            panels=[
                reports.LinePlot(
                    title=panel.title, x=panel.axis, y=list(panel.metrics), groupby=config.group_by
                )
                for panel in panels
            ],
            is_open=title in ("Tests", "Training"),
        )
        for title, panels in layout().items()
    ]
    films = workspaces.Section(name="Films", panels=[reports.MediaBrowser(media_keys=[FILM])])
    return workspaces.Workspace(
        entity=config.entity, project=config.project, name=config.name, sections=[*sections, films]
    )


if __name__ == "__main__":
    launch(main, Workspace, "workspace")
