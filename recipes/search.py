"""The paper's central experiment: hyperparameters drawn at random, trained with every interface, on Ray.

python -m nht.recipes.search search=wam search.configs=128 search.seeds=5
"""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas
from tqdm import tqdm

from nht.recipes.cluster import Cluster
from nht.recipes.config import Search, SearchConfig
from nht.recipes.launch import configure, launch
from nht.recipes.recording import record_expert
from nht.recipes.search_report import summary
from nht.recipes.search_results import SearchResults, read_results
from nht.recipes.search_space import draw, write_manifest
from nht.recipes.search_tasks import RECIPES, Outcome, Task, claimed, rows_of, run_task
from nht.recipes.train_map import KINDS
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
        rows = run_all(tasks, folder, cluster, config.retry_failed, before=None)
        best = best_tasks(search, demos, rows)
        rows = run_all(best, folder, cluster, config.retry_failed, before=rows)
    print(summary(SearchResults.of(rows)).to_string(index=False))
    print(f"\n{folder}: manifest.json, rows.csv; figures: python -m nht.recipes.report {config.folder}")


def check_interfaces(search: SearchConfig) -> None:
    """Raise ValueError for an interface that does not exist."""
    known = ["raw", *sorted(KINDS.keys() - {"none"})]
    if unknown := [name for name in search.interfaces if name not in known]:
        raise ValueError(f"unknown search.interfaces {unknown}: choose from {known}.")
    if not search.interfaces:
        raise ValueError(f"search.interfaces is empty: choose from {known}.")


def search_tasks(search: SearchConfig, demos: Path) -> list[Task]:
    """Every run of the search, those of all interfaces of one configuration and seed after each other."""
    return [
        make_task(search, demos, "search", interface, configuration, seed, search.total_frames)
        for configuration in range(search.configs)
        for seed in range(search.seeds)
        for interface in search.interfaces
    ]


def best_tasks(search: SearchConfig, demos: Path, rows: pandas.DataFrame) -> list[Task]:
    """The best configuration of each interface, on fresh seeds."""
    results = SearchResults.of(rows)
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


def run_all(
    tasks: Sequence[Task],
    folder: Path,
    cluster: Cluster,
    retry_failed: bool,
    before: pandas.DataFrame | None,
) -> pandas.DataFrame:
    """Run those tasks that have not ended, and keep ``rows.csv`` up to date; its rows.

    What stands in ``rows.csv`` already has ended, too: with the manifest it is all that another machine needs to go on.

    Args:
        tasks: of one stage.
        folder: of the search.
        cluster: where they run.
        retry_failed: whether those that failed before are run once more.
        before: rows of an earlier stage, which stand first.
    """
    if retry_failed:
        forget_failures(tasks, folder)
    ended = kept_rows(tasks, folder) | {
        task.name: rows_of(task, folder) for task in tasks if Outcome.read(folder / task.name) is not None
    }
    with progress(tasks, folder, len(ended)) as show:
        while missing := [task for task in tasks if task.name not in ended]:
            for task in cluster.run(run_task, missing, folder):
                if Outcome.read(folder / task.name) is None:
                    continue  # another process is at it
                ended[task.name] = rows_of(task, folder)
                write_rows(folder, before, [ended[done.name] for done in tasks if done.name in ended])
                show(ended)
            if len(ended) < len(tasks):
                time.sleep(POLL)
    return write_rows(folder, before, [ended[task.name] for task in tasks])


def kept_rows(tasks: Sequence[Task], folder: Path) -> dict[str, pandas.DataFrame]:
    """The rows of those tasks that ``rows.csv`` has, by the task's name."""
    if not (folder / "rows.csv").exists():
        return {}
    runs = read_results(folder / "rows.csv").rows.groupby(["stage", "interface", "configuration", "seed"])
    known = {(task.stage, task.interface, task.configuration, task.seed): task.name for task in tasks}
    return {known[place]: rows.dropna(axis="columns", how="all") for place, rows in runs if place in known}


def forget_failures(tasks: Sequence[Task], folder: Path) -> None:
    """Let those tasks that have failed begin anew."""
    if (file := folder / "rows.csv").exists():
        rows = pandas.read_csv(file)
        rows[rows["status"] == "done"].to_csv(file, index=False)
    for task in tasks:
        outcome = Outcome.read(folder / task.name)
        if outcome is not None and outcome.status != "done":
            shutil.rmtree(folder / task.name)


@contextmanager
def progress(tasks: Sequence[Task], folder: Path, initial: int) -> Iterator[Any]:
    """A bar over the runs of a stage."""
    stage = tasks[0].stage if tasks else "search"
    with tqdm(total=len(tasks), initial=initial, desc=f"{folder.name}, {stage}", unit="run") as bar:

        def show(ended: dict[str, pandas.DataFrame]) -> None:
            failed = sum(rows["status"].iloc[0] != "done" for rows in ended.values())
            running = len(list((folder / "claims").glob(f"{stage}-*")))
            bar.set_postfix(failed=failed, running=running, refresh=False)
            bar.update(len(ended) - bar.n)

        yield show


def write_rows(
    folder: Path, before: pandas.DataFrame | None, rows: Sequence[pandas.DataFrame]
) -> pandas.DataFrame:
    """Replace ``rows.csv``, whole or not at all; what stands in it now."""
    parts = [part for part in (before, *rows) if part is not None]
    together = pandas.concat([part.dropna(axis="columns", how="all") for part in parts], ignore_index=True)
    columns = list(dict.fromkeys(name for part in parts for name in part.columns))
    together = together.reindex(columns=columns)
    with replacing(folder / "rows.csv") as scratch:
        together.to_csv(scratch, index=False)
    return together


if __name__ == "__main__":
    launch(main, Search, "search")
