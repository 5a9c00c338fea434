"""Compare finished runs in a table and learning curves; or report a whole search in figures and a page.

python -m nht.recipes.report runs/demo
python -m nht.recipes.report runs/search-wam_wipe
"""

from __future__ import annotations

from pathlib import Path

from nht.recipes.config import Report
from nht.recipes.launch import launch
from nht.recipes.run.metrics import SUCCESS
from nht.recipes.study.curves import groups, plot, read_runs, summarise
from nht.recipes.study.report import to_markdown, write_report


def main(config: Report) -> None:
    """Report a search if there is one in the folder, else the runs in and below it."""
    folder = Path(config.folder)
    if config.folder and (rows := folder / "rows.csv").exists():
        report_search(rows, Path(config.out or folder / "report"), config.title)
    else:
        report_runs(config)


def report_search(rows: Path, out: Path, title: str) -> None:
    """Write the figures of a search and the page around them, and print its table."""
    print(write_report(rows, out, title).to_string(index=False))
    print(f"\n{out}: " + ", ".join(sorted(path.name for path in out.iterdir())))


def report_runs(config: Report) -> None:
    """Read the runs; write ``curves.csv`` and, for each task and algorithm, a table and the curves of ``metric``.

    The files are called ``table.md`` and ``success.png``, those of returns ``return-table.md`` and ``return.png``; the
    names begin with task and algorithm where there are several.

    Raises:
        ValueError: if no folder is named.
    """
    folders = [*config.runs, *([config.folder] if config.folder else [])]
    if not folders:
        raise ValueError("name a folder of runs or of a search: report DIR, or report runs=[DIR, DIR].")
    curves = read_runs([Path(folder) for folder in folders])
    out = Path(config.out or Path(folders[0]) / "report")
    out.mkdir(parents=True, exist_ok=True)
    curves.to_csv(out / "curves.csv", index=False)
    written = ["curves.csv"]
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
        written += files
        print(f"{name}\n{table.to_string(index=False)}\n")
    print(f"{out}: " + ", ".join(written))


if __name__ == "__main__":
    launch(main, Report, "report", positional="folder")
