"""The paper's central experiment: hyperparameters drawn at random, trained with every interface, on Ray.

python -m nht.recipes.search search=wam search.configs=128 search.seeds=5
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from nht.recipes.config import Search
from nht.recipes.data.recording import record_expert
from nht.recipes.launch import launch
from nht.recipes.progress_bar import progress_bar, show_beside
from nht.recipes.run.ownership import claimed
from nht.recipes.study.ended_runs import EndedRuns, known_rows, together, write_rows
from nht.recipes.study.jobs import Ending, Job, rows_of, run_job
from nht.recipes.study.packs import Pack, in_packs, run_pack
from nht.recipes.study.plan import best_jobs, check_interfaces, check_settings, search_jobs, task_env
from nht.recipes.study.report import search_summary
from nht.recipes.study.results import SearchResults
from nht.recipes.study.space import write_search_manifest

if TYPE_CHECKING:
    from nht.recipes.study.cluster import Cluster

POLL = 5.0
"""Seconds between two checks of runs that other processes work on."""


def main(config: Search) -> None:
    """Draw configurations, do the runs that are missing, run the best again on fresh seeds, and print a summary."""
    search, folder = config.search, Path(config.folder).resolve()
    check_interfaces(search)
    demos = Path(config.demos.path or folder / "demos").resolve()
    jobs = search_jobs(search, demos)
    check_settings(jobs, folder)
    in_packs(jobs, search.learners)  # whether the algorithm trains several
    from nht.recipes.study.cluster import Cluster  # Ray is an extra of its own

    settings = asdict(search) | {"demos": asdict(config.demos)}
    del settings["learners"]  # decides nothing but the cost
    write_search_manifest(folder / "manifest.json", settings)
    with closing(Cluster(config.ray_address, config.num_workers, config.tasks_per_gpu)) as cluster:
        if config.demos.path is None:
            record_demos(config, folder, demos)
        ended = known_rows(folder, config.retry_failed)
        run_all(jobs, folder, cluster, ended, search.learners)
        if search.best_seeds:
            run_all(best_jobs(search, demos, ended), folder, cluster, ended, search.learners)
    print(search_summary(SearchResults.of(together(ended))).to_string(index=False))
    print(f"\n{folder}: manifest.json, rows.csv; figures: python -m nht.recipes.report {config.folder}")


def record_demos(config: Search, folder: Path, demos: Path) -> None:
    """Record the expert's demonstrations, which all runs share; one of several processes does it, the others wait."""
    while not demos.exists():
        with claimed(folder / "claims" / "demos") as ours:
            if ours and not demos.exists():
                record_expert(task_env(config.search), config.demos, config.search.seed, demos)
        time.sleep(0 if demos.exists() else POLL)


def tasks_of(
    jobs: Sequence[Job], missing: Sequence[Job], learners: int, cluster: Cluster, folder: Path
) -> Iterator[Job | Pack]:
    """Do the missing runs, one by one or in packs, and yield each task once it is done."""
    if learners == 1:
        yield from cluster.run(run_job, missing, folder)
        return
    names = {job.name for job in missing}
    packs = [pack for pack in in_packs(jobs, learners) if any(job.name in names for job in pack.jobs)]
    yield from cluster.run(run_pack, packs, folder)


def run_all(jobs: Sequence[Job], folder: Path, cluster: Cluster, ended: EndedRuns, learners: int = 1) -> None:
    """Run those jobs of a stage that have not ended, and keep ``rows.csv`` up to date.

    Args:
        jobs: of one stage.
        folder: of the search.
        cluster: where they run.
        ended: rows of all runs that have ended; new ones are added.
        learners: how many train together, at most.
    """
    ended |= {
        job.name: rows_of(job, folder)
        for job in jobs
        if job.name not in ended and Ending.read(folder / job.name) is not None
    }
    for claim in (folder / "claims").glob("*"):
        with claimed(claim):
            pass  # what a killed process left is gone then; whoever is alive keeps his
    with progress(jobs, folder) as show:
        show(ended)
        while missing := [job for job in jobs if job.name not in ended]:
            for task in tasks_of(jobs, missing, learners, cluster, folder):
                for job in task.jobs:
                    if job.name in ended or Ending.read(folder / job.name) is None:
                        continue  # it was there, or another process is at it
                    ended[job.name] = rows_of(job, folder)
                    write_rows(folder, ended)
                show(ended)
            if any(job.name not in ended for job in jobs):
                time.sleep(POLL)
    write_rows(folder, ended)


@contextmanager
def progress(jobs: Sequence[Job], folder: Path) -> Iterator[Callable[[EndedRuns], None]]:
    """A progress bar over the runs of a stage."""
    stage = jobs[0].stage
    # The mean rate, not the latest: runs of one configuration end together, and configurations differ.
    with progress_bar(len(jobs), f"{folder.name}, {stage}", "run", smoothing=0) as bar:

        def show(ended: EndedRuns) -> None:
            own = [ended[job.name] for job in jobs if job.name in ended]
            failed = sum(rows["status"].iloc[0] != "done" for rows in own)
            running = len(list((folder / "claims").glob(f"{stage}-*")))
            if bar.n == 0:
                bar.initial = len(own)  # what was there says nothing about the rate
            bar.update(len(own) - bar.n)
            show_beside(bar, failed=failed, running=running)

        yield show


if __name__ == "__main__":
    launch(main, Search, "search")
