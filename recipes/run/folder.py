"""The folder of a run: configuration, map, metrics, checkpoints, videos and W&B files; one process owns it."""

from __future__ import annotations

import csv
import json
import shutil
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pandas
import yaml

import nht
from nht.recipes.agents.table import name_of
from nht.recipes.maps.interface import run_map
from nht.recipes.maps.kinds import default_scale, map_context_keys
from nht.recipes.run.charts import RunCharts
from nht.recipes.run.dashboard import open_dashboard, wanted
from nht.recipes.run.demonstrations import DEMOS_FOLDER, note_demos, provide_demos
from nht.recipes.run.environments import check_env, mapped_env
from nht.recipes.run.metrics import FRAMES, SECONDS, TESTED
from nht.recipes.run.metrics_file import append_row, metrics_table, read_metrics
from nht.recipes.run.ownership import OwnedError, claimed, owner_of
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.same_run import check_same
from nht.recipes.run.saved_run import CONFIG_FILE, MAP_FILE, kept_map, read_config, read_run
from nht.recipes.sections import Training
from nht.writing import replacing

METRICS_FILE, WHOLE_FILE, VIDEO_FILE = "metrics.csv", "whole.json", "video.mp4"
MAP_METRICS_FILE = "map.json"
"""File with the metrics of the map's training, if the run trained its map."""


class RunFolder:
    """The folder that one run writes to: ``metrics.csv`` has a row per evaluation, W&B gets the same numbers.

    The first of the processes that learn together opens and writes it; the others wait and read.

    Args:
        config: the whole configuration of the run, saved as ``config.yaml``.
        ranks: the processes that learn together.
        make_map: gives the run its map, from its configuration and the number of motors.

    Raises:
        FileExistsError: if ``run.resume`` is false and the folder holds another run or an unfinished one; or if another
            process owns it.
        FileNotFoundError: if ``run.resume`` is true and there is nothing to resume.
        ValueError: if the run to resume has other settings, or the task or map cannot be made. Nothing is left behind
            then.

    Attributes:
        path: of the folder.
        config: the configuration, with what follows from task and map filled in.
        resuming: whether the folder holds a run that is resumed.
        map: the run's action map.
    """

    def __init__(
        self, config: Training, ranks: Ranks, make_map: Callable[[Training, int], nht.MapTraining] = run_map
    ) -> None:
        if config.seeds is not None:
            raise ValueError(
                f"{name_of(type(config))} trains one learner at a time: ddpg and ppo train several together, got "
                f"seeds={config.seeds}."
            )
        self.path = Path(config.run.folder)
        self.config = resolved(config)
        self.metrics = self.path / METRICS_FILE
        self.resuming = False
        self._ranks = ranks
        self._make_map = make_map
        self._started = time.perf_counter()
        self._open = ExitStack()
        self._charts: RunCharts | None = None
        self._noted: dict[str, float] = {}
        if ranks.first:
            with ExitStack() as undo:
                self._begin(undo)
                undo.pop_all()
        ranks.wait()
        self.resuming = ranks.any(self.resuming)
        self.map = kept_map(self.path, read_config(self.path, self._named()), ranks.device)

    def _named(self) -> list[str]:
        """Modules that the command line names in import paths; the folder's files may name them, too."""
        config = self.config
        names = [name_of(type(config)), config.env.name, config.env.suite, config.map.kind]
        return [name.partition(":")[0] for name in names if ":" in name]

    def _begin(self, undo: ExitStack) -> None:
        self.path.mkdir(parents=True, exist_ok=True)
        lock = self.path / ".owner"
        undo.push(self._open)
        if not self._open.enter_context(claimed(lock)):
            raise OwnedError(f"{self.path} is being written by {owner_of(lock)}: wait, or choose another.")
        if [entry.name for entry in self.path.iterdir()] == [lock.name]:  # ours alone to take away again
            undo.callback(shutil.rmtree, self.path, ignore_errors=True)
        self._look()
        if self.resuming and self.whole:  # nothing is left to do, and so nothing is written
            self.close()
            return
        motors = check_env(self.config.env)
        wanted(self.config.run)  # whether W&B is installed, if it is
        settings = self.path / CONFIG_FILE
        if not self.resuming:
            undo.callback(settings.unlink, missing_ok=True)
        self._write_config()
        if not (recorded := self.path / DEMOS_FOLDER).exists():
            undo.callback(shutil.rmtree, recorded, ignore_errors=True)
        told = provide_demos(self.config, self.resuming)
        if fresh := not (kept := self.path / MAP_FILE).exists():
            map, found = self._make_map(told, motors)
            mapped_env(self.config.env, map, seed=0, num_envs=1).close()  # whether it fits the task
            if found:
                with replacing(self.path / MAP_METRICS_FILE) as scratch:
                    scratch.write_text(json.dumps(found))
            self._noted = note_demos(self.config, map)
            nht.save_map(map, kept)
        else:
            map = kept_map(self.path, self.config, allow=self._named())
            self._noted = note_demos(self.config, map)
        self._open_charts(map, fresh)

    def _open_charts(self, map: nht.ActionMap, fresh: bool) -> None:
        """Begin the run on W&B, or go on with it; what it is made from is said where the map is ``fresh``."""
        dashboard = open_dashboard(self.path, self._settings(), self.config.run)
        if dashboard is not None:
            self._charts = RunCharts(dashboard, self.path, self.config)
            if fresh:
                self._charts.show_origin(self.path / MAP_FILE, map, self.path / MAP_METRICS_FILE)

    def _look(self) -> None:
        """Find out whether there is a run to resume, and whether it may be resumed."""
        settings, run = self.path / CONFIG_FILE, self.config.run
        resume = run.resume or ("auto" if self._ranks.restarts else False)  # torchrun starts processes anew
        self.resuming = settings.exists()
        if resume is True and not self.resuming:
            raise FileNotFoundError(f"{self.path} holds no run to resume.")
        refusal = (
            f"{self.path} holds a run already: go on with run.resume=true, or choose another run.folder."
        )
        if resume is False and self.resuming and not self.whole:
            raise FileExistsError(refusal)
        if self.resuming:
            try:
                check_same(self.path, self.config, *read_run(self.path, self._named()))
            except ValueError as error:
                if resume is False:
                    raise FileExistsError(refusal) from error
                raise

    def _settings(self) -> dict[str, Any]:
        """The contents of ``config.yaml``."""
        return {"recipe": name_of(type(self.config)), **asdict(self.config)}

    def _write_config(self) -> None:
        with replacing(self.path / CONFIG_FILE) as scratch:
            scratch.write_text(yaml.safe_dump(self._settings(), sort_keys=False))

    @property
    def whole(self) -> bool:
        """Whether the run is complete: trained to its end, with all its files written."""
        try:
            ended = json.loads((self.path / WHOLE_FILE).read_text())
            return bool(ended[FRAMES] >= self.config.algo.total_frames)
        except (OSError, ValueError, KeyError, TypeError):
            return False

    @property
    def members(self) -> list[RunFolder]:
        """The folders of all learners: only this one."""
        return [self]

    @property
    def configs(self) -> list[Training]:
        """The configurations of all learners."""
        return [self.config]

    @property
    def maps(self) -> list[nht.ActionMap]:
        """The action maps of all learners."""
        return [self.map]

    def finished(self) -> list[tuple[int, RunFolder]]:
        """The learners that got to the end, with their numbers."""
        return [(0, self)]

    @property
    def charted(self) -> bool:
        """Whether this process shows the run on W&B."""
        return self._charts is not None

    def log_each(
        self,
        frames: int,
        rows: Sequence[dict[str, float] | FloatingPointError],
        latest: Sequence[dict[str, float]] = (),
    ) -> None:
        """Append the row of the only learner; ``latest`` is what W&B gets of training in place of its means.

        Raises:
            FloatingPointError: if an error is given in place of the row.
        """
        (row,) = rows
        if isinstance(row, FloatingPointError):
            raise row
        self.log(frames, row, *latest)

    def log(self, frames: int, row: dict[str, float], latest: dict[str, float] | None = None) -> None:
        """Append a row to ``metrics.csv`` and send it to W&B, against environment steps."""
        if not self._ranks.first:
            return
        row = {FRAMES: frames, **row, **self._noted, SECONDS: time.perf_counter() - self._started}
        append_row(self.metrics, row)
        if self._charts is not None:
            self._charts.row(frames, row, latest)

    def chart_each(self, frames: int, rows: Sequence[dict[str, float]]) -> None:
        """Chart a row between two tests, of the only learner."""
        if self._charts is not None and rows[0]:
            self._charts.row(frames, rows[0] | {SECONDS: time.perf_counter() - self._started})

    def leave_out(self, seconds: float) -> None:
        """Count a time as none of the run's: it went into films."""
        self._started += seconds

    def film(self, frames: int, video: Path) -> None:
        """Show a film of the policy on W&B."""
        if self._charts is not None:
            self._charts.film(frames, video)

    def rewind(self, frames: int) -> None:
        """Drop rows after ``frames``, and rows that a kill cut short: a resumed run writes them again.

        The clock goes on from the last row that is kept. Raises ValueError if the file is no table of metrics.
        """
        if not self._ranks.first or not self.metrics.exists():
            return
        heading, rows = read_metrics(self.metrics)
        kept = [row for row in rows if int(row[0]) <= frames]
        if not kept:
            self.metrics.unlink()  # its heading may be cut short, too
            return
        self._started -= float(kept[-1][heading.index(SECONDS)])
        with replacing(self.metrics) as scratch, scratch.open("w", newline="") as file:
            csv.writer(file).writerows([heading, *kept])

    def finish(self, frames: int) -> None:
        """Finish the run on W&B, and mark it as complete."""
        if not self._ranks.first:
            return
        if self._charts is not None:
            self._charts.finish(frames, metrics_table(self.metrics))
            self._charts = None
        with replacing(self.path / WHOLE_FILE) as scratch:
            scratch.write_text(json.dumps({FRAMES: frames}))

    def show(self) -> None:
        """Print the outcome and where the files are."""
        if not self._ranks.first:
            return
        rows = pandas.read_csv(self.metrics)
        print(rows[[FRAMES, *TESTED]].tail(5).to_string(index=False))
        shown = sorted(entry.name for entry in self.path.iterdir() if not entry.name.startswith("."))
        print(f"\n{self.path}: " + ", ".join(shown))

    def close(self) -> None:
        """Release the folder, and close W&B's run if it is incomplete."""
        if self._charts is not None:
            self._charts.leave()
            self._charts = None
        self._open.close()


def resolved(config: Training) -> Training:
    """The configuration with the defaults of task and kind of map filled in, as the run's files have it."""
    env = replace(config.env, context_keys=map_context_keys(config.map, config.env))
    map = replace(config.map, action_scale=default_scale(config.map))
    if config.map.file is not None:  # the file says
        env, map = replace(config.env), replace(config.map)
    return replace(config, env=env, map=map)
