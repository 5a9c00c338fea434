"""The film of a report: the best policy of each interface, side by side."""

import imageio.v3 as iio
import numpy as np
import pandas
import pytest

import tiny_runs
import wandb_file
from nht.recipes import report
from nht.recipes.config import Report
from nht.recipes.launch import configure
from nht.recipes.run.video import SHEET_COLUMNS, TILE, State
from nht.recipes.study import film
from nht.recipes.study.curves import read_runs, run_folders

TINY = ["algo.total_frames=200", "evaluation.every=100", "env.options.max_episode_steps=5"]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    for name, told in {
        "raw-0": ["seed=0"],
        "raw-1": ["seed=1"],
        "svd": ["map=svd", "demos.transitions=500", "map.max_steps=10"],
    }.items():
        tiny_runs.start("ddpg", folder / name, *TINY, *told)
    tiny_runs.start("ddpg", folder / "unfinished", *TINY)
    (folder / "unfinished" / "policy.safetensors").unlink()
    return folder


def test_the_best_finished_run_of_each_interface_is_filmed(runs):
    curves, folders = read_runs([runs]), run_folders([runs])
    numbers = {folder.name: number for number, folder in enumerate(folders)}
    curves.loc[curves["run"] == numbers["raw-1"], "eval_return"] = 5.0
    curves.loc[curves["run"] == numbers["unfinished"], "eval_return"] = 9.0
    found = film.best_runs(curves, folders, "return", "interface")
    assert {name: folder.name for name, folder in found.items()} == {"raw": "raw-1", "svd": "svd"}


class Shot:
    def __init__(self, length, grey):
        self.frames = [[np.full((4, 4, 3), grey + moment, dtype=np.uint8)] for moment in range(length)]
        self.states = [[State(float(moment))] for moment in range(length)]


def test_a_shorter_film_stands_still_at_its_end():
    frames, states = film.side_by_side([Shot(3, 0), Shot(5, 100)])
    assert [[int(tile[0, 0, 0]) for tile in tiles] for tiles in frames] == [
        [0, 100],
        [1, 101],
        [2, 102],
        [2, 103],
        [2, 104],
    ]
    assert [state.seconds for state in states[-1]] == [2.0, 4.0]


@pytest.mark.usefixtures("can_render")
def test_a_report_has_curves_table_and_film_on_the_dashboard_too(runs, tmp_path):
    out = tmp_path / "report"
    told = [f"runs=[{runs}]", f"out={out}", "metric=return"]
    report.main(configure(Report, "report", told))
    width, height = TILE
    assert iio.imread(out / "best.mp4").shape[1:] == (height, 2 * width, 3)
    assert iio.imread(out / "best.png").shape == (height, SHEET_COLUMNS * width // 2, 3)
    assert {"return.png", "return.pdf", "return-table.md", "curves.csv"} <= {p.name for p in out.iterdir()}
    assert "run" not in pandas.read_csv(out / "curves.csv")
    first = wandb_file.read_run(out)
    logged = {name for row in first.rows for name in row if not name.startswith("_")}
    assert {"tables/wam_wipe-ddpg", "figures/return", "films/best"} <= logged
    assert first.run.job_type == "report"
    report.main(configure(Report, "report", [*told, "video=false"]))  # again: the same run
    again = [wandb_file.OfflineRun(file).run.run_id for file in wandb_file.files(out)]
    assert again == 2 * [first.run.run_id]


def test_what_cannot_be_filmed_is_said_and_the_report_is_made(runs, tmp_path, monkeypatch, capsys):
    def refuse(*_):
        raise RuntimeError("offscreen rendering needs OpenGL: install EGL.")

    monkeypatch.setattr(film, "_film_run", refuse)
    out = tmp_path / "report"
    report.main(configure(Report, "report", [f"runs=[{runs}]", f"out={out}", "run.wandb=false"]))
    assert "no film: offscreen rendering needs OpenGL" in capsys.readouterr().out
    assert (out / "success.png").exists()
    assert not (out / "best.mp4").exists()
