"""The view of W&B: every metric that it shows is one that runs report, and it can be built without a server."""

import sys

import pytest

import tiny_runs
import wandb_file
from nht.recipes import workspace
from nht.recipes.config import Workspace
from nht.recipes.launch import configure

TINY = ["algo.total_frames=400", "evaluation.every=200", "run.wandb=true"]


def shown():
    return {metric for panels in workspace.layout().values() for panel in panels for metric in panel.metrics}


def test_what_is_shown_is_what_some_run_reports(tmp_path):
    reported = set()
    for algorithm in ("ddpg", "ppo", "sac"):
        tiny_runs.start(algorithm, tmp_path / algorithm, *TINY)
        found = wandb_file.read_run(tmp_path / algorithm)
        reported |= {name for row in found.rows for name in row}
    assert {name for name in shown() if not name.startswith("map/")} - reported == set()
    assert {"train/loss_value", "train/loss_qvalue", "train/value", "train/gradient_norm"} <= reported
    assert {panel.axis for panel in workspace.layout()["Maps"]} == {"map_steps"}


def test_the_view_is_built_without_a_server():
    pytest.importorskip("wandb_workspaces")
    view = workspace.build(configure(Workspace, "workspace", ["entity=somebody", "group_by=Group"]))
    assert (view.entity, view.project) == ("somebody", "nht")
    assert [section.name for section in view.sections] == [*workspace.layout(), "Films"]
    panels = [panel for section in view.sections[:-1] for panel in section.panels]
    assert {metric for panel in panels for metric in panel.y} == shown()
    assert {panel.x for panel in panels} == {"env_steps", "map_steps"}


def test_somebody_must_be_named():
    with pytest.raises(ValueError, match="entity must be your name or your team's"):
        workspace.main(configure(Workspace, "workspace"))


def test_without_its_package_it_says_which(monkeypatch):
    for module in ("wandb_workspaces", "wandb_workspaces.reports.v2", "wandb_workspaces.workspaces"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"pip install 'nht\[workspace\]'"):
        workspace.build(Workspace(entity="somebody"))
