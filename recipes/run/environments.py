"""Environments driven through action maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial

import torch
from torchrl.envs import EnvBase, TransformedEnv

import nht
from nht.envs import FOREIGN, make_env
from nht.envs.table import imported
from nht.recipes.maps.kinds import task_context_keys
from nht.recipes.maps.side_by_side import MapsSideBySide
from nht.recipes.run.collecting import MakeEnv, worker_seed
from nht.recipes.run.ranks import Ranks
from nht.recipes.sections import EnvConfig, Training
from nht.transforms import ActionMapTransform

TEST_SEED = 1_000_000
"""Added to a run's seed for tests, so that test episodes differ from those of training."""


def mapped_env(
    env: EnvConfig,
    map: nht.ActionMap,
    *,
    seed: int | Sequence[int],
    num_envs: int | None = None,
    device: torch.device | str = "cpu",
) -> TransformedEnv:
    """The task, driven through an action map: its policy acts in [-1, 1]^k.

    Args:
        env: which task.
        map: from action and context to actuation; it says what an action means.
        seed: of the task's random draws; several make an environment of batch size ``[seeds, copies]``.
        num_envs: number of copies, if another than the configuration's.
        device: where the tensors go.

    Raises:
        KeyError, ValueError: if the map does not fit the task: the keys or widths of its context, its actuation.
    """
    base = base_env(env, seed=seed, num_envs=num_envs, device=device)
    untold = map.context_dim and map.context_keys is None
    return TransformedEnv(base, ActionMapTransform(map, task_context_keys(env) if untold else None))


def base_env(
    env: EnvConfig,
    *,
    seed: int | Sequence[int],
    num_envs: int | None = None,
    device: torch.device | str = "cpu",
) -> EnvBase:
    """The task itself, driven by actuations; arguments as of ``mapped_env``.

    Raises:
        ImportError: if the suite that the task belongs to is not installed.
        ValueError: for an unknown suite, task or option, or threads where copies are stepped one after the other.
    """
    copies = num_envs or env.num_envs or 1
    if env.suite == "nht":
        return make_env(env.name, copies, env.num_threads, seed=seed, device=device, **env.options)
    if env.suite not in FOREIGN:
        raise ValueError(f"unknown env.suite {env.suite!r}: choose from {['nht', *FOREIGN]}.")
    if env.num_threads != 1:
        raise ValueError(
            f"{env.suite} steps its copies in one thread, got env.num_threads={env.num_threads}."
        )
    made: EnvBase = imported(FOREIGN[env.suite])(env.name, copies, seed, device, **env.options)
    return made


def lasting_failures(env: EnvConfig) -> EnvConfig:
    """The task as it is tested: failures do not end episodes, they last. Not every task knows them."""
    if "terminate_on_failure" not in env.options:
        return env
    return replace(env, options=env.options | {"terminate_on_failure": False})


class RunEnvs:
    """The environments of one of the processes that learn together, or of several learners in one process.

    Args:
        configs: the whole configuration of the run; of several learners, of each.
        maps: their action maps.
        ranks: the processes among which copies are divided.

    Raises:
        ValueError: if the copies cannot be divided among processes and workers, or maps do not go together.

    Attributes:
        learners: how many there are, or None for one alone: the environments' batch size is ``[learners, copies]``.
        copies: how many copies of the task are this process's, for each learner.
        train: the task to train on; of parallel collectors, the copies of one worker.
        test: the same with one copy for each test episode, on seeds of its own; failures last.
        seed: of this process's random draws.
    """

    def __init__(
        self,
        configs: Training | Sequence[Training],
        maps: nht.ActionMap | Sequence[nht.ActionMap],
        ranks: Ranks,
    ) -> None:
        configs = [configs] if isinstance(configs, Training) else configs
        maps = [maps] if isinstance(maps, nht.ActionMap) else maps
        config = configs[0]
        self._config, self._device = config, ranks.device
        self.learners = len(configs) if len(configs) > 1 else None
        self._map = maps[0] if self.learners is None else MapsSideBySide(maps)
        self._seeds = [each.seed for each in configs]
        self.copies = ranks.share("env.num_envs", config.env.num_envs or 1)
        self.seed = worker_seed(config.seed, ranks.rank) if ranks.rank else config.seed
        env = lasting_failures(config.env) if config.algo.lasting_failures else config.env
        copies = self._copies_per_worker(ranks)
        self.make: MakeEnv = partial(mapped_env, env, self._map, num_envs=copies, device=self._device)
        self.train: TransformedEnv = self.make(seed=self.seed if self.learners is None else self._seeds)
        self.test = self.more_tests(config.evaluation.episodes)

    def _copies_per_worker(self, ranks: Ranks) -> int:
        workers = self._config.collector.num_workers
        if self.copies % workers:
            raise ValueError(
                f"collector.num_workers={workers} cannot share alike the {self.copies} copies that "
                f"env.num_envs={self._config.env.num_envs} leaves each of {ranks.size} processes."
            )
        return self.copies // workers

    @cached_property
    def final_test(self) -> TransformedEnv:
        """The task for the test at the end, with one copy for each of its episodes."""
        evaluation = self._config.evaluation
        if evaluation.final_episodes in (None, evaluation.episodes):
            return self.test
        return self.more_tests(evaluation.final_episodes)

    def more_tests(self, episodes: int) -> TransformedEnv:
        """The task to test on, with one copy for each episode (of each learner), from the first test seed on."""
        seeds = [seed + TEST_SEED for seed in self._seeds]
        return self._tests(self._config, self._map, seeds[0] if self.learners is None else seeds, episodes)

    def filmed(self, config: Training, map: nht.ActionMap, episodes: int) -> TransformedEnv:
        """The task that one learner is tested on, with one copy for each episode, from the first test seed on."""
        return self._tests(config, map, config.seed + TEST_SEED, episodes)

    def _tests(
        self, config: Training, map: nht.ActionMap, seed: int | list[int], episodes: int
    ) -> TransformedEnv:
        env = lasting_failures(config.env)
        return mapped_env(env, map, seed=seed, num_envs=episodes, device=self._device)

    def close(self) -> None:
        """Release the simulators."""
        final = self.__dict__.get("final_test", self.test)  # unless none was made
        for env in (self.train, self.test, final):
            if not env.is_closed:
                env.close()


def check_env(env: EnvConfig) -> int:
    """Build one copy of the task and close it again, so that errors in it show before anything is written.

    Returns:
        the number of motors.

    Raises:
        ImportError, ValueError: as ``base_env``.
    """
    base = base_env(env, seed=0, num_envs=1)
    base.close()
    return int(base.action_spec.shape[-1])
