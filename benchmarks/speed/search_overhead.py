"""What a search adds to its runs: Ray, start of workers, demonstrations, files.

A search of a few short runs on raw actuation, one at a time. Overhead is the wall time beyond what the runs report
themselves (``seconds`` of their last evaluation): that of the whole search, and that of each run after the first.
Prints the table and writes ``results/search_overhead/search_overhead.csv``.

    OMP_NUM_THREADS=1 python benchmarks/speed/search_overhead.py [seconds of a run of 200,000 steps]
"""

from __future__ import annotations

import csv
import os
import sys
import tempfile
import time
from pathlib import Path

import pandas
from taking_turns import commit

from nht.recipes.config import Search
from nht.recipes.launch import configure
from nht.recipes.search import main

RUNS, FRAMES = 6, 2_000
RUN_SECONDS = 560.0  # of 200,000 steps at the paper's settings, see run_cost.py


def benchmark(run_seconds: float) -> None:
    """One search; when each run ended says what each added."""
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "search"
        settings = [
            "search=smoke",
            "search.interfaces=[raw]",
            f"search.configs={RUNS}",
            "search.best_seeds=0",
        ]
        settings += [f"search.total_frames={FRAMES}", "num_workers=1", f"folder={folder}"]
        started, begun = time.time(), time.perf_counter()
        main(configure(Search, "search", settings))
        wall = time.perf_counter() - begun
        own = pandas.read_csv(folder / "rows.csv").groupby("configuration")["seconds"].max()
        ended = [
            (folder / "search" / "raw" / f"{number:03d}-seed0" / "outcome.json").stat().st_mtime
            for number in own.index
        ]
    first = ended[0] - started - own.iloc[0]
    later = [
        end - before - seconds for before, end, seconds in zip(ended, ended[1:], own.iloc[1:], strict=False)
    ]
    each = sum(later) / len(later)
    rows = [
        ["whole search over its runs", wall - own.sum(), "s"],
        ["until the first run: Ray, a worker's imports, demonstrations", first, "s"],
        ["each further run", each, "s"],
        [f"each further run, of {run_seconds:.0f} s", each / run_seconds, "share"],
        ["a first run on its worker, of that", first / run_seconds, "share"],
    ]
    out = Path(__file__).parents[1] / "results" / "search_overhead" / "search_overhead.csv"
    with out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["what", "value", "unit", "load", "commit"])
        for what, value, unit in rows:
            writer.writerow([what, f"{value:.4g}", unit, f"{os.getloadavg()[0]:.1f}", commit()])
            print(f"{what:>62}  {value:.4g} {unit}")


if __name__ == "__main__":
    benchmark(float(sys.argv[1]) if len(sys.argv) > 1 else RUN_SECONDS)
