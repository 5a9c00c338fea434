"""Rows of ``metrics.csv``: a file of an earlier version keeps its columns; names on the dashboard."""

import pytest

from nht.recipes.run.metrics import chart_row, charted
from nht.recipes.run.metrics_file import append_row, metrics_table


def test_rows_are_found_again(tmp_path):
    file = tmp_path / "metrics.csv"
    rows = [{"frames": step, "loss": 0.1 * step, "seconds": 1.0} for step in (1, 2, 3)]
    for row in rows:
        append_row(file, row)
    assert metrics_table(file).to_dict("records") == rows


def test_an_earlier_versions_file_goes_on_in_its_columns(tmp_path):
    file = tmp_path / "metrics.csv"
    file.write_text("frames,gone,loss,seconds\n1,7,0.5,1.0\n")
    append_row(file, {"frames": 2, "new": 9.0, "loss": 0.25, "seconds": 2.0})
    table = metrics_table(file)
    assert list(table) == ["frames", "gone", "loss", "seconds"]
    assert table["loss"].tolist() == [0.5, 0.25]
    assert table["gone"].isna().tolist() == [False, True]


@pytest.mark.parametrize(
    ("column", "name"),
    [
        ("frames", "env_steps"),
        ("eval_success", "eval/success"),
        ("train_return", "train/return"),
        ("loss_actor", "train/loss_actor"),
        ("gradient_norm_critic", "train/gradient_norm_critic"),
        ("updates", "train/updates"),
        ("seconds", "time/seconds"),
        ("frames_per_second", "time/frames_per_second"),
    ],
)
def test_columns_have_sections_on_the_dashboard(column, name):
    assert charted(column) == name


def test_what_is_not_a_number_is_not_charted():
    assert chart_row({"frames": 3, "train_success": float("nan"), "clipped": 0.5}) == {
        "env_steps": 3,
        "train/clipped": 0.5,
    }
