"""Compare finished runs in a table and learning curves; or report a whole search in figures and a page.

python -m nht.recipes.report runs/demo
python -m nht.recipes.report runs/search-wam_wipe
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import pandas

from nht.recipes.config import Report
from nht.recipes.launch import launch
from nht.recipes.run.dashboard import shown_on_dashboard, wanted
from nht.recipes.run.metrics import SUCCESS
from nht.recipes.study.curves import groups, plot, read_runs, run_folders, summarise
from nht.recipes.study.dashboard_names import search_name
from nht.recipes.study.film import best_runs, film_runs
from nht.recipes.study.report import to_markdown, write_report


def main(config: Report) -> None:
    """Report a search if there is one in the folder, else the runs in and below it."""
    wanted(config.run)  # whether W&B is installed, if it is
    folder = Path(config.folder)
    if config.folder and (rows := folder / "rows.csv").exists():
        report_search(config, rows, Path(config.out or folder / "report"))
    else:
        report_runs(config)


def report_search(config: Report, rows: Path, out: Path) -> None:
    """Write the figures of a search and the page around them, and print its table."""
    table = write_report(rows, out, config.title)
    film_search(config, rows.parent, out)
    print(table.to_string(index=False))
    print(f"\n{out}: " + ", ".join(sorted(path.name for path in out.iterdir())))
    name = search_name(rows.parent) if config.run.wandb else ""
    show(config, out, {"interfaces": table}, name)


def film_search(config: Report, folder: Path, out: Path) -> None:
    """Film the best policy of each interface of a search whose runs are there, not only its rows."""
    runs = run_folders([folder])
    if config.video and runs:
        film(config, read_runs([folder]), runs, out / "best.mp4")


def report_runs(config: Report) -> None:
    """Read the runs; write ``curves.csv`` and, for each task and algorithm, table, curves of ``metric`` and a film.

    The files are called ``table.md``, ``success.png`` and ``best.mp4``, those of returns ``return-table.md`` and
    ``return.png``; the names begin with task and algorithm where there are several.

    Raises:
        ValueError: if no folder is named.
    """
    folders = [*config.runs, *([config.folder] if config.folder else [])]
    if not folders:
        raise ValueError("name a folder of runs or of a search: report DIR, or report runs=[DIR, DIR].")
    curves = read_runs([Path(folder) for folder in folders])
    runs = run_folders([Path(folder) for folder in folders])
    out = Path(config.out or Path(folders[0]) / "report")
    out.mkdir(parents=True, exist_ok=True)
    curves.drop(columns="run").to_csv(out / "curves.csv", index=False)
    written, tables = ["curves.csv"], {}
    found = list(groups(curves, config.lines))
    for name, group in found:
        start = f"{name}-" if len(found) > 1 else ""
        table = summarise(group, config.metric, config.lines)
        files = [
            f"{start}{'' if config.metric == SUCCESS else 'return-'}table.md",
            f"{start}{config.metric}.png",
        ]
        (out / files[0]).write_text(to_markdown(table))
        plot(group, config.metric, config.title or name.replace("-", ", "), out / files[1], config.lines)
        if config.video and film(config, group, runs, out / f"{start}best.mp4"):
            files.append(f"{start}best.mp4")
        tables[name] = table
        written += files
        print(f"{name}\n{table.to_string(index=False)}\n")
    print(f"{out}: " + ", ".join(written))
    show(config, out, tables, f"{Path(folders[0]).resolve().name}-report")


def film(config: Report, curves: pandas.DataFrame, runs: Sequence[Path], path: Path) -> bool:
    """Film the best policy of each line, and say whether there is a film; if it cannot be made, say why."""
    best = best_runs(curves, runs, config.metric, config.lines)
    if not best:
        return False
    try:
        film_runs(best, path)
    except (RuntimeError, ValueError, OSError) as error:  # a report is made all the same
        print(f"no film: {error}")
        return False
    return True


def show(config: Report, out: Path, tables: dict[str, pandas.DataFrame], name: str) -> None:
    """Show tables, figures and film as one run on W&B, the same one each time that the report is made again."""
    settings = {"recipe": "report", **asdict(config)}
    with shown_on_dashboard(out, settings, config.run, name=name) as dashboard:
        if dashboard is None:
            return
        for title, table in tables.items():
            dashboard.table(f"tables/{title}", table)
        for figure in sorted(out.glob("*.png")):
            if not figure.with_suffix(".mp4").exists():
                dashboard.picture(f"figures/{figure.stem}", figure)
        for video in sorted(out.glob("*.mp4")):
            dashboard.video(f"films/{video.stem}", video)


if __name__ == "__main__":
    launch(main, Report, "report", positional="folder")
