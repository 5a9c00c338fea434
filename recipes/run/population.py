"""The folders of learners that train together: one for each, like that of a single run, and one for what they share."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from contextlib import ExitStack
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas

import nht
from nht.reading import entry, read_json
from nht.recipes.maps.interface import number_of_actions
from nht.recipes.maps.kinds import map_context_keys
from nht.recipes.maps.side_by_side import MapsSideBySide
from nht.recipes.maps.together import MapsOfRuns
from nht.recipes.run.environments import base_env
from nht.recipes.run.folder import RunFolder, resolved
from nht.recipes.run.learners import check_alike
from nht.recipes.run.memory import check_memory
from nht.recipes.run.metrics import FRAMES, TESTED
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.saved_run import MAP_FILE
from nht.recipes.sections import Training
from nht.writing import replacing

DIVERGED_FILE = "diverged.json"
"""File in the folder of a learner that diverged: after how many steps, and why."""

Row = dict[str, float]


def open_run(
    configs: Sequence[Training], ranks: Ranks, together: str | None = None
) -> RunFolder | PopulationFolder:
    """The folder of a run of one learner, or those of several.

    Args:
        configs: of each learner; one that says ``seeds`` stands for as many.
        ranks: the processes that learn together.
        together: folder of what several learners share; None is the one that the first one's folder is in.

    Raises:
        ValueError: if several learners cannot share every call, or are to be shared among processes.
        FileExistsError, FileNotFoundError: as ``RunFolder``.
    """
    if len(configs) == 1 and configs[0].seeds is not None:
        together = configs[0].run.folder
        configs = with_seeds(configs[0])
    if len(configs) == 1:
        return RunFolder(configs[0], ranks)
    for learner, config in enumerate(configs):
        if config.seeds is not None:
            raise ValueError(
                f"learner {learner} says seeds={config.seeds}: that is for a configuration alone."
            )
    if ranks.size > 1:
        raise ValueError(
            f"{len(configs)} learners train in one process, got {ranks.size}: give each process seeds of its own."
        )
    return PopulationFolder(configs, ranks, Path(together or Path(configs[0].run.folder).parent))


def with_seeds(config: Training) -> list[Training]:
    """A configuration for each of ``seeds`` learners, of ``seed``, ``seed + 1`` ..., in folders beneath the run's."""
    if config.seeds is None or config.seeds < 1:
        raise ValueError(f"seeds must be at least 1, got {config.seeds}.")
    base = Path(config.run.folder)
    made = []
    for seed in range(config.seed, config.seed + config.seeds):
        run = replace(
            config.run,
            folder=str(base / f"seed-{seed}"),
            wandb_group=config.run.wandb_group or base.name,
        )
        made.append(replace(deepcopy(config), seed=seed, seeds=None, run=run))
    return made


class PopulationFolder:
    """The folders of several learners, with the interface of the folder of one.

    Args:
        configs: of each learner, with folders of their own.
        ranks: this process, alone.
        path: of what the learners share: their checkpoints.

    Raises:
        ValueError: if they cannot share every call, or two have one folder. New folders are taken away again then.
        MemoryError: if their replay buffers do not fit; says how many would.
        FileExistsError, FileNotFoundError: as ``RunFolder``.

    Attributes:
        path: of what the learners share.
        members: the learners' folders.
        resuming: whether there is something to go on from.
    """

    def __init__(self, configs: Sequence[Training], ranks: Ranks, path: Path) -> None:
        check_alike(configs)
        folders = [config.run.folder for config in configs]
        if len(set(folders)) < len(folders):
            raise ValueError(f"every learner needs a folder of its own, got {sorted(folders)}.")
        check_memory(configs)
        self.path = path
        resume = configs[0].run.resume
        if resume is True and not any(Path(folder).exists() for folder in folders):
            raise FileNotFoundError(f"{path} holds no run to resume.")
        if not any(Path(folder).exists() for folder in folders):
            check_actions(configs)
        self.members: list[RunFolder] = []
        unmade = [resolved(config) for config in configs if not (Path(config.run.folder) / MAP_FILE).exists()]
        maps = MapsOfRuns(unmade)
        with ExitStack() as undo:
            for config in configs:
                run = replace(config.run, resume="auto" if resume is True else resume)
                fresh = not Path(run.folder).exists()
                self.members.append(RunFolder(replace(config, run=run), ranks, maps))
                if fresh:
                    undo.callback(shutil.rmtree, run.folder, ignore_errors=True)
                undo.callback(self.members[-1].close)
            MapsSideBySide(self.maps)  # whether they go together
            undo.pop_all()
        self.resuming = any(member.resuming for member in self.members)

    @property
    def config(self) -> Training:
        """The first learner's configuration, for the settings that all share."""
        return self.members[0].config

    @property
    def configs(self) -> list[Training]:
        """Of every learner."""
        return [member.config for member in self.members]

    @property
    def maps(self) -> list[nht.ActionMap]:
        """Of every learner."""
        return [member.map for member in self.members]

    @property
    def whole(self) -> bool:
        """Whether every learner got to its end, or was given up."""
        return all(member.whole or diverged(member.path) is not None for member in self.members) and any(
            member.whole for member in self.members
        )

    @property
    def charted(self) -> bool:
        """Whether any learner is shown on W&B."""
        return any(member.charted for member in self.members)

    def chart_each(self, frames: int, rows: Sequence[Row]) -> None:
        """Chart a row between two tests, of every learner that goes on."""
        for member, row in zip(self.members, rows, strict=True):
            if diverged(member.path) is None and not member.whole:
                member.chart_each(frames, [row])

    def log_each(
        self, frames: int, rows: Sequence[Row | FloatingPointError], latest: Sequence[Row] = ()
    ) -> None:
        """Append a row to every learner's metrics; one that diverged is noted, and gets no more.

        Raises:
            FloatingPointError: if all have diverged.
        """
        going_on = 0
        charted: Sequence[Row | None] = latest or [None] * len(rows)
        for member, row, chart in zip(self.members, rows, charted, strict=True):
            if diverged(member.path) is not None or member.whole:
                going_on += member.whole
            elif isinstance(row, FloatingPointError):
                note = {FRAMES: frames, "reason": str(row)}
                with replacing(member.path / DIVERGED_FILE) as scratch:
                    scratch.write_text(json.dumps(note))
            else:
                member.log(frames, row, chart)
                going_on += 1
        if not going_on:
            raise FloatingPointError(
                f"all {len(rows)} learners diverged; the first: {diverged(self.members[0].path)}"
            )

    def rewind(self, frames: int) -> None:
        """Drop what was written behind ``frames``: it is written again."""
        for member in self.members:
            note = member.path / DIVERGED_FILE
            if note.exists() and read_json(note).get(FRAMES, 0) > frames:
                note.unlink()
            if not member.whole:
                member.rewind(frames)

    def finished(self) -> list[tuple[int, RunFolder]]:
        """The learners that got to the end, with their numbers, as far as they are not noted as whole yet."""
        return [
            (learner, member)
            for learner, member in enumerate(self.members)
            if diverged(member.path) is None and not member.whole
        ]

    def show(self) -> None:
        """Print the outcome of every learner and where the files are."""
        rows = []
        for member in self.members:
            reason = diverged(member.path)
            last: Any = pandas.read_csv(member.metrics).iloc[-1] if member.metrics.exists() else {}
            rows.append(
                {"learner": self._named(member), **{name: last.get(name) for name in (FRAMES, *TESTED)}}
                | ({"diverged": reason} if reason is not None else {})
            )
        print(pandas.DataFrame(rows).to_string(index=False))
        print(f"\n{self.path}: {len(self.members)} learners, each in a folder of its own")

    def _named(self, member: RunFolder) -> str:
        inside = member.path.is_relative_to(self.path)
        return str(member.path.relative_to(self.path) if inside else Path(*member.path.parts[-2:]))

    def close(self) -> None:
        """Release all folders."""
        for member in self.members:
            member.close()


def check_actions(configs: Sequence[Training]) -> None:
    """Check that the learners' policies have as many actions, before any of their maps is trained.

    Raises:
        FileNotFoundError, ValueError: if not; names the learner. As ``number_of_actions``, if a map cannot be made.
    """
    env = base_env(configs[0].env, seed=0, num_envs=1)
    motors, seen = env.action_spec.shape[-1], env.observation_spec
    env.close()
    first = None
    for learner, config in enumerate(configs):
        keys = [key for key in map_context_keys(config.map, config.env) if key in seen.keys(True, True)]
        count = number_of_actions(config, motors, sum(seen[key].shape[-1] for key in keys))
        first = count if first is None else first
        if count != first:
            raise ValueError(
                f"learners of one population share action_dim: the map of learner 0 has {first}, that of learner "
                f"{learner} has {count}."
            )


def diverged(folder: Path) -> str | None:
    """Why the learner of that folder diverged; None if it did not.

    Raises:
        ValueError: if the note cannot be read.
    """
    note = folder / DIVERGED_FILE
    if not note.exists():
        return None
    record: dict[str, Any] = read_json(note)
    return str(entry(record, "reason", str, str(note)))
