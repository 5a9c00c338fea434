"""Checkpoints of a run: each is written whole or not at all, and the last good ones are kept."""

from __future__ import annotations

import re
import warnings
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor, nn
from torchrl.checkpoint import GlobalRNGState
from torchrl.data import ReplayBuffer

from nht.reading import shortened, shown
from nht.recipes.run.checkpoint_file import CheckpointFile
from nht.recipes.run.checkpoint_writing import size_of, write_checkpoint
from nht.writing import check_room, publish, remove_leftovers, scratch

NAME = re.compile(r"checkpoint-(\d{1,18})\.torchrl")
"""File name of a checkpoint, with the number of steps; other files are ignored."""

KEPT = 2


class Checkpoints:
    """The last two checkpoints of a run, in one folder that only this run writes to.

    Args:
        folder: where they are.
        parts: what is saved, by name: objects with ``state_dict`` and ``load_state_dict``, or replay buffers; the
            generators of torch, NumPy and Python are added.
        learners: number of learners whose networks are stacked, if several: if some diverged, the others still resume.
    """

    def __init__(self, folder: Path, *, learners: int | None = None, **parts: Any) -> None:
        self._folder, self._learners = folder, learners
        self._parts = {
            name: BufferState(part, learners) if isinstance(part, ReplayBuffer) else part
            for name, part in {**parts, "random": GlobalRNGState()}.items()
        }

    def save(self, frames: int) -> None:
        """Write the state after ``frames`` steps.

        Raises:
            OSError: if there is no room; earlier checkpoints stay as they are.
        """
        path = self._folder / f"checkpoint-{frames:012d}.torchrl"
        try:
            states = {name: part.state_dict() for name, part in self._parts.items()}
            check_room(self._folder, size_of(states), "the next")
            with scratch(path) as place:
                write_checkpoint(place, states)
                publish(place, path)
        except OSError as error:
            reason = f"no checkpoint after {frames} steps: {shortened(error.strerror or error)}"
            latest = max(self._found().items(), default=(0, None))[1]
            raise OSError(error.errno, f"{reason}. The last one is {latest}.") from error
        self._prune(frames)

    def _prune(self, frames: int) -> None:
        """Keep the last checkpoints up to now; those of more steps belong to a run that was rewound."""
        found = self._found()
        kept = sorted(step for step in found if step <= frames)[-KEPT:]
        for step in found.keys() - set(kept):
            found[step].unlink(missing_ok=True)

    def _found(self) -> dict[int, Path]:
        """The checkpoints by their steps, readable or not."""
        names = {path: NAME.fullmatch(path.name) for path in self._folder.glob("checkpoint-*")}
        return {int(match[1]): path for path, match in names.items() if match is not None}

    def steps(self) -> list[int]:
        """The steps of all readable checkpoints, oldest first.

        Unreadable ones are ignored with a warning, and leftovers of interrupted writing are removed.

        Raises:
            ValueError: if there are checkpoints, but none that can be read.
        """
        remove_leftovers(self._folder)
        found = self._found()
        readable = [step for step, path in sorted(found.items()) if _is_whole(path)]
        if found and not readable:
            raise ValueError(f"none of the checkpoints in {self._folder} can be read.")
        return readable

    def load(self, step: int) -> None:
        """Go on from the checkpoint after ``step`` steps, one of ``steps()``.

        Raises:
            ValueError: if it was changed, lacks a part, does not fit the run, or its networks are not finite.
        """
        path = self._found()[step]
        with CheckpointFile(path) as file:
            states = file.read()
        if missing := sorted(self._parts.keys() - states.keys()):
            raise ValueError(f"{path} lacks the parts {missing}, it has {shown(sorted(states))}.")
        for name, part in self._parts.items():
            if isinstance(part, nn.Module):
                check_finite(states[name], part.state_dict(), f"{path}, {name!r}", self._learners)
        for name, part in sorted(self._parts.items()):
            try:
                part.load_state_dict(states[name])
            except (
                RuntimeError,
                ValueError,
                LookupError,
                TypeError,
                AttributeError,
                ArithmeticError,
            ) as error:
                raise ValueError(f"{path}, {name!r} does not fit this run: {shortened(error)}.") from error


def check_finite(saved: Any, own: dict[str, Any], where: str, learners: int | None = None) -> None:
    """Check that a network's numbers are finite; those that are not finite in the network as built may stay so.

    Args:
        saved: the network's state.
        own: that of the network as it is built.
        where: the source of the numbers, for the message.
        learners: number of learners whose networks are stacked in it, if several: then some may have diverged, not all.

    Raises:
        ValueError: if other numbers are not finite.
    """
    lost = torch.zeros(learners or 1, dtype=torch.bool)
    for name, value in saved.items() if isinstance(saved, dict) else ():
        if not isinstance(value, Tensor) or not value.is_floating_point():
            continue
        wrong = ~value.isfinite()
        known = own.get(name)
        if isinstance(known, Tensor) and known.shape == value.shape:
            wrong &= value.to(known.device) != known
        stacked = learners is not None and value.shape[:1] == (learners,)
        lost |= wrong.reshape(len(lost), -1).any(1).cpu() if stacked else wrong.any().cpu()
        if lost.all():
            raise ValueError(
                f"{where}: {name} holds {int(wrong.sum())} NaN or infinite values: training had diverged."
            )


def _is_whole(path: Path) -> bool:
    """Whether a checkpoint is intact; warns if not."""
    try:
        with CheckpointFile(path) as file:
            file.check()
    except (ValueError, OSError) as error:
        warnings.warn(f"{path} cannot be read and is passed over: {shortened(error)}.", stacklevel=3)
        return False
    return True


class BufferState:
    """The contents of a replay buffer as a state dictionary: its filled rows, and where it writes next.

    Args:
        buffer: of rows ``()``.
        learners: number of learners, if there are several; a row then holds a step of each, ``(learners,)``.
    """

    def __init__(self, buffer: ReplayBuffer, learners: int | None = None) -> None:
        self._buffer = buffer
        self._row = [] if learners is None else [learners]

    def state_dict(self) -> dict[str, Any]:
        """Rows ``(len(buffer),)`` by key, not copied; the state of writer and sampler."""
        buffer = self._buffer
        rows = buffer.storage[: len(buffer)].to_dict() if len(buffer) else {}
        return {
            "rows": rows,
            "writer": dict(buffer.writer.state_dict()),
            "sampler": dict(buffer.sampler.state_dict()),
        }

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Replace the contents by the rows of ``saved``.

        Raises:
            ValueError: if there are more than the buffer has room for.
        """
        rows, storage = saved["rows"], self._buffer.storage
        self._buffer.empty()
        if rows:
            length = _length(rows)
            if length > storage.max_size:
                raise ValueError(f"it holds {length} rows, the buffer has room for {storage.max_size}.")
            storage.set(
                range(length), TensorDict(rows, batch_size=[length, *self._row], device=storage.device)
            )
        self._buffer.writer.load_state_dict(saved["writer"])
        if saved.get("sampler"):
            self._buffer.sampler.load_state_dict(saved["sampler"])


def _length(rows: dict[str, Any]) -> int:
    first = next(iter(rows.values()))
    return _length(first) if isinstance(first, dict) else len(first)
