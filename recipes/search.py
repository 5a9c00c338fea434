"""The paper's central experiment: hyperparameters drawn at random, trained with every interface, on Ray.

python -m nht.recipes.search search=wam search.configs=128 search.seeds=5
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import pandas
from tqdm import tqdm

from nht.recipes.config import Search, SearchConfig
from nht.recipes.data.recording import record_expert
from nht.recipes.launch import configure, launch
from nht.recipes.study.cluster import Cluster
from nht.recipes.study.jobs import (
    RECIPES,
    Outcome,
    Task,
    claimed,
    rows_of,
    run_task,
    task_name,
)
from nht.recipes.study.report import summary
from nht.recipes.study.results import COLUMNS, SearchResults, read_results
from nht.recipes.study.space import draw, write_manifest
from nht.recipes.train_map import ARMS, KINDS
from nht.storage import replacing

FRESH = 100
"""First seed of the runs of best configurations: the search's own count from 0."""

POLL = 5.0
"""Seconds between two looks at runs that other processes are at."""


def main(config: Search) -> None:
    """Draw, run what is not there yet, run the best again on fresh seeds, and say how it came out."""
    search, folder = config.search, Path(config.folder).resolve()
    check_interfaces(search)
    demos = Path(config.demos.path or folder / "demos").resolve()
    tasks = search_tasks(search, demos)
    check_settings(tasks, folder)
    write_manifest(folder / "manifest.json", asdict(search) | {"demos": asdict(config.demos)})
    with closing(Cluster(config.ray_address, config.num_workers)) as cluster:
        if config.demos.path is None:
            record_demos(config, folder, demos)
        ended = known_rows(folder, config.retry_failed)
        run_all(tasks, folder, cluster, ended)
        if search.best_seeds:
            run_all(best_tasks(search, demos, ended), folder, cluster, ended)
    print(summary(SearchResults.of(together(ended))).to_string(index=False))
    print(f"\n{folder}: manifest.json, rows.csv; figures: python -m nht.recipes.report {config.folder}")


def check_interfaces(search: SearchConfig) -> None:
    """Raise ValueError for an interface that does not exist, or not on the task."""
    known = ["raw", *sorted(KINDS.keys() - {"none"})]
    if unknown := [name for name in search.interfaces if name not in known]:
        raise ValueError(f"unknown search.interfaces {unknown}: choose from {known}.")
    if not search.interfaces:
        raise ValueError(f"search.interfaces is empty: choose from {known}.")
    if "jacobian" in search.interfaces and search.env not in ARMS:
        raise ValueError(
            f"the interface jacobian needs an arm: {sorted(ARMS)} have one, {search.env!r} does not."
        )


def search_tasks(search: SearchConfig, demos: Path) -> list[Task]:
    """Every run of the search, those of all interfaces of one configuration and seed after each other."""
    return [
        make_task(search, demos, "search", interface, configuration, seed, search.total_frames)
        for configuration in range(search.configs)
        for seed in range(search.seeds)
        for interface in search.interfaces
    ]


def best_tasks(search: SearchConfig, demos: Path, ended: Rows) -> list[Task]:
    """The best configuration of each interface, on fresh seeds."""
    results = SearchResults.of(together(ended))
    best = {interface: results.best(interface)[0] for interface in search.interfaces}
    return [
        make_task(search, demos, "best", interface, configuration, FRESH + seed, search.best_frames)
        for seed in range(search.best_seeds)
        for interface, configuration in best.items()
    ]


def make_task(
    search: SearchConfig,
    demos: Path,
    stage: str,
    interface: str,
    configuration: int,
    seed: int,
    frames: int,
) -> Task:
    """One run: what a person would type."""
    parameters = draw(search.space, search.seed, configuration, interface)
    told = dict(parameters)
    if "map.hidden_layers" in told:
        told["map.hidden"] = str(int(told.pop("map.hidden_layers")) * [told.pop("map.hidden_units")])
    overrides = [f"env={search.env}", f"map={'none' if interface == 'raw' else interface}"]
    overrides += [] if interface in ("raw", "jacobian") else [f"map.action_dim={search.action_dim}"]
    overrides += [f"demos.path={demos}", *search.base, *(f"{name}={value}" for name, value in told.items())]
    overrides += [f"seed={seed}", f"algo.total_frames={frames}"]
    overrides += [f"run.wandb_group={stage}-{configuration:03d}", f"run.wandb_job_type={interface}"]
    return Task(
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


def check_settings(tasks: Sequence[Task], folder: Path) -> None:
    """Raise ValueError if a recipe does not take what it would be told, before anything is run."""
    for task in {task.interface: task for task in tasks}.values():
        _, schema = RECIPES[task.recipe]
        configure(schema, task.recipe, [*task.overrides, f"run.folder={folder}"])


def record_demos(config: Search, folder: Path, demos: Path) -> None:
    """Let the expert give the demonstrations that all runs share; of several processes one does it, others wait."""
    while not demos.exists():
        with claimed(folder / "claims" / "demos") as ours:
            if ours and not demos.exists():
                scratch = folder / f".demos-{os.getpid()}"
                shutil.rmtree(scratch, ignore_errors=True)
                record_expert(task_env(config.search), config.demos, config.search.seed, scratch)
                scratch.rename(demos)
        time.sleep(0 if demos.exists() else POLL)


def task_env(search: SearchConfig) -> Any:
    """The configuration of the environment that all runs have."""
    _, schema = RECIPES[search.recipe]
    return configure(schema, search.recipe, [f"env={search.env}", "map=none", *search.base]).env


def run_all(tasks: Sequence[Task], folder: Path, cluster: Cluster, ended: Rows) -> None:
    """Run those tasks of a stage that have not ended, and keep ``rows.csv`` up to date.

    Args:
        tasks: of one stage.
        folder: of the search.
        cluster: where they run.
        ended: the rows of all runs that have, which grows.
    """
    ended |= {
        task.name: rows_of(task, folder)
        for task in tasks
        if task.name not in ended and Outcome.read(folder / task.name) is not None
    }
    with progress(tasks, folder) as show:
        show(ended)
        while missing := [task for task in tasks if task.name not in ended]:
            for task in cluster.run(run_task, missing, folder):
                if Outcome.read(folder / task.name) is None:
                    continue  # another process is at it
                ended[task.name] = rows_of(task, folder)
                write_rows(folder, ended)
                show(ended)
            if any(task.name not in ended for task in tasks):
                time.sleep(POLL)
    write_rows(folder, ended)


@contextmanager
def progress(tasks: Sequence[Task], folder: Path) -> Iterator[Callable[[Rows], None]]:
    """A bar over the runs of a stage."""
    stage = tasks[0].stage
    # The mean rate, not the latest: runs of one configuration end together, and configurations differ.
    with tqdm(total=len(tasks), desc=f"{folder.name}, {stage}", unit="run", smoothing=0) as bar:

        def show(ended: Rows) -> None:
            own = [ended[task.name] for task in tasks if task.name in ended]
            failed = sum(rows["status"].iloc[0] != "done" for rows in own)
            running = len(list((folder / "claims").glob(f"{stage}-*")))
            if bar.n == 0:
                bar.initial = len(own)  # what was there says nothing about the rate
            bar.update(len(own) - bar.n)
            bar.set_postfix(failed=failed, running=running)  # drawn at once, also right after the start

        yield show


Rows = dict[str, pandas.DataFrame]
"""The rows of runs that have ended, by the task's name."""


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
        name = task_name(stage, interface, configuration, seed)
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
    order = rows.assign(late=late).sort_values(["late", "configuration", "seed", "interface", "frames"]).index
    return rows.loc[order].reset_index(drop=True)


def write_rows(folder: Path, ended: Rows) -> None:
    """Replace ``rows.csv``, whole or not at all."""
    with replacing(folder / "rows.csv") as scratch:
        together(ended).to_csv(scratch, index=False)


if __name__ == "__main__":
    launch(main, Search, "search")
