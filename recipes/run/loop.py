"""The training loop around the updates: batches, checkpoints, signals, and the end of a run."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import BaseCollector, Collector

from nht.recipes.agents.policy import save_policy
from nht.recipes.agents.stacking import of_learner
from nht.recipes.run.checkpoints import Checkpoints
from nht.recipes.run.collecting import CollectorState, batch_copies, make_collector
from nht.recipes.run.environments import RunEnvs
from nht.recipes.run.filming import Filming
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.learners import Learners
from nht.recipes.run.population import PopulationFolder
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.record import Record
from nht.recipes.run.workers import WorkerEndedError, Workers

SIGNALS = (signal.SIGTERM, signal.SIGINT)
"""Signals that end a run, after a last checkpoint."""
ECHO = 3.0
"""Seconds within which a second signal is the first one's echo: ``timeout`` sends it to the process and to its group,
and torchrun hands it on."""


class Loop:
    """Collects the batches of a run, and writes its checkpoints.

    Args:
        folder: of the run.
        ranks: the processes that learn together.
        envs: the run's environments.
        record: of the run.
        policy: what acts, exploration included.
        loss: whose parameters are trained; all processes start with the first one's.
        learners: whose folders, environments and networks these are, if they may be several.
        random_frames: number of steps of all processes at the start with uniform actions.
        parts: what else the algorithm goes on from, each with a ``state_dict`` and a ``load_state_dict``.

    Attributes:
        collector: of this process's batches ``(copies, steps)``.
    """

    def __init__(
        self,
        folder: RunFolder | PopulationFolder,
        ranks: Ranks,
        envs: RunEnvs,
        record: Record,
        policy: TensorDictModuleBase,
        loss: nn.Module,
        *,
        learners: Learners[Any] | None = None,
        random_frames: int = 0,
        **parts: Any,
    ) -> None:
        config = folder.config
        self._learners = learners
        many = (learners.count if learners is not None else None) or 1
        self._folder, self._ranks, self._envs, self._record = folder, ranks, envs, record
        self._policy, self._loss = policy, loss
        self._every = config.run.checkpoint_every
        self._signal: int | None = None
        self._told_at = 0.0  # by the clock that never goes back [s]
        ranks.part_ways(envs.seed)  # the networks are made, alike in all processes; exploration differs
        self._random_frames = random_frames
        acting = policy if learners is None else learners.exploring(policy)
        with self._drawing():  # a collector tries environment and policy
            self.collector: BaseCollector = make_collector(
                config.collector,
                envs.train,
                envs.make,
                acting,
                frames_per_batch=many * ranks.share("algo.frames_per_batch", config.algo.frames_per_batch),
                seed=envs.seed,
                random_frames=many * random_frames // ranks.size,
            )
        self._alone = isinstance(self.collector, Collector)
        simulation = envs.train.base_env.task
        if self._alone:
            parts["simulator"] = simulation
        if learners is not None and learners.draws is not None:
            parts["draws"] = learners.draws
        if ranks.first and not simulation.can_resume:
            print(
                f"{folder.path.name}: {simulation.resume_obstacle}. A run that is stopped goes on with new episodes."
            )
        self._checkpoints = Checkpoints(
            folder.path / "checkpoints" / ranks.folder,
            learners=None if learners is None else learners.count,
            loss=loss,
            **parts,
            collector=CollectorState(self.collector, envs.seed, exact=simulation.can_resume),
            test_simulator=envs.test.base_env.task,
            counters=record.counters,
            statistics=record.statistics,
        )

    @contextmanager
    def batches(self) -> Iterator[Iterator[TensorDictBase]]:
        """Begin, or go on where the run stopped; within, SIGTERM and SIGINT end the run after a last checkpoint.

        Returns:
            the batches ``(copies, steps)`` until all steps are made. When the next one is asked for, workers get the
            policy as it is, and checkpoints are written now and then.

        Raises:
            FileNotFoundError: if there is nothing to go on from.
            ValueError: if the run was made by another number of processes.
            OSError: if there is no room for a checkpoint; earlier ones stay as they are.
            WorkerEndedError: after a last checkpoint, if a worker has died.
            SystemExit: after the last checkpoint, if the process was told to end.
        """
        before: dict[int, Any] = {}
        try:
            if self._folder.resuming:
                self._go_on()
            self._ranks.broadcast(self._loss)
            if threading.current_thread() is threading.main_thread():  # elsewhere Python knows no signals
                before = {number: signal.signal(number, self._stop) for number in SIGNALS}
            self._record.show_progress()
            yield self._batches()
        except BaseException:
            self._folder.close()
            raise
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
            self.collector.shutdown()
            self._envs.close()
            self._record.close()

    def _go_on(self) -> None:
        """Load the newest checkpoint that all processes have."""
        folder, ranks = self._folder, self._ranks
        made_by = len(list((folder.path / "checkpoints").glob("rank-*"))) or 1
        if made_by != ranks.size and (folder.path / "checkpoints").exists():
            raise ValueError(
                f"{folder.path} holds the checkpoints of {made_by} processes: {ranks.size} cannot go on from them."
            )
        common = set.intersection(*map(set, ranks.gather(self._checkpoints.steps())))
        if common:
            self._checkpoints.load(max(common))
            if not (self._alone and self._envs.train.base_env.task.can_resume):
                self._record.statistics.forget_episodes()  # they begin anew
        elif folder.config.run.resume is True:
            raise FileNotFoundError(f"{folder.path} holds no checkpoint to resume from.")
        folder.rewind(self._record.frames)

    def _stop(self, number: int, _: Any) -> None:
        now = time.monotonic()
        if self._signal is None:
            self._signal, self._told_at = number, now
        elif now - self._told_at > ECHO:  # asked again
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)

    def _batches(self) -> Iterator[TensorDictBase]:
        if self._alone:
            batches = iter(self.collector)
            while not self._record.finished:
                random = self._record.frames < self._random_frames  # the collector itself draws actions then
                with self._drawing() if random else nullcontext():
                    batch = next(batches)
                self._record.copies = self.batch_copies
                yield batch
                self._save_if_due()
            return
        workers = Workers(self.collector, self._ranks.device)
        while not self._record.finished:
            with self._saving():
                batch = workers.next()
            self._record.copies = self.batch_copies
            yield batch
            with self._saving():
                workers.update(self._policy)
            self._save_if_due()

    def _drawing(self) -> AbstractContextManager[Any]:
        """Within, every learner draws from its own generator."""
        return nullcontext() if self._learners is None else self._learners.drawing()

    @contextmanager
    def _saving(self) -> Iterator[None]:
        """Between two batches: if a worker dies, a last checkpoint is written."""
        try:
            yield
        except WorkerEndedError as error:
            if self._record.frames:
                self._checkpoints.save(self._record.frames)
            raise WorkerEndedError(f"{error} Go on with run.resume=auto.") from error

    def _save_if_due(self) -> None:
        stopping = self._ranks.any(self._signal is not None)
        if stopping or self._record.frames % self._every == 0:
            self._checkpoints.save(self._record.frames)
        if stopping and not self._record.finished:
            self._record.close()
            if self._ranks.first:
                print(f"{self._folder.path} was told to end: go on with run.resume=true.")
            sys.exit(128 + (self._signal or signal.SIGTERM))

    @property
    def batch_copies(self) -> slice:
        """The copies of this process that the latest batch comes from."""
        return batch_copies(self.collector, self._envs.train.batch_size.numel())

    def finish(self, policy: TensorDictModuleBase) -> None:
        """Save and film the policy of every learner, close everything, and print a summary."""
        folder = self._folder
        filming = Filming(folder, self._ranks, self._envs)
        for learner, member in folder.finished():
            if self._ranks.first:
                state = policy.state_dict()
                many = len(folder.members) > 1
                save_policy(of_learner(state, learner) if many else state, member.path)
                filming.at_the_end(learner, member, policy, self._record.frames)
            member.finish(self._record.frames)
        folder.show()
        folder.close()
        self._ranks.part()
