"""The runs of a search, and how each of them came out: claimed by one process, run as a person would, recorded."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas

from nht.recipes import ddpg, ppo, sac, td3
from nht.recipes.agents.sac import SAC
from nht.recipes.agents.td3 import TD3
from nht.recipes.config import DDPG, PPO
from nht.recipes.launch import configure
from nht.recipes.search_space import VERSION, Value
from nht.storage import replacing

RECIPES: dict[str, Any] = {
    "ddpg": (ddpg.main, DDPG),
    "ppo": (ppo.main, PPO),
    "sac": (sac.main, SAC),
    "td3": (td3.main, TD3),
}
HEARTBEAT, SILENCE = 30.0, 300.0
"""Seconds between two signs of life, and after how many without one a claim is void."""

METRICS = ("frames", "eval_success", "eval_failure", "eval_return", "seconds")


@dataclass(frozen=True)
class Task:
    """One run of a search.

    Attributes:
        stage: ``search``, or ``best`` for a best configuration on fresh seeds.
        env: the task's name.
        interface: whose run.
        configuration: its number.
        seed: of map and agent.
        recipe: ``ddpg``, ``ppo``, ``sac`` or ``td3``.
        metric: what the run is judged by, ``success`` or ``return``.
        parameters: what was drawn, by dotted name.
        overrides: everything that the recipe is told, the run's folder aside.
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
        """Of the run's folder, below the search's."""
        return task_name(self.stage, self.interface, self.configuration, self.seed)


def task_name(stage: str, interface: str, configuration: int, seed: int) -> str:
    """By which a run is known."""
    return f"{stage}/{interface}/{configuration:03d}-seed{seed}"


@dataclass(frozen=True)
class Outcome:
    """How a run came out: ``done``, ``failed`` or ``diverged``, and why."""

    status: str
    reason: str = ""

    @classmethod
    def read(cls, run: Path) -> Outcome | None:
        """What was recorded in the run's folder; None if the run has not ended."""
        file = run / "outcome.json"
        return cls(**json.loads(file.read_text())) if file.exists() else None

    def write(self, run: Path) -> None:
        """Record it in the run's folder."""
        with replacing(run / "outcome.json") as scratch:
            scratch.write_text(json.dumps({"status": self.status, "reason": self.reason}))


def run_task(task: Task, folder: Path) -> Outcome | None:
    """Train map and agent, or go on where another process was stopped; what fails is recorded, not raised.

    Args:
        task: what to run.
        folder: of the search.

    Returns:
        the outcome, also of a run that had ended before; None if another process is at it.
    """
    run = folder / task.name
    if (outcome := Outcome.read(run)) is not None:
        return outcome
    with claimed(folder / "claims" / task.name.replace("/", "-")) as ours:
        if not ours:
            return None
        if (outcome := Outcome.read(run)) is None:  # another process may have ended it in the meantime
            outcome = _train(task, run)
            outcome.write(run)
            shutil.rmtree(run / "checkpoints", ignore_errors=True)  # buffers are large
    return outcome


def _train(task: Task, run: Path) -> Outcome:
    run.mkdir(parents=True, exist_ok=True)
    main, schema = RECIPES[task.recipe]
    overrides = [*task.overrides, f"run.folder={run}", "run.resume=auto"]
    with (
        (run / "train.log").open("a") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        print(f"python -m nht.recipes.{task.recipe}", *overrides)
        if (run / "policy.safetensors").exists():
            return Outcome("done")  # all but the outcome was written
        try:
            main(configure(schema, task.recipe, overrides))
        except FloatingPointError as error:
            return Outcome("diverged", _line(error))
        except Exception as error:  # noqa: BLE001 - whatever it is, the other runs go on
            return Outcome("failed", _line(error))
    return Outcome("done")


def _line(error: Exception) -> str:
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:500]


@contextlib.contextmanager
def claimed(file: Path) -> Iterator[bool]:
    """Whether this process may do what ``file`` stands for: nobody else is at it, here or where the folder is shared.

    While it is, the file's time tells that it lives. A claim falls if its process has ended or was silent for long.
    """
    file.parent.mkdir(parents=True, exist_ok=True)
    if not _claim(file):
        yield False
        return
    over = threading.Event()
    pulse = threading.Thread(target=_live, args=(file, over), daemon=True)
    pulse.start()
    try:
        yield True
    finally:
        over.set()
        pulse.join()
        file.unlink(missing_ok=True)


def _claim(file: Path) -> bool:
    if file.exists() and _is_void(file):
        # Of several that see it only one can move it away.
        with contextlib.suppress(FileNotFoundError):
            void = file.with_name(f"{file.name}.void-{socket.gethostname()}-{os.getpid()}")
            file.rename(void)
            void.unlink()
    try:
        with file.open("x") as handle:
            json.dump({"host": socket.gethostname(), "pid": os.getpid()}, handle)
    except FileExistsError:
        return False
    return True


def _is_void(file: Path) -> bool:
    try:
        if time.time() - file.stat().st_mtime > SILENCE:
            return True
        owner = json.loads(file.read_text())
    except (FileNotFoundError, json.JSONDecodeError):
        return False  # just given up, or just being written
    return owner["host"] == socket.gethostname() and not _is_alive(owner["pid"])


def _is_alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _live(file: Path, over: threading.Event) -> None:
    while not over.wait(HEARTBEAT):
        with contextlib.suppress(FileNotFoundError):
            os.utime(file)


def rows_of(task: Task, folder: Path) -> pandas.DataFrame:
    """The evaluations of a run that has ended, a row each; one row without numbers if there was none."""
    run = folder / task.name
    outcome = Outcome.read(run)
    assert outcome is not None
    metrics = run / "metrics.csv"
    measured = (
        pandas.read_csv(metrics)
        if metrics.exists()
        else pandas.DataFrame({name: [float("nan")] for name in METRICS})
    )
    rows = measured.reindex(columns=METRICS)
    known: dict[str, Value] = {
        "version": VERSION,
        "metric": task.metric,
        "stage": task.stage,
        "env": task.env,
        "interface": task.interface,
        "configuration": task.configuration,
        "seed": task.seed,
        "status": outcome.status,
        "reason": outcome.reason,
    }
    for place, (name, value) in enumerate(known.items()):
        rows.insert(place, name, value)
    return rows.assign(**task.parameters)
