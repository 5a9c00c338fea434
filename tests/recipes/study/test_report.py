"""The report of a search, from made-up rows."""

import numpy as np
import pandas
import pytest

import toy_search
import wandb_file
from nht.recipes import report
from nht.recipes.config import Report
from nht.recipes.launch import configure
from nht.recipes.study.dashboard_names import search_name
from nht.recipes.study.report import failures, search_summary
from nht.recipes.study.results import SearchResults, final_scores, read_results

FIGURES = ("violins", "curves", "profile", "budget", "correlations")


def write(folder, rows):
    folder.mkdir(parents=True, exist_ok=True)
    rows.to_csv(folder / "rows.csv", index=False)
    return folder


@pytest.mark.parametrize("metric", ["success", "return"])
def test_the_same_rows_give_the_same_report(tmp_path, metric, capsys):
    folder = write(tmp_path / "search", toy_search.rows(metric=metric))
    for out in ("first", "again"):
        report.main(
            configure(Report, "report", ["run.wandb=false", f"folder={folder}", f"out={tmp_path / out}"])
        )
    assert "nht" in capsys.readouterr().out
    first, again = (sorted((tmp_path / out).iterdir()) for out in ("first", "again"))
    wanted = {f"{name}.{kind}" for name in FIGURES for kind in ("png", "pdf", "svg")} | {
        "report.md",
        "report.html",
    }
    assert {path.name for path in first} == wanted
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in again]
    text = (tmp_path / "first" / "report.md").read_text()
    assert "8 configurations x 3 seeds of 200,000 steps for each of 6 interfaces, 144 runs" in text
    assert "5 fresh seeds" in text
    assert all(f"]({name}.png)" in text for name in FIGURES)
    page = (tmp_path / "first" / "report.html").read_text()
    assert page.count("data:image/svg+xml;base64,") == len(FIGURES)


def test_a_search_is_one_summary_run_that_has_its_tables_and_figures(tmp_path):
    folder = write(tmp_path / "search", toy_search.rows(4, 2))
    report.main(configure(Report, "report", [f"folder={folder}"]))
    found = wandb_file.read_run(folder / "report")
    assert found.run.display_name == search_name(folder)
    logged = {name for row in found.rows for name in row}
    assert {"tables/interfaces", *(f"figures/{name}" for name in FIGURES)} <= logged


def test_the_table_tells_the_interfaces_apart():
    rows = toy_search.rows()
    table = search_summary(SearchResults.of(rows)).set_index("interface")
    assert list(table.index) == ["nht", "raw", "laser", "svd", "scl", "jacobian"]
    assert table.loc["raw", "P(nht better)"].startswith("1.00")
    assert table.loc["nht", "P(nht better)"] == "-"
    best = rows[(rows["stage"] == "best") & (rows["interface"] == "nht") & (rows["frames"] == 200_000)]
    assert table.loc["nht", "its score"].startswith(f"{best['eval_success'].mean():.3f}")
    assert table.loc["nht", "best configuration"] == best["configuration"].iloc[0]


def test_failed_runs_count_as_the_worst_there_is():
    rows = toy_search.rows()
    runs = final_scores(rows, "success")
    failed = runs[runs["status"] != "done"]
    assert failed[["interface", "configuration", "seed", "score"]].to_numpy().tolist() == [["scl", 2, 1, 0.0]]
    returns = final_scores(rows, "return")
    assert returns.loc[returns["status"] != "done", "score"].item() == returns["eval_return"].min()
    table = failures(SearchResults.of(rows)).set_index("interface")
    assert table.loc["scl", "diverged"] == "3.4%"
    assert table.loc["scl", "commonest reason"] == "FloatingPointError: loss_value is nan (1)"
    assert table.loc["nht", "commonest reason"] == "-"


def test_correlations_by_interface():
    rows = toy_search.rows()
    table = SearchResults.of(rows).correlations()
    assert table.loc["algo.gamma", "nht"] > 0.9  # the score was made from it
    assert np.isnan(table.loc["map.learning_rate", "raw"])


def test_how_well_a_map_fits_is_seen_beside_what_was_drawn():
    rows = toy_search.rows()
    rows["map_error"] = (1 - rows["algo.gamma"]).where(rows["interface"] == "nht")
    table = SearchResults.of(rows).correlations()
    assert table.loc["map_error", "nht"] == pytest.approx(-table.loc["algo.gamma", "nht"])
    assert np.isnan(table.loc["map_error", "raw"])


@pytest.mark.parametrize("shape", [(1, 3), (3, 1), (1, 1)])
def test_one_configuration_or_one_seed_is_enough(tmp_path, shape):
    folder = write(tmp_path / "search", toy_search.rows(*shape, best_seeds=0))
    report.main(configure(Report, "report", ["run.wandb=false", f"folder={folder}"]))
    text = (folder / "report" / "report.md").read_text()
    assert "the very seeds that it was chosen by" in text


def test_bad_rows(tmp_path):
    rows = toy_search.rows(2, 1)
    for name, broken, message in [
        (
            "mixed",
            rows.assign(version=["0.0.1/1"] + [rows["version"][0]] * (len(rows) - 1)),
            r"versions \['0.0.1/1', ",
        ),
        ("lacking", rows.drop(columns=["seed", "reason"]), r"lacks the columns \['seed', 'reason'\]"),
        ("empty", rows[:0], "has no rows: the search has not finished a run yet"),
        ("unfit", rows.assign(map_error="close"), "map_error must be a finite number, or missing"),
    ]:
        folder = write(tmp_path / name, broken)
        with pytest.raises(ValueError, match=message):
            read_results(folder / "rows.csv")


def test_a_report_of_nothing(tmp_path):
    with pytest.raises(ValueError, match="name a folder of runs or of a search"):
        report.main(Report())
    with pytest.raises(FileNotFoundError, match=r"no metrics\.csv in or below"):
        report.main(Report(folder=str(tmp_path)))


def test_only_fresh_runs_of_the_configuration_that_is_best_now_count():
    rows = toy_search.rows()
    fresh = (rows["stage"] == "best") & (rows["interface"] == "nht")
    formerly = rows[fresh].assign(configuration=0, eval_success=0.0)
    before, after = (
        search_summary(SearchResults.of(found)).set_index("interface").loc["nht"]
        for found in (rows, pandas.concat([rows, formerly], ignore_index=True))
    )
    assert before["best configuration"] != 0
    assert (after["its score"], after["on"]) == (before["its score"], before["on"])


def test_interfaces_are_compared_over_the_configurations_that_both_have():
    rows = toy_search.rows(4, 2, best_seeds=0)
    ours, theirs = rows["interface"] == "nht", rows["interface"] == "svd"
    lacking = rows[~(ours & (rows["configuration"] == 0)) & ~(theirs & (rows["configuration"] == 3))]
    common = rows[~((ours | theirs) & rows["configuration"].isin([0, 3]))]
    found, expected = (
        search_summary(SearchResults.of(some)).set_index("interface").loc["svd", "P(nht better)"].split()[0]
        for some in (lacking, common)
    )
    assert found == expected


def test_growing_rows_of_a_search_that_still_runs():
    rows = toy_search.rows(4, 3, best_seeds=0)
    unfinished = rows[~((rows["configuration"] == 3) & (rows["seed"] == 2))]
    results = SearchResults.of(pandas.DataFrame(unfinished))
    assert results.scores("nht").shape == (3, 3)  # those that all seeds have
