"""The table of algorithms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase

from nht.envs.table import Table, imported
from nht.reading import shortened
from nht.recipes.sections import Training


@dataclass(frozen=True)
class Algorithm:
    """The record of an algorithm.

    Attributes:
        main: import path of its recipe, ``"module:function"``, which takes a ``schema``.
        schema: dataclass of all settings of the recipe, a ``Training`` with an ``algo`` of its own.
        policy: makes the untrained policy, without exploration, for an environment and ``algo``; a finished run saves
            its weights.
    """

    main: str
    schema: type[Training]
    policy: Callable[[EnvBase, Any], TensorDictModule]

    def train(self, *configs: Training, together: str | None = None) -> None:
        """Run the recipe.

        Args:
            configs: of one learner, or of several if the algorithm can train them together.
            together: folder for what several learners share.
        """
        more = {} if together is None else {"together": together}
        imported(self.main)(*configs, **more)


def _adopt(name: str, found: Any) -> Algorithm:
    if not isinstance(found, Algorithm):
        raise TypeError(f"the algorithm {name!r} must be an Algorithm, got {found!r}.")
    return found


ALGORITHMS: Table[Algorithm] = Table(
    "nht.algorithms",
    {name: f"nht.recipes.agents.{name}:ALGORITHM" for name in ("ddpg", "td3", "sac", "ppo")},
    _adopt,
)
"""Every algorithm by the name of its recipe; packages add theirs as entry points ``nht.algorithms``."""


def find_algorithm(name: str) -> Algorithm:
    """The record of an algorithm.

    Args:
        name: a key of ``ALGORITHMS``, or an import path; folders of older runs have it in capitals.

    Raises:
        ValueError: for an unknown name; the message lists those that exist.
    """
    known = name if name in ALGORITHMS else name.lower()
    if known not in ALGORITHMS:
        raise ValueError(
            f"unknown algorithm {name!r}: choose from {sorted(ALGORITHMS)}, or name an import path, "
            "package.module:ALGORITHM."
        )
    try:
        return ALGORITHMS[known]
    except (ImportError, TypeError) as error:
        raise ValueError(f"the algorithm {name!r} cannot be found: {shortened(error)}.") from error


def name_of(schema: type[Training]) -> str:
    """The name of a schema's algorithm in the table, or its import path."""
    for name in ALGORITHMS:
        if ALGORITHMS[name].schema is schema:
            return name
    return f"{schema.__module__}:ALGORITHM"
