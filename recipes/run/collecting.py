"""TorchRL's collectors, in this process or in several workers that each step a share of the copies."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from typing import Any, Protocol, cast

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import BaseCollector, Collector, MultiSyncCollector
from torchrl.envs import TransformedEnv

from nht.recipes.run.parent import serve
from nht.recipes.sections import CollectorConfig
from nht.recipes.torchrl_internals import FirstComeCollector, carrier, count_frames_from, counted_frames


class MakeEnv(Protocol):
    """Makes environments whose policy acts in [-1, 1]^k."""

    def __call__(self, *, seed: int | Sequence[int]) -> TransformedEnv:
        """Environments seeded by ``seed``; several seeds give those of as many learners."""


def make_collector(
    config: CollectorConfig,
    env: TransformedEnv,
    make_env: MakeEnv,
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    seed: int,
    random_frames: int = 0,
) -> BaseCollector:
    """The collector that ``config`` asks for; its batches are ``(copies, steps)`` and never end.

    Args:
        config: which collector, and of how many workers.
        env: a worker's copies; the single collector steps these themselves.
        make_env: makes more of them, in the workers.
        policy: what acts, exploration included. Workers get its weights when ``update_policy_weights_`` is called.
        frames_per_batch: of all workers together (sync), of the one that is ready first (async).
        seed: from which the workers' seeds are derived.
        random_frames: number of steps at the start with uniform actions.
    """
    settings = {
        "frames_per_batch": frames_per_batch,
        "total_frames": -1,
        "init_random_frames": random_frames,
        "device": env.device,  # said aloud, it saves a cast in every step
        "auto_register_policy_transforms": True,
    }
    if config.kind == "single":
        return Collector(env, policy, **settings, track_traj_ids=False)
    makers = [
        partial(_in_worker, make_env, worker_seed(seed, worker), os.getpid())
        for worker in range(config.num_workers)
    ]
    if config.kind == "multi_sync":
        return MultiSyncCollector(makers, policy, **settings, cat_results=0)
    return FirstComeCollector(makers, policy, **settings)


def batch_copies(collector: BaseCollector, copies: int) -> slice:
    """The copies of a learner that the latest batch comes from: all, or the ``copies`` of one worker."""
    if not isinstance(collector, FirstComeCollector):
        return slice(None)
    return slice(collector.latest * copies, (collector.latest + 1) * copies)


def worker_seed(seed: int, *place: int) -> int:
    """A seed for one of several users of random numbers, derived from its place among them."""
    return int(np.random.SeedSequence([seed, *place]).generate_state(1)[0])


def _in_worker(make_env: MakeEnv, seed: int, parent: int) -> TransformedEnv:
    if os.getpid() != parent:
        serve(parent)
    torch.set_num_threads(1)
    torch.manual_seed(seed)  # of this process: the exploration noise
    return make_env(seed=seed)


class CollectorState:
    """The state of a collector between two batches, for checkpoints: observation, exploration noise, counted steps.

    Workers keep theirs to themselves, and so do simulators that cannot be saved: they go on with new episodes, on seeds
    that follow from how far the run has come.

    Args:
        collector: whose state it is.
        seed: that the seeds of new episodes follow from.
        exact: whether the simulator behind it can be saved, so that episodes go on.
    """

    def __init__(self, collector: BaseCollector, seed: int, *, exact: bool = True) -> None:
        self._collector, self._seed = collector, seed
        self._exact = exact and isinstance(collector, Collector)

    def state_dict(self) -> dict[str, Any]:
        """Every entry that the next step starts from, and the number of steps so far."""
        saved: dict[str, Any] = {"frames": counted_frames(self._collector)}
        if self._exact:
            saved["carrier"] = carrier(cast(Collector, self._collector)).to_dict()
        return saved

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Start the next step from ``saved``."""
        count_frames_from(self._collector, saved["frames"])
        if self._exact:
            carrier(cast(Collector, self._collector)).update(saved["carrier"])
        else:
            cast(Any, self._collector).set_seed(worker_seed(self._seed, saved["frames"]))
