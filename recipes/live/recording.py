"""What is done while a task runs, kept as demonstrations."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

import nht
from nht.minari_internals import import_minari

FLAGS = ("success", "terminated", "truncated", "done")


class Recorder:
    """Keeps the steps of episodes while it is on, from an episode's first motion to its end or until it is put off.

    Args:
        keys: of the observations that are kept.
        env: name of the task.
        folder: where they are saved; a number is added if it exists.
        minari: id of a Minari dataset that they are saved as, too; None is none.
        settings: for the manifest, JSON values.

    Raises:
        ImportError: if a Minari dataset is wanted and Minari is not installed.

    Attributes:
        on: whether it records.
        episodes: whole ones, of which each step is ``()``, in order of time.
    """

    def __init__(
        self,
        keys: Sequence[str],
        env: str,
        folder: str | Path,
        *,
        minari: str | None = None,
        settings: dict[str, Any] | None = None,
    ) -> None:
        if minari is not None:
            import_minari()
        self._keys, self._env, self._folder, self._minari = list(keys), env, Path(folder), minari
        self._settings = dict(settings or {})
        self._steps: list[TensorDict] = []
        self.on = False
        self.episodes: list[list[TensorDict]] = []

    @property
    def transitions(self) -> int:
        """Number of steps that are kept, those of the episode that goes on included."""
        return sum(map(len, self.episodes)) + len(self._steps)

    def add(self, observed: TensorDictBase, actuation: Tensor, outcome: TensorDictBase) -> None:
        """Keep a step, if it records; an episode begins with its first motion.

        Args:
            observed: before the step, ``(1,)``.
            actuation: what the motors got, ``(1, n)``.
            outcome: of the step, ``(1,)``.
        """
        if not self.on or (not self._steps and not actuation.any()):
            return
        entries = {
            **{key: observed[key][0] for key in self._keys},
            "actuation": actuation[0],
            **{flag: outcome[flag][0] for flag in ("reward", *FLAGS)},
            "next": {key: outcome[key][0] for key in self._keys},
        }
        self._steps.append(TensorDict(entries, batch_size=[]).clone())
        if outcome["done"].any():
            self.end_episode()

    def end_episode(self) -> None:
        """End the episode that goes on, if there is one; where the task itself did not, it is cut short: truncated."""
        if not self._steps:
            return
        last = self._steps[-1]
        if not last["done"].any():
            last["truncated"] = torch.ones_like(last["truncated"])
            last["done"] = torch.ones_like(last["done"])
        self.episodes.append(self._steps)
        self._steps = []

    def discard(self) -> None:
        """Forget the episode that goes on, or else the last one."""
        if self._steps:
            self._steps = []
        elif self.episodes:
            self.episodes.pop()

    def demos(self) -> nht.Demos:
        """The whole episodes as demonstrations.

        Raises:
            ValueError: if there is none.
        """
        if not self.episodes:
            raise ValueError("nothing is recorded: press record, and move.")
        steps = [step for episode in self.episodes for step in episode]
        lengths = torch.tensor([len(episode) for episode in self.episodes])
        data = TensorDict.stack(steps)
        data["episode"] = torch.arange(len(lengths)).repeat_interleave(lengths)
        return nht.Demos.from_episodes(data, env=self._env, expert="person", settings=self._settings)

    def save(self) -> Path:
        """Write the whole episodes to a new folder, and forget them.

        Returns:
            the folder.

        Raises:
            OSError: if there is no room.
            ValueError: if there is nothing to save.
        """
        demos = self.demos()
        folder = free_folder(self._folder)
        nht.save_demos(demos, folder)
        if self._minari is not None:
            nht.to_minari(demos, _numbered(self._minari, folder, self._folder))
        self.episodes = []
        return folder


def free_folder(folder: Path) -> Path:
    """``folder``, or the first of ``folder-2``, ``folder-3`` ... that does not exist."""
    number, found = 2, folder
    while found.exists():
        found, number = folder.with_name(f"{folder.name}-{number}"), number + 1
    return found


def _numbered(dataset: str, folder: Path, first: Path) -> str:
    """The id of a Minari dataset, with the number that the folder has got put before its version."""
    name, _, version = dataset.rpartition("-v")
    return f"{name}{folder.name.removeprefix(first.name)}-v{version}"
