"""The paper's central experiment: hyperparameters drawn at random, trained with every interface, on Ray.

python -m nht.recipes.search search=wam search.configs=128 search.seeds=5
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import pandas

from nht.recipes.agents.table import find_algorithm
from nht.recipes.config import Search, SearchConfig
from nht.recipes.data.recording import record_expert
from nht.recipes.launch import configure, launch
from nht.recipes.maps.kinds import KINDS, MapKind, find_kind, tasks_with_arm
from nht.recipes.progress_bar import progress_bar, show_beside
from nht.recipes.run.metrics import FRAMES
from nht.recipes.run.ownership import claimed
from nht.recipes.study.jobs import Ending, Job, job_name, rows_of, run_job
from nht.recipes.study.packs import Pack, packed, run_pack
from nht.recipes.study.report import summary
from nht.recipes.study.results import SearchResults, read_results
from nht.recipes.study.rows_file import COLUMNS
from nht.recipes.study.space import draw, write_manifest
from nht.writing import replacing

if TYPE_CHECKING:
    from nht.recipes.study.cluster import Cluster

FRESH = 100
"""First seed of the runs of best configurations: the search's own count from 0."""

POLL = 5.0
"""Seconds between two looks at runs that other processes are at."""


def main(config: Search) -> None:
    """Draw, run what is not there yet, run the best again on fresh seeds, and say how it came out."""
    search, folder = config.search, Path(config.folder).resolve()
    check_interfaces(search)
    demos = Path(config.demos.path or folder / "demos").resolve()
    jobs = search_jobs(search, demos)
    check_settings(jobs, folder)
    packed(jobs, search.learners)  # whether the algorithm trains several
    from nht.recipes.study.cluster import Cluster  # Ray is an extra of its own

    settings = asdict(search) | {"demos": asdict(config.demos)}
    del settings["learners"]  # decides nothing but the cost
    write_manifest(folder / "manifest.json", settings)
    with closing(Cluster(config.ray_address, config.num_workers)) as cluster:
        if config.demos.path is None:
            record_demos(config, folder, demos)
        ended = known_rows(folder, config.retry_failed)
        run_all(jobs, folder, cluster, ended, search.learners)
        if search.best_seeds:
            run_all(best_jobs(search, demos, ended), folder, cluster, ended, search.learners)
    print(summary(SearchResults.of(together(ended))).to_string(index=False))
    print(f"\n{folder}: manifest.json, rows.csv; figures: python -m nht.recipes.report {config.folder}")


def check_interfaces(search: SearchConfig) -> None:
    """Raise ValueError for an interface that does not exist, or not on the job."""
    if not search.interfaces:
        raise ValueError(f"search.interfaces is empty: choose from {interfaces()}.")
    for interface in search.interfaces:
        if interface not in ("raw", *KINDS):
            raise ValueError(f"unknown search.interfaces {interface!r}: choose from {interfaces()}.")
        if kind_of(interface).needs_arm and search.env not in tasks_with_arm():
            raise ValueError(
                f"the interface {interface} needs an arm: {tasks_with_arm()} have one, {search.env!r} does not."
            )


def interfaces() -> list[str]:
    """What may be compared: every kind of map, and raw actuation, which is the kind ``none``."""
    return ["raw", *(name for name in KINDS if name != "none")]


def kind_of(interface: str) -> MapKind:
    """The kind of map that an interface is."""
    return find_kind("none" if interface == "raw" else interface)


def search_jobs(search: SearchConfig, demos: Path) -> list[Job]:
    """Every run of the search, those of all interfaces of one configuration and seed after each other."""
    return [
        make_job(search, demos, "search", interface, configuration, seed, search.total_frames)
        for configuration in range(search.configs)
        for seed in range(search.seeds)
        for interface in search.interfaces
    ]


def best_jobs(search: SearchConfig, demos: Path, ended: Rows) -> list[Job]:
    """The best configuration of each interface, on fresh seeds."""
    results = SearchResults.of(together(ended))
    best = {interface: results.best(interface)[0] for interface in search.interfaces}
    return [
        make_job(search, demos, "best", interface, configuration, FRESH + seed, search.best_frames)
        for seed in range(search.best_seeds)
        for interface, configuration in best.items()
    ]


def make_job(
    search: SearchConfig,
    demos: Path,
    stage: str,
    interface: str,
    configuration: int,
    seed: int,
    frames: int,
) -> Job:
    """One run: what a person would type."""
    parameters = draw(search.space, search.seed, configuration, interface)
    told = dict(parameters)
    if "map.hidden_layers" in told:
        told["map.hidden"] = str(int(told.pop("map.hidden_layers")) * [told.pop("map.hidden_units")])
    overrides = [f"env={search.env}", f"map={'none' if interface == 'raw' else interface}"]
    overrides += [] if kind_of(interface).fixed_width else [f"map.action_dim={search.action_dim}"]
    overrides += [f"demos.path={demos}", *search.base, *(f"{name}={value}" for name, value in told.items())]
    overrides += [f"seed={seed}", f"algo.total_frames={frames}"]
    overrides += [f"run.wandb_group={stage}-{configuration:03d}", f"run.wandb_job_type={interface}"]
    return Job(
        stage=stage,
        env=search.env,
        interface=interface,
        configuration=configuration,
        seed=seed,
        recipe=search.recipe,
        metric=search.metric,
        parameters=parameters,
        overrides=tuple(overrides),
    )


def check_settings(jobs: Sequence[Job], folder: Path) -> None:
    """Raise ValueError if a recipe does not take what it would be told, before anything is run."""
    for job in {job.interface: job for job in jobs}.values():
        schema = find_algorithm(job.recipe).schema
        configure(schema, job.recipe, [*job.overrides, f"run.folder={folder}"])


def record_demos(config: Search, folder: Path, demos: Path) -> None:
    """Let the expert give the demonstrations that all runs share; of several processes one does it, others wait."""
    while not demos.exists():
        with claimed(folder / "claims" / "demos") as ours:
            if ours and not demos.exists():
                record_expert(task_env(config.search), config.demos, config.search.seed, demos)
        time.sleep(0 if demos.exists() else POLL)


def task_env(search: SearchConfig) -> Any:
    """The configuration of the environment that all runs have."""
    schema = find_algorithm(search.recipe).schema
    return configure(schema, search.recipe, [f"env={search.env}", "map=none", *search.base]).env


def tasks_of(
    jobs: Sequence[Job], missing: Sequence[Job], learners: int, cluster: Cluster, folder: Path
) -> Iterator[Job | Pack]:
    """Have the missing runs done, one by one or in packs, and give each task back once it is."""
    if learners == 1:
        yield from cluster.run(run_job, missing, folder)
        return
    names = {job.name for job in missing}
    packs = [pack for pack in packed(jobs, learners) if any(job.name in names for job in pack.jobs)]
    yield from cluster.run(run_pack, packs, folder)


def run_all(jobs: Sequence[Job], folder: Path, cluster: Cluster, ended: Rows, learners: int = 1) -> None:
    """Run those jobs of a stage that have not ended, and keep ``rows.csv`` up to date.

    Args:
        jobs: of one stage.
        folder: of the search.
        cluster: where they run.
        ended: the rows of all runs that have, which grows.
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
def progress(jobs: Sequence[Job], folder: Path) -> Iterator[Callable[[Rows], None]]:
    """A bar over the runs of a stage."""
    stage = jobs[0].stage
    # The mean rate, not the latest: runs of one configuration end together, and configurations differ.
    with progress_bar(len(jobs), f"{folder.name}, {stage}", "run", smoothing=0) as bar:

        def show(ended: Rows) -> None:
            own = [ended[job.name] for job in jobs if job.name in ended]
            failed = sum(rows["status"].iloc[0] != "done" for rows in own)
            running = len(list((folder / "claims").glob(f"{stage}-*")))
            if bar.n == 0:
                bar.initial = len(own)  # what was there says nothing about the rate
            bar.update(len(own) - bar.n)
            show_beside(bar, failed=failed, running=running)

        yield show


Rows = dict[str, pandas.DataFrame]
"""The rows of runs that have ended, by the job's name."""


def known_rows(folder: Path, retry_failed: bool) -> Rows:
    """What ``rows.csv`` has: with the manifest it is all that another machine needs to go on.

    With ``retry_failed``, runs that did not get to their end are forgotten.
    """
    if not (folder / "rows.csv").exists():
        return {}
    found = read_results(folder / "rows.csv").rows
    known = {}
    for place, rows in found.groupby(["stage", "interface", "configuration", "seed"], sort=False):
        stage, interface, configuration, seed = cast(tuple[str, str, int, int], place)
        name = job_name(stage, interface, configuration, seed)
        if retry_failed and rows["status"].iloc[0] != "done":
            shutil.rmtree(folder / name, ignore_errors=True)
        else:
            known[name] = rows.dropna(axis="columns", how="all")
    return known


def together(ended: Rows) -> pandas.DataFrame:
    """All rows, in the order of stages, configurations and seeds, whichever ended first."""
    rows = pandas.concat(list(ended.values()), ignore_index=True)
    rows = rows.reindex(columns=[*COLUMNS, *sorted(set(rows.columns) - set(COLUMNS))])
    late = rows["stage"].eq("best").rename("late")
    order = rows.assign(late=late).sort_values(["late", "configuration", "seed", "interface", FRAMES]).index
    return rows.loc[order].reset_index(drop=True)


def write_rows(folder: Path, ended: Rows) -> None:
    """Replace ``rows.csv``, whole or not at all."""
    with replacing(folder / "rows.csv") as scratch:
        together(ended).to_csv(scratch, index=False)


if __name__ == "__main__":
    launch(main, Search, "search")
