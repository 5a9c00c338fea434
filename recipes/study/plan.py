"""The runs of a search: every configuration with every interface, then the best of each on fresh seeds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from nht.recipes.agents.table import find_algorithm
from nht.recipes.config import SearchConfig
from nht.recipes.launch import configure
from nht.recipes.maps.kinds import KINDS, MapKind, find_kind, tasks_with_arm
from nht.recipes.study.ended_runs import EndedRuns, together
from nht.recipes.study.jobs import Job
from nht.recipes.study.results import SearchResults
from nht.recipes.study.space import draw_settings

FIRST_FRESH_SEED = 100
"""First seed of the runs of best configurations; seeds of the search itself count from 0."""


def check_interfaces(search: SearchConfig) -> None:
    """Raise ValueError for an interface that does not exist, or that the task cannot have."""
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
    """Names of the interfaces that may be compared: every kind of map, and ``raw``, which is the kind ``none``."""
    return ["raw", *(name for name in KINDS if name != "none")]


def kind_of(interface: str) -> MapKind:
    """The kind of map of an interface."""
    return find_kind("none" if interface == "raw" else interface)


def search_jobs(search: SearchConfig, demos: Path) -> list[Job]:
    """Every run of the search, ordered by configuration, seed and interface."""
    return [
        make_job(search, demos, "search", interface, configuration, seed, search.total_frames)
        for configuration in range(search.configs)
        for seed in range(search.seeds)
        for interface in search.interfaces
    ]


def best_jobs(search: SearchConfig, demos: Path, ended: EndedRuns) -> list[Job]:
    """The best configuration of each interface, on fresh seeds."""
    results = SearchResults.of(together(ended))
    best = {interface: results.best(interface)[0] for interface in search.interfaces}
    return [
        make_job(search, demos, "best", interface, configuration, FIRST_FRESH_SEED + seed, search.best_frames)
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
    """One run: the overrides that a user would type."""
    parameters = draw_settings(search.space, search.seed, configuration, interface)
    told = dict(parameters)
    if "map.hidden_layers" in told:
        told["map.hidden"] = str(int(told.pop("map.hidden_layers")) * [told.pop("map.hidden_units")])
    overrides = [f"env={search.env}", f"map={'none' if interface == 'raw' else interface}"]
    overrides += [] if kind_of(interface).fixed_width else [f"map.action_dim={search.action_dim}"]
    overrides += [f"demos.path={demos}", *search.base, *(f"{name}={value}" for name, value in told.items())]
    overrides += [f"seed={seed}", f"algo.total_frames={frames}"]
    overrides += [f"run.wandb_job_type={interface}"]
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
    """Raise ValueError if a recipe refuses its overrides, before anything is run."""
    for job in {job.interface: job for job in jobs}.values():
        schema = find_algorithm(job.recipe).schema
        configure(schema, job.recipe, [*job.overrides, f"run.folder={folder}"])


def task_env(search: SearchConfig) -> Any:
    """The configuration of the environment, which all runs share."""
    schema = find_algorithm(search.recipe).schema
    return configure(schema, search.recipe, [f"env={search.env}", "map=none", *search.base]).env
