"""The runs of a search: each is claimed by one process, run like a command of a user, and its outcome recorded."""

from __future__ import annotations

import contextlib
import json
import math
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import pandas

from nht.reading import entry, known_entries, read_json, shortened
from nht.recipes.agents.table import find_algorithm
from nht.recipes.launch import configure
from nht.recipes.quiet import quiet_libraries
from nht.recipes.run.folder import MAP_METRICS_FILE
from nht.recipes.run.metrics import EVERY_RUN
from nht.recipes.run.metrics_file import metrics_table
from nht.recipes.run.ownership import OwnedError, claimed
from nht.recipes.run.workers import WorkerEndedError
from nht.recipes.study.dashboard_names import names_of
from nht.recipes.study.rows_file import CORE_SECONDS, MAP_ERROR
from nht.recipes.study.space import VERSION, Value
from nht.writing import replacing


@dataclass(frozen=True)
class Job:
    """One run of a search.

    Attributes:
        stage: ``search``, or ``best`` for a best configuration on fresh seeds.
        env: the task's name.
        interface: the interface of the run.
        configuration: its number.
        seed: of map and agent.
        recipe: ``ddpg`` or ``ppo``.
        metric: what the run is judged by, ``success`` or ``return``.
        parameters: what was drawn, by dotted name.
        overrides: all overrides for the recipe, except the run's folder.
    """

    stage: str
    env: str
    interface: str
    configuration: int
    seed: int
    recipe: str
    metric: str
    parameters: dict[str, Value]
    overrides: tuple[str, ...]

    @property
    def name(self) -> str:
        """Name of the run's folder below the search's."""
        return job_name(self.stage, self.interface, self.configuration, self.seed)

    @property
    def jobs(self) -> tuple[Job, ...]:
        """The runs that are done together: only this one."""
        return (self,)


def job_name(stage: str, interface: str, configuration: int, seed: int) -> str:
    """The name of a run, and of its folder below the search's."""
    return f"{stage}/{interface}/{configuration:03d}-seed{seed}"


STATUSES = ("done", "failed", "diverged")

TRIES = 3
"""How often a run is started if its workers die, which is not the fault of its settings. It resumes each time."""


@dataclass(frozen=True)
class Ending:
    """The outcome of a run.

    Attributes:
        status: ``done``, ``failed`` or ``diverged``.
        reason: of a failure.
        core_seconds: processor time of the process that ended it [s]; the run's share if several trained together.
    """

    status: str
    reason: str = ""
    core_seconds: float | None = field(default=None, compare=False)

    @classmethod
    def read(cls, run: Path) -> Ending | None:
        """The outcome recorded in the run's folder; None if the run has not ended.

        Raises:
            ValueError: if the file there is no such record.
        """
        file = run / "outcome.json"
        if not file.exists():
            return None
        record = read_json(file)
        known_entries(record, ("status", "reason", "core_seconds"), str(file))
        if entry(record, "status", str, str(file)) not in STATUSES:
            raise ValueError(
                f"{file}: 'status' must be one of {list(STATUSES)}, got {shortened(record['status'], 60)!r}."
            )
        spent = record.get("core_seconds")
        if not (spent is None or (isinstance(spent, int | float) and 0 <= spent < math.inf)):
            raise ValueError(
                f"{file}: 'core_seconds' must be a finite number, at least 0, got {shortened(spent, 60)!r}."
            )
        return cls(record["status"], entry(record, "reason", str, str(file)), spent)

    def write(self, run: Path) -> None:
        """Record it in the run's folder."""
        with replacing(run / "outcome.json") as scratch:
            scratch.write_text(json.dumps(asdict(self)))


def run_job(job: Job, folder: Path) -> Ending | None:
    """Train map and agent, or resume where another process stopped; a failure is recorded, not raised.

    Args:
        job: what to run.
        folder: of the search.

    Returns:
        the outcome, also of a run that had ended before; None if another process works on it, for this search or, in
        the run's own folder, for a user.
    """
    run = folder / job.name
    if (outcome := Ending.read(run)) is not None:
        return outcome
    with claimed(folder / "claims" / job.name.replace("/", "-")) as ours:
        if not ours:
            return None
        if (outcome := Ending.read(run)) is None:  # another process may have ended it in the meantime
            begun = time.process_time()
            try:
                outcome = _train(job, run, names_of(job, folder))
            except OwnedError:
                return None
            outcome = replace(outcome, core_seconds=time.process_time() - begun)
            # Buffers are large. First, for nobody looks there again once the outcome stands.
            shutil.rmtree(run / "checkpoints", ignore_errors=True)
            outcome.write(run)
    return outcome


def _train(job: Job, run: Path, names: Sequence[str]) -> Ending:
    """Train, and return the outcome; raises OwnedError if another process writes the folder."""
    run.mkdir(parents=True, exist_ok=True)
    algorithm = find_algorithm(job.recipe)
    overrides = [*job.overrides, *names, f"run.folder={run}", "run.resume=auto"]
    with (
        (run / "train.log").open("a") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        quiet_libraries()  # in this process, a worker's
        print(f"python -m nht.recipes.{job.recipe}", *overrides)
        try:
            _until_workers_live(lambda: algorithm.train(configure(algorithm.schema, job.recipe, overrides)))
        except OwnedError as error:
            print(error)
            raise
        except FloatingPointError as error:
            return Ending("diverged", _line(error))
        except Exception as error:  # noqa: BLE001 - whatever it is, the other runs go on
            return Ending("failed", _line(error))
    return Ending("done")


def _until_workers_live(train: Callable[[], None]) -> None:
    """Train, and try again at most a few times if a collector's worker dies."""
    for left in reversed(range(TRIES)):
        try:
            return train()
        except WorkerEndedError as error:
            if not left:
                raise
            print(f"{error} Tried again, {left} times at most.")


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:500]


def rows_of(job: Job, folder: Path) -> pandas.DataFrame:
    """The evaluations of a run that has ended, a row each; one row without numbers if there was none."""
    run = folder / job.name
    outcome = Ending.read(run)
    assert outcome is not None
    metrics = run / "metrics.csv"
    measured = metrics_table(metrics) if metrics.exists() else pandas.DataFrame()
    if measured.empty:
        measured = pandas.DataFrame({name: [float("nan")] for name in EVERY_RUN})
    rows = measured.reindex(columns=EVERY_RUN)
    known: dict[str, Value] = {
        "version": VERSION,
        "metric": job.metric,
        "stage": job.stage,
        "env": job.env,
        "interface": job.interface,
        "configuration": job.configuration,
        "seed": job.seed,
        "status": outcome.status,
        "reason": outcome.reason,
    }
    for place, (name, value) in enumerate(known.items()):
        rows.insert(place, name, value)
    costs = {CORE_SECONDS: outcome.core_seconds, MAP_ERROR: map_error(run)}
    return rows.assign(
        **{name: float("nan") if cost is None else cost for name, cost in costs.items()}, **job.parameters
    )


def map_error(run: Path) -> float | None:
    """The held-out error of the map that a run trained; None if it trained none."""
    file = run / MAP_METRICS_FILE
    if not file.exists():
        return None
    return float(entry(read_json(file), "validation_error", float, str(file)))
