"""What a run of any algorithm has around its loop."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector

from nht.recipes.checkpoints import Checkpoints
from nht.recipes.config import Training
from nht.recipes.environments import mapped_env, run_map, test_env
from nht.recipes.evaluation import Evaluation
from nht.recipes.networks import save_policy
from nht.recipes.progress import CollectorState, Counters, TrainingStatistics
from nht.recipes.run_folder import RunFolder
from nht.recipes.video import record_video

VIDEO_EPISODES = 3


class TrainingRun:
    """Seeds, folder, action map and environments of a run; its counters, rows of metrics and checkpoints.

    Args:
        config: the run's whole configuration.
        losses: what an update reports, by name; each becomes a column of ``metrics.csv``.

    Attributes:
        env: the task through the run's action map, to train on.
        tests: the same with one copy for each test episode, on seeds of its own.
        counters: environment steps and gradient steps so far.
    """

    def __init__(self, config: Training, losses: Sequence[str]) -> None:
        torch.set_num_threads(config.torch_threads)
        torch.manual_seed(config.seed)
        self._config = config
        self._folder = RunFolder(config.run, config)
        self._map = run_map(config, self._folder.path)
        self.env = mapped_env(
            config.env, self._map, config.map.action_scale, seed=config.seed, device=config.device
        )
        self.tests = test_env(config, self._map, config.evaluation.episodes)
        self.counters = Counters()
        self._statistics = TrainingStatistics(self.env.base_env.action_spec.space, losses)
        self._stopping = False
        self._before: Any = None  # what SIGTERM did before this run

    def start(self, collector: Collector, **parts: Any) -> None:
        """Begin, or go on where the run stopped. From now on SIGTERM ends the run after a last checkpoint.

        Args:
            collector: of the training's batches.
            parts: what else the algorithm goes on from, each with a ``state_dict`` and a ``load_state_dict``.

        Raises:
            ValueError: if the run has made all its steps already.
        """
        config: Training = self._config
        self._collector = collector
        self._checkpoints = Checkpoints(
            self._folder.path / "checkpoints",
            **parts,
            collector=CollectorState(collector),
            simulator=self.env.base_env.task,
            test_simulator=self.tests.base_env.task,
            counters=self.counters,
            statistics=self._statistics,
        )
        if self._folder.resuming:
            if not self._checkpoints.load() and config.run.resume != "auto":
                raise FileNotFoundError(f"{self._folder.path} holds no checkpoint to resume from.")
            self._folder.rewind(self.counters.frames)
        if self.finished:
            raise ValueError(
                f"{self._folder.path} has made its {self.counters.frames} steps: raise algo.total_frames to go on."
            )
        self._progress = self._folder.progress_bar(config.algo.total_frames, self.counters.frames)
        if threading.current_thread() is threading.main_thread():  # elsewhere Python knows no signals
            self._before = signal.signal(signal.SIGTERM, self._stop)

    def _stop(self, *_: Any) -> None:
        self._stopping = True
        signal.signal(signal.SIGTERM, self._before)  # the second one acts at once

    def count_steps(self, data: TensorDictBase) -> None:
        """Take collected steps ``(*batch,)`` into counters and statistics."""
        self.counters.frames += data.numel()
        self._statistics.add_steps(data.reshape(-1))
        self._progress.update(data.numel())

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
        """Write a row of metrics: the training since the last one, and an evaluation."""
        row = self._statistics.take() | outcome.metrics() | {"updates": self.counters.updates}
        self._folder.log(self.counters.frames, row)
        shown = {"return": row["eval_return"]}
        if row["eval_success"] > 0:  # never, where a task has no notion of success
            shown["success"] = row["eval_success"]
        self._progress.set_postfix(shown)

    def save_if_due(self) -> None:
        """Write a checkpoint, now and then.

        Raises:
            OSError: if there is no room; earlier checkpoints stay as they are.
            SystemExit: after the last one, if the process was told to end.
        """
        config: Training = self._config
        if self._stopping or self.counters.frames % config.run.checkpoint_every == 0:
            self._checkpoints.save(self.counters.frames)
        if self._stopping and not self.finished:
            self._progress.close()
            print(f"{self._folder.path} was told to end: go on with run.resume=true.")
            sys.exit(128 + signal.SIGTERM)

    @property
    def finished(self) -> bool:
        """Whether all steps are made."""
        config: Training = self._config
        return self.counters.frames >= config.algo.total_frames

    def finish(self, policy: TensorDictModule) -> None:
        """Save and film the policy, close everything, and say what happened."""
        config: Training = self._config
        if self._before is not None:
            signal.signal(signal.SIGTERM, self._before)
        self._collector.shutdown()
        self.tests.close()
        self._progress.close()
        save_policy(policy, self._folder.path)
        if config.evaluation.video:
            try:
                filmed = test_env(config, self._map, VIDEO_EPISODES)
                record_video(filmed, policy, self._folder.path / "video.mp4")
            except RuntimeError as error:  # a machine without OpenGL trains all the same
                print(f"no video: {error}")
        self._folder.finish()
