"""A run on Weights & Biases: offline unless the user has logged in, and never required.

``wandb`` is imported only if a run uses it. All charts share the axis ``env_steps``.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas

from nht.reading import entry, read_json, shortened
from nht.recipes.run.artifacts import BEST_ALIAS, ERROR, FileSet, finite, fits_best
from nht.recipes.run.metrics import BEST, ENV_STEPS, FRAMES, MAP_STEPS, chart_row, charted, tested
from nht.recipes.run.provenance import provenance
from nht.recipes.run.wandb_internals import use_offline
from nht.recipes.run.wandb_login import chosen_mode, import_wandb, logged_in, wanted
from nht.recipes.sections import ChartsConfig
from nht.writing import replacing

__all__ = ["Dashboard", "import_wandb", "logged_in", "open_dashboard", "shown_on_dashboard", "wanted"]

FILM = "eval/film"
NOTE_FILE = "wandb.json"
"""In a folder: the id of its run on W&B, and how far that has been charted."""


@dataclass
class Note:
    """What a folder says about its run on W&B, so that a resumed run goes on with it.

    Attributes:
        file: of the note.
        id: of the run.
        frames: environment steps that rows have been written up to.
    """

    file: Path
    id: str
    frames: int = -1

    def write(self) -> None:
        """Write it, whole or not at all."""
        with replacing(self.file) as scratch:
            scratch.write_text(json.dumps({"id": self.id, FRAMES: self.frames}))

    @classmethod
    def read(cls, file: Path) -> Note | None:
        """The note in a file; None if there is none.

        Raises:
            ValueError: if it is no such note.
        """
        if not file.exists():
            return None
        record = read_json(file)
        return cls(file, entry(record, "id", str, str(file)), entry(record, FRAMES, int, str(file)))


class Dashboard:
    """One run on W&B, whose files are in a folder.

    A run that goes on has the same id; offline, W&B begins another file, and ``wandb sync`` of both makes one run of
    them, as no step is in both.

    Args:
        folder: where the files go.
        settings: of the command; W&B shows them under the same keys, and beside them where the run comes from.
        charts: names of project, group and so on in W&B.
        mode: ``online``, ``offline`` or ``shared``.
        name: of the run, unless ``charts`` says another.
        remembered: whether the folder belongs to this run alone, which may go on with it.

    Raises:
        ImportError: if ``wandb`` is not installed.
        RuntimeError: if W&B does not start.
    """

    def __init__(
        self,
        folder: Path,
        settings: Mapping[str, Any],
        charts: ChartsConfig,
        mode: str,
        *,
        name: str = "",
        remembered: bool = True,
    ) -> None:
        os.environ.setdefault("WANDB_SILENT", "true")
        if not os.environ.get("WANDB_API_KEY", "-"):
            del os.environ["WANDB_API_KEY"]  # empty, as compose files leave it: W&B would refuse to start
        self._wandb = wandb = import_wandb()
        before = Note.read(folder / NOTE_FILE) if remembered else None
        try:
            self._run = wandb.init(
                id=None if before is None else before.id,
                resume="allow" if before is not None and mode != "offline" else None,
                name=charts.wandb_name or name or folder.name,
                dir=str(folder),
                project=charts.wandb_project,
                group=charts.wandb_group,
                job_type=charts.wandb_job_type or settings.get("recipe"),
                notes=charts.wandb_notes,
                tags=charts.wandb_tags or None,
                config={**settings, "provenance": provenance()},
                mode=mode,
                reinit="create_new",  # W&B would go on with a run of this process that was left, or is a caller's
            )
        except (wandb.Error, ValueError) as error:
            raise RuntimeError(
                f"W&B does not start: {shortened(error)}. Set WANDB_MODE=offline, or run.wandb=false."
            ) from error
        self.id: str = self._run.id
        self._note = before or Note(folder / NOTE_FILE, self.id)
        self._remembered, self._known = remembered, self._note.frames
        if remembered:
            self._note.write()
        self._define()

    def _define(self) -> None:
        """The axis of the charts, and which values of a run its row in the table of runs has."""
        self._run.define_metric(ENV_STEPS)
        self._run.define_metric("*", step_metric=ENV_STEPS)
        self._run.define_metric(MAP_STEPS)
        self._run.define_metric("map/*", step_metric=MAP_STEPS)
        for outcome, side in BEST.items():
            name = charted(tested(outcome))
            self._run.define_metric(name, step_metric=ENV_STEPS, summary=f"{side},last")

    def log(self, frames: int, row: Mapping[str, float]) -> None:
        """Chart a row of metrics against environment steps, unless this was done before the run was resumed."""
        if frames > self._known:
            self._run.log(chart_row(row) | {ENV_STEPS: frames}, step=frames)
        if frames > self._note.frames and self._remembered:
            self._note.frames = frames
            self._note.write()

    def log_map(self, metrics: Mapping[str, float]) -> None:
        """Chart how the training of a map goes on, against its own steps."""
        step = metrics["step"]
        row = {f"map/{name}": value for name, value in metrics.items() if name != "step"}
        self._run.log({**row, MAP_STEPS: step})

    def film(self, frames: int, video: Path) -> None:
        """Show a film of the policy after a number of environment steps, beside the row of that test."""
        if frames >= self._known:
            shown = self._wandb.Video(str(video), format="mp4")
            self._run.log({FILM: shown, ENV_STEPS: frames}, step=frames)

    def video(self, name: str, file: Path) -> None:
        """Show a film, of whatever."""
        self._run.log({name: self._wandb.Video(str(file), format="mp4")})

    def picture(self, name: str, file: Path) -> None:
        """Show a picture."""
        self._run.log({name: self._wandb.Image(str(file))})

    def table(self, name: str, table: pandas.DataFrame) -> None:
        """Show a table."""
        plain = table.astype(object).where(table.notna(), None)
        self._run.log({name: self._wandb.Table(dataframe=plain)})

    def summarise(self, facts: Mapping[str, Any]) -> None:
        """Say something about the run as a whole."""
        self._run.summary.update(finite(facts))

    def add(self, files: FileSet) -> None:
        """Hand a version of files to other runs. Online, the server says whether a map is the best of its name."""
        aliases = set(files.aliases)
        if not self._run.offline and ERROR in files.facts:
            aliases -= {BEST_ALIAS}
            aliases |= {BEST_ALIAS} if fits_best(files.facts, self._best_so_far(files)) else set()
        self._run.log_artifact(self._artifact(files), aliases=sorted(aliases))

    def _best_so_far(self, files: FileSet) -> Mapping[str, Any] | None:
        """The facts about the best version on the server; None if there is none."""
        name = f"{self._run.entity}/{self._run.project}/{files.name}:{BEST_ALIAS}"
        try:
            facts: Mapping[str, Any] = self._wandb.Api().artifact(name, type=files.type).metadata
        except (self._wandb.Error, ValueError):  # it does not say which of several reasons
            return None
        return facts

    def take(self, files: FileSet) -> None:
        """Note that the run is made from files that another run may have handed on."""
        if self._run.offline:
            use_offline(self._run, self._artifact(files))
        else:
            self._run.use_artifact(self._artifact(files))

    def _artifact(self, files: FileSet) -> Any:
        artifact = self._wandb.Artifact(files.name, type=files.type, metadata=dict(files.facts))
        for name, file in files.files.items():
            artifact.add_file(str(file), name=name)
        return artifact

    def finish(self) -> None:
        """Close a run that got to its end."""
        self._run.finish()

    def leave(self) -> None:
        """Close a run that stopped before its end: a process may go on to other runs."""
        self._run.finish(exit_code=1)


@contextmanager
def shown_on_dashboard(
    folder: Path,
    settings: Mapping[str, Any],
    charts: ChartsConfig,
    *,
    name: str = "",
    remembered: bool = True,
) -> Iterator[Dashboard | None]:
    """Within, a command shows something on a dashboard, if it is wanted; it is closed with how the command ended."""
    dashboard = open_dashboard(folder, settings, charts, name=name, remembered=remembered)
    try:
        yield dashboard
    except BaseException:
        if dashboard is not None:
            dashboard.leave()
        raise
    if dashboard is not None:
        dashboard.finish()


def open_dashboard(
    folder: Path,
    settings: Mapping[str, Any],
    charts: ChartsConfig,
    *,
    name: str = "",
    remembered: bool = True,
) -> Dashboard | None:
    """The run's dashboard; None where W&B is not ``wanted``. Arguments as of ``Dashboard``."""
    if not wanted(charts):
        return None
    return Dashboard(folder, settings, charts, chosen_mode(), name=name, remembered=remembered)
