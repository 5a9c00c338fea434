"""What a run of any algorithm has around its loop."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.collectors import BaseCollector, Collector
from tqdm import tqdm

import nht
from nht.recipes.agents.networks import save_policy
from nht.recipes.config import Training
from nht.recipes.run.checkpoints import Checkpoints
from nht.recipes.run.collecting import CollectorState, batch_copies, make_collector, worker_seed
from nht.recipes.run.environments import mapped_env, run_map, test_env
from nht.recipes.run.evaluation import Evaluation
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.statistics import Counters, TrainingStatistics
from nht.recipes.run.video import record_video

VIDEO_EPISODES = 3


class TrainingRun:
    """Seeds, folder, action map and environments of a run; its counters, rows of metrics and checkpoints.

    Under torchrun every process has one: copies, batches and buffers are divided among them, and the first one writes
    the files that there is only one of.

    Args:
        config: the run's whole configuration.
        losses: what an update reports, by name; each becomes a column of ``metrics.csv``.

    Raises:
        ValueError: if the number of processes does not divide the copies and what is made of them.

    Attributes:
        ranks: the processes that learn together.
        device: where this one learns.
        copies: how many copies of the task are this process's.
        env: the task through the run's action map, to train on; of parallel collectors, the copies of one worker.
        tests: the same with one copy for each test episode, on seeds of its own.
        counters: environment steps and gradient steps so far, the steps of all processes.
    """

    def __init__(self, config: Training, losses: Sequence[str]) -> None:
        torch.set_num_threads(config.torch_threads)
        torch.manual_seed(config.seed)
        self.ranks = Ranks(config.device)
        self.device = self.ranks.device
        self._config = config = replace(config, device=str(self.device))
        self.copies = self.ranks.share("env.num_envs", config.env.num_envs)
        self._frames_per_batch = self.ranks.share("algo.frames_per_batch", config.algo.frames_per_batch)
        self._path = Path(config.run.folder)
        self._folder = self._open_folder() if self.ranks.first else None
        self._resuming = self.ranks.any(self._folder is not None and self._folder.resuming)
        self._map = self._shared_map()
        self._make_env = partial(
            mapped_env,
            config.env,
            self._map,
            config.map.action_scale,
            num_envs=self._copies_per_worker(),
            device=self.device,
        )
        self.env = self._make_env(seed=self._seed)
        self.tests = test_env(config, self._map, config.evaluation.episodes)
        self.counters = Counters()
        self._statistics = TrainingStatistics(self.env.base_env.action_spec.space, losses)
        self._stopping = False

    def _open_folder(self) -> RunFolder:
        config: Training = self._config
        run = config.run
        # Processes that torchrun starts anew find the run that they were in.
        return RunFolder(replace(run, resume=run.resume or "auto") if self.ranks.restarts else run, config)

    def _shared_map(self) -> nht.ActionMap:
        """The run's map, which the first process gets ready."""
        if self.ranks.first:
            run_map(self._config, self._path)
        self.ranks.wait()
        return run_map(self._config, self._path)

    @property
    def _seed(self) -> int:
        """This process's own."""
        return worker_seed(self._config.seed, self.ranks.rank) if self.ranks.rank else self._config.seed

    def _copies_per_worker(self) -> int:
        config: Training = self._config
        workers = config.collector.num_workers
        if self.copies % workers:
            raise ValueError(
                f"collector.num_workers={workers} cannot share alike the {self.copies} copies that "
                f"env.num_envs={config.env.num_envs} leaves each of {self.ranks.size} processes."
            )
        return self.copies // workers

    def collector(self, policy: TensorDictModuleBase, random_frames: int = 0) -> BaseCollector:
        """The collector of this process's batches ``(copies, steps)``, in which ``policy`` acts."""
        config: Training = self._config
        if self.ranks.rank:  # the networks are made, alike in all processes; exploration differs
            torch.manual_seed(self._seed)
        self._policy = policy
        return make_collector(
            config.collector,
            self.env,
            self._make_env,
            policy,
            frames_per_batch=self._frames_per_batch,
            seed=self._seed,
            random_frames=random_frames // self.ranks.size,
        )

    @contextmanager
    def training(
        self, collector: BaseCollector, loss: nn.Module, **parts: Any
    ) -> Iterator[Iterator[TensorDictBase]]:
        """Begin, or go on where the run stopped; within, SIGTERM ends the run after a last checkpoint.

        Args:
            collector: of the training's batches.
            loss: whose parameters are trained; all processes start with the first one's.
            parts: what else the algorithm goes on from, each with a ``state_dict`` and a ``load_state_dict``.

        Returns:
            the batches ``(copies, steps)`` until all steps are made. When the next one is asked for, workers get the
            policy as it is, and checkpoints are written now and then.

        Raises:
            FileNotFoundError: if there is nothing to go on from.
            ValueError: if the run has been finished already, or was made by another number of processes.
            OSError: if there is no room for a checkpoint; earlier ones stay as they are.
            SystemExit: after the last checkpoint, if the process was told to end.
        """
        config: Training = self._config
        before: Any = None
        try:
            self._collector = collector
            self._checkpoints = self._make_checkpoints(loss=loss, **parts)
            if self._resuming:
                self._go_on()
            self.ranks.broadcast(loss)
            if threading.current_thread() is threading.main_thread():  # elsewhere Python knows no signals
                before = signal.signal(signal.SIGTERM, self._stop)
            self._before = before
            self._progress = tqdm(
                total=config.algo.total_frames,
                initial=self.counters.frames,
                desc=self._path.name,
                unit="step",
                unit_scale=True,
                disable=not self.ranks.first,
            )
            yield self._batches()
        finally:
            if before is not None:
                signal.signal(signal.SIGTERM, before)
            collector.shutdown()
            if not self.env.is_closed:
                self.env.close()

    def _make_checkpoints(self, **parts: Any) -> Checkpoints:
        collector = self._collector
        if isinstance(collector, Collector):
            parts["simulator"] = self.env.base_env.task
        return Checkpoints(
            self._path / "checkpoints" / self._rank_folder,
            **parts,
            collector=CollectorState(collector, self._seed),
            test_simulator=self.tests.base_env.task,
            counters=self.counters,
            statistics=self._statistics,
        )

    @property
    def _rank_folder(self) -> str:
        return f"rank-{self.ranks.rank}" if self.ranks.size > 1 else ""

    def _go_on(self) -> None:
        """Load the newest checkpoint that all processes have."""
        config: Training = self._config
        made_by = len(list((self._path / "checkpoints").glob("rank-*"))) or 1
        if made_by != self.ranks.size and (self._path / "checkpoints").exists():
            raise ValueError(
                f"{self._path} holds the checkpoints of {made_by} processes: {self.ranks.size} cannot go on from them."
            )
        common = set.intersection(*map(set, self.ranks.gather(self._checkpoints.steps())))
        if common:
            self._checkpoints.load(max(common))
        elif config.run.resume is True:
            raise FileNotFoundError(f"{self._path} holds no checkpoint to resume from.")
        if self.finished and (self._path / "policy.safetensors").exists():
            raise ValueError(
                f"{self._path} has made its {self.counters.frames} steps: raise algo.total_frames to go on."
            )
        if self._folder is not None:
            self._folder.rewind(self.counters.frames)

    def _stop(self, *_: Any) -> None:
        self._stopping = True
        signal.signal(signal.SIGTERM, self._before)  # the second one acts at once

    def _batches(self) -> Iterator[TensorDictBase]:
        batches = iter(self._collector)
        while not self.finished:
            yield next(batches)
            if not isinstance(self._collector, Collector):
                self._collector.update_policy_weights_(self._policy)
            self._save_if_due()

    def _save_if_due(self) -> None:
        config: Training = self._config
        self._stopping = self.ranks.any(self._stopping)
        if self._stopping or self.counters.frames % config.run.checkpoint_every == 0:
            self._checkpoints.save(self.counters.frames)
        if self._stopping and not self.finished:
            self._progress.close()
            if self.ranks.first:
                print(f"{self._path} was told to end: go on with run.resume=true.")
            sys.exit(128 + signal.SIGTERM)

    @property
    def batch_copies(self) -> slice:
        """Which of this process's copies made the latest batch."""
        return batch_copies(self._collector, self.env.batch_size.numel())

    def count_steps(self, data: TensorDictBase) -> None:
        """Take collected steps ``(*batch,)`` into counters and statistics."""
        steps = data.numel() * self.ranks.size
        self.counters.frames += steps
        self._statistics.add_steps(data.reshape(-1))
        self._progress.update(steps)

    def count_update(self, losses: TensorDictBase) -> None:
        """Take a gradient step into counters and statistics."""
        self.counters.updates += 1
        self._statistics.add_losses(losses)

    @property
    def evaluation_due(self) -> bool:
        """Whether it is time to test the policy."""
        config: Training = self._config
        return self.counters.frames % config.evaluation.every == 0

    def log(self, outcome: Evaluation) -> None:
        """Write a row of metrics: the training of all processes since the last one, and an evaluation."""
        row = self._statistics.take(self.ranks.sum) | outcome.metrics() | {"updates": self.counters.updates}
        if self._folder is not None:
            self._folder.log(self.counters.frames, row)
        shown = {"return": row["eval_return"]}
        if row["eval_success"] > 0:  # never, where a task has no notion of success
            shown["success"] = row["eval_success"]
        self._progress.set_postfix(shown)

    @property
    def finished(self) -> bool:
        """Whether all steps are made."""
        config: Training = self._config
        return self.counters.frames >= config.algo.total_frames

    def finish(self, policy: TensorDictModuleBase) -> None:
        """Save and film the policy, close everything, and say what happened."""
        config: Training = self._config
        self.tests.close()
        self._progress.close()
        if self._folder is not None:
            save_policy(policy, self._path)
            if config.evaluation.video:
                self._film(policy)
            self._folder.finish()
        self.ranks.part()

    def _film(self, policy: TensorDictModuleBase) -> None:
        try:
            filmed = test_env(self._config, self._map, VIDEO_EPISODES)
            record_video(filmed, policy, self._path / "video.mp4")
        except RuntimeError as error:  # a machine without OpenGL trains all the same
            print(f"no video: {error}")
