"""Runs of a search that train together: as one population of learners, in one process."""

from __future__ import annotations

import contextlib
import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from zlib import crc32

from nht.reading import read_json
from nht.recipes.agents.table import find_algorithm
from nht.recipes.launch import configure
from nht.recipes.maps.kinds import find_kind
from nht.recipes.quiet import quiet_libraries
from nht.recipes.run.ownership import OwnedError, claimed
from nht.recipes.run.population import diverged
from nht.recipes.study.dashboard_names import names_of
from nht.recipes.study.jobs import Ending, Job, run_job
from nht.writing import replacing


@dataclass(frozen=True)
class Pack:
    """Runs whose learners are of one shape.

    Attributes:
        jobs: the runs, of one stage.
    """

    jobs: tuple[Job, ...]

    @property
    def name(self) -> str:
        """The pack's name, derived from its runs."""
        if len(self.jobs) == 1:
            return self.jobs[0].name
        return f"packs/{self.jobs[0].stage}-{crc32(' '.join(job.name for job in self.jobs).encode()):08x}"

    def halves(self) -> tuple[Pack, Pack]:
        """The pack split into two."""
        middle = len(self.jobs) // 2
        return Pack(self.jobs[:middle]), Pack(self.jobs[middle:])


def in_packs(jobs: Sequence[Job], learners: int) -> list[Pack]:
    """All runs of a stage in packs of at most ``learners``, grouped by similar batch size.

    Raises:
        ValueError: if the algorithm trains one learner at a time.
    """
    varies = find_algorithm(jobs[0].recipe).schema().algo.varies
    if learners > 1 and not varies:
        raise ValueError(
            f"search.learners={learners} needs an algorithm that trains several: {jobs[0].recipe} trains one."
        )
    alike: dict[str, list[Job]] = {}
    for job in jobs:
        alike.setdefault(_shape(job, varies), []).append(job)
    packs = []
    for members in alike.values():
        members.sort(key=lambda job: float(job.parameters.get("algo.batch_size", 0)))  # little is filled up
        packs += [Pack(tuple(members[at : at + learners])) for at in range(0, len(members), learners)]
    return packs


def _shape(job: Job, varies: Sequence[str]) -> str:
    """A key that is equal for runs whose learners can train together."""
    own = {f"algo.{name}" for name in varies}
    shared = {
        name: value
        for name, value in job.parameters.items()
        if name not in own and not name.startswith("map.")
    }
    kind = find_kind("none" if job.interface == "raw" else job.interface)
    width = job.interface if kind.fixed_width else "as told"
    frames = [word for word in job.overrides if word.startswith("algo.total_frames=")]
    return json.dumps([job.recipe, job.env, job.stage, width, frames, shared], sort_keys=True)


def run_pack(pack: Pack, folder: Path) -> None:
    """Train the learners of a pack together, or resume where another process stopped; outcomes are recorded.

    Runs that have ended are left out. A pack that fails, for lack of memory or because of one of its runs, is halved
    and both halves are trained, so that one bad run does not cost the others. A run that another process works on is
    left to it.

    Args:
        pack: what to run.
        folder: of the search.
    """
    if len(pack.jobs) == 1:
        run_job(pack.jobs[0], folder)
        return
    with claimed(folder / "claims" / pack.name.replace("/", "-")) as ours:
        if not ours:
            return
        members = _members(pack, folder)
        endings: dict[str, Ending] = {}
        try:
            if len(members) < 2:
                raise _NotTogetherError
            endings = _train_together(members, folder, folder / pack.name)
        except OwnedError:
            return
        except _NotTogetherError:
            for half in (
                Pack(tuple(members)).halves() if len(members) > 1 else [Pack((job,)) for job in members]
            ):
                run_pack(half, folder)
        # Buffers are large. First, for nobody looks there again once the outcomes stand.
        shutil.rmtree(folder / pack.name / "checkpoints", ignore_errors=True)
        (folder / pack.name / "members.json").unlink(missing_ok=True)
        for name, ending in endings.items():
            ending.write(folder / name)


class _NotTogetherError(Exception):
    """Raised if runs cannot be trained together."""


def _members(pack: Pack, folder: Path) -> list[Job]:
    """The runs that train together: the same when the pack is resumed, as its checkpoints are of these."""
    note = folder / pack.name / "members.json"
    if note.exists():
        names = read_json(note).get("members", [])
        return [job for job in pack.jobs if job.name in names]
    members = [job for job in pack.jobs if Ending.read(folder / job.name) is None]
    with replacing(note) as scratch:
        scratch.write_text(json.dumps({"members": [job.name for job in members]}))
    return members


def _train_together(jobs: Sequence[Job], folder: Path, together: Path) -> dict[str, Ending]:
    """Train the learners of these runs, and give the outcome of each by its name."""
    algorithm = find_algorithm(jobs[0].recipe)
    configs = [
        configure(
            algorithm.schema,
            job.recipe,
            [*job.overrides, *names_of(job, folder), f"run.folder={folder / job.name}", "run.resume=auto"],
        )
        for job in jobs
    ]
    begun = time.process_time()
    reason = ""
    with (
        (together / "train.log").open("a") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        quiet_libraries()
        try:
            algorithm.train(*configs, together=str(together))
        except OwnedError:
            raise
        except FloatingPointError as error:  # every learner diverged, and that is noted; or a map did
            reason = str(error)
        except Exception as error:  # whatever it is, the runs may do better apart
            print(f"{type(error).__name__}: {error}")
            raise _NotTogetherError from error
    if any(diverged(folder / job.name) is None for job in jobs) and reason:
        raise _NotTogetherError
    spent = (time.process_time() - begun) / len(jobs)
    reasons = {job.name: diverged(folder / job.name) for job in jobs}
    return {
        name: Ending("done", "", spent) if why is None else Ending("diverged", why, spent)
        for name, why in reasons.items()
    }
