"""The learners of a run: one, or many of one shape that share every call."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from copy import copy
from dataclasses import asdict
from typing import Any, Generic, TypeVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor

from nht.recipes.agents.settings import Setting
from nht.recipes.agents.stacking import stacked
from nht.recipes.run.draws import Draws
from nht.recipes.sections import Training

Config = TypeVar("Config", bound=Training)

OWN = (
    "seed",
    "map",
    "demos",
    "run.folder",
    "run.wandb_group",
    "run.wandb_job_type",
    "run.wandb_name",
    "run.wandb_notes",
    "run.wandb_project",
    "run.wandb_tags",
)
"""Settings that each learner has of its own, beside those that its algorithm lets vary."""


class Learners(Generic[Config]):
    """One learner, whose tensors are as usual, or L of them, whose tensors have a leading dimension ``(L, ...)``.

    Learners are independent: each draws from its own generators, and no number of one reaches another.

    Args:
        configs: of each learner.
        device: of the tensors.

    Raises:
        ValueError: if they differ in what all share; names setting and learner.

    Attributes:
        count: L, or None for one learner alone.
        draws: the learners' generators; None for one alone, who draws from torch's.
        algo: the algorithm's settings; those that differ between learners are tensors ``(L,)``.
    """

    def __init__(self, configs: Sequence[Config], device: torch.device) -> None:
        self._configs = configs
        self.count = len(configs) if len(configs) > 1 else None
        self.draws = None if self.count is None else Draws([config.seed for config in configs], device)
        check_alike(configs)
        self.algo: Any = copy(configs[0].algo)
        for name in configs[0].algo.varies:
            values = [getattr(config.algo, name) for config in configs]
            if any(value != values[0] for value in values):
                dtype = torch.float32 if isinstance(values[0], float) else None
                setattr(self.algo, name, torch.tensor(values, dtype=dtype, device=device))

    def networks(self, make: Callable[[Any], tuple[TensorDictModule, ...]]) -> tuple[TensorDictModule, ...]:
        """The networks that ``make`` builds from the settings of an algorithm; each learner draws its own weights."""
        if self.draws is None:
            return make(self.algo)
        made = []
        for learner, config in enumerate(self._configs):
            with self.draws.of(learner):
                made.append(make(config.algo))
        return tuple(stacked(kind) for kind in zip(*made, strict=True))

    def exploring(self, policy: TensorDictModuleBase) -> TensorDictModuleBase:
        """The policy whose draws are each learner's own."""
        return policy if self.draws is None else ExploringApart(policy, self.draws)

    def drawing(self) -> AbstractContextManager[Any]:
        """Within, every learner draws from its own generator."""
        return nullcontext() if self.draws is None else self.draws.for_all()

    def each(self, setting: Setting) -> Any:
        """An integer setting: a number for one learner, a list for several."""
        if self.count is None:
            return setting
        return setting.tolist() if isinstance(setting, Tensor) else self.count * [setting]


class ExploringApart(TensorDictSequential):
    """A policy of several learners, each of which draws from its own generator.

    Args:
        policy: of all.
        draws: their generators.
    """

    def __init__(self, policy: TensorDictModuleBase, draws: Draws) -> None:
        super().__init__(policy)
        self._draws = draws

    def forward(self, tensordict: TensorDictBase, *args: Any, **kwargs: Any) -> TensorDictBase:
        """Apply the policy, with each learner's own draws."""
        with self._draws.for_all():
            return super().forward(tensordict, *args, **kwargs)


def check_alike(configs: Sequence[Training]) -> None:
    """Check that learners can share every call.

    Raises:
        ValueError: if not; names the setting, what it is for the first learner and for the one that differs.
    """
    first = configs[0]
    if len(configs) == 1:
        return
    if not first.algo.varies:
        raise ValueError(
            f"{type(first).__name__} trains one learner at a time: ddpg and ppo train several together."
        )
    if first.collector.kind != "single":
        raise ValueError(f"several learners need collector=single, got {first.collector.kind}.")
    if first.env.suite != "nht":
        raise ValueError(
            f"several learners need a task of the suite nht, whose copies are stepped together: got {first.env.suite}."
        )
    reference = _shared(first)
    for learner, config in enumerate(configs[1:], start=1):
        if type(config) is not type(first):
            raise ValueError(
                f"learner {learner} learns by {type(config).__name__}, learner 0 by {type(first).__name__}."
            )
        for name, value in _shared(config).items():
            if value != reference[name]:
                raise ValueError(
                    f"learners of one population share {name}: it is {reference[name]} for learner 0, {value} for "
                    f"learner {learner}. They may differ in {sorted(['map', 'seed', *first.algo.varies])}."
                )
    for learner, config in enumerate(configs):
        size, rows = getattr(config.algo, "batch_size", 1), getattr(config.algo, "buffer_size", 1)
        if size > rows:
            raise ValueError(
                f"learner {learner} has algo.batch_size={size}, more than algo.buffer_size={rows}."
            )


def _shared(config: Training) -> dict[str, Any]:
    """The settings that learners must share, by dotted name."""
    flat = {}
    for section, values in asdict(config).items():
        for name, value in values.items() if isinstance(values, dict) else ((None, values),):
            flat[section if name is None else f"{section}.{name}"] = value
    own = (*OWN, *(f"algo.{name}" for name in config.algo.varies))
    return {name: value for name, value in flat.items() if name not in own and name.split(".")[0] not in own}
