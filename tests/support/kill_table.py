"""What became of killed runs: a row for each kill, and the table of all.

Rows go to the file that the environment variable ``NHT_KILLS`` names, if it does.
``python tests/support/kill_table.py FILE...`` prints the table of such files.
"""

import contextlib
import csv
import os
import sys
from pathlib import Path

import pandas

COLUMNS = ("kind", "run", "victim", "seconds", "of", "there", "mended")
FILES = ("config.yaml", "map.safetensors", "policy.safetensors", "whole.json")  # in the order of their making


@contextlib.contextmanager
def noted(kind, number, length):
    """A list for kills, each ``(victim, seconds, what was there)``, that are written down with what became of them.

    Args:
        kind: of run that is killed.
        number: of the run.
        length: seconds that the draw of the times was over.
    """
    kills, mended = [], False
    try:
        yield kills
        mended = True
    finally:
        if file := os.environ.get("NHT_KILLS"):
            _write(Path(file), [(kind, number, who, at, length, there, mended) for who, at, there in kills])


def newest(folder):
    """The last of a run's files that there is in any folder beneath: how far it had come when it was killed."""
    return next((name for name in reversed(FILES) if any(folder.rglob(name))), "nothing")


def _write(file, rows):
    fresh = not file.exists()
    with file.open("a", newline="") as opened:
        writer = csv.writer(opened)
        if fresh:
            writer.writerow(COLUMNS)
        for kind, number, who, at, length, there, mended in rows:
            writer.writerow([kind, number, who, f"{at:.3f}", f"{length:.3f}", there, int(mended)])


def table(rows):
    """Markdown: kinds of run, kills of each, and how many were mended bit for bit."""
    lines = ["| what was killed | kills | mended bit for bit |", "|---|---|---|"]
    rows = rows.assign(what=rows["kind"] + ": " + rows["victim"])
    for what, kills in rows.groupby("what", sort=False):
        lines.append(f"| {what} | {len(kills)} | {kills['mended'].sum()} |")
    lines.append(f"| all | {len(rows)} | {rows['mended'].sum()} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table(pandas.concat([pandas.read_csv(file) for file in sys.argv[1:]])))
