"""Checkpoints of a run: each is written whole or not at all, and the last good ones are kept."""

from __future__ import annotations

import shutil
import warnings
import zipfile
from pathlib import Path
from typing import Any

from torchrl.checkpoint import Checkpoint, CheckpointRotation, GlobalRNGState

PREFIX = "checkpoint-"
"""Of a checkpoint's name; the number of steps follows."""


class Checkpoints:
    """The last two checkpoints of a run, in one folder that only this run writes to.

    Args:
        folder: where they are.
        parts: what a run goes on from, each with a ``state_dict`` and a ``load_state_dict``; the generators of torch,
            NumPy and Python are added.
    """

    def __init__(self, folder: Path, **parts: Any) -> None:
        self._folder = folder
        # Archives know their checksums; of files mapped into memory nobody would notice that one is cut short.
        self._checkpoint = Checkpoint(**parts, random=GlobalRNGState(), format="archive")
        self._rotation = CheckpointRotation(folder, keep_last=2)

    def save(self, frames: int) -> None:
        """Write the state after ``frames`` steps.

        Raises:
            OSError: if there is no room; earlier checkpoints stay as they are.
        """
        try:
            self._check_room()
            self._rotation.save(self._checkpoint, step=frames)
        except OSError as error:
            reason = f"no checkpoint after {frames} steps: {error.strerror or error}"
            raise OSError(error.errno, f"{reason}. The last one is {self._rotation.latest()}") from error

    def _check_room(self) -> None:
        # Buffers are mapped into memory: on a full disk the system would kill the process instead of saying so.
        if (latest := self._rotation.latest()) is None:
            return
        size, free = latest.stat().st_size, shutil.disk_usage(self._folder).free
        if free < 2.4 * size:  # once as files, once as their archive
            raise OSError(
                f"the last one is of {size / 1e6:.1f} MB, only {free / 1e6:.1f} MB are left for the next"
            )

    def steps(self) -> list[int]:
        """The steps after which checkpoints were written that can be read, oldest first.

        Others are passed over with a warning, and what a kill in the middle of writing left behind is removed.

        Raises:
            ValueError: if there are checkpoints, but none that can be read.
        """
        for unfinished in self._folder.glob(".*"):
            shutil.rmtree(unfinished) if unfinished.is_dir() else unfinished.unlink()
        found = {int(path.stem.removeprefix(PREFIX)): path for path in self._folder.glob(f"{PREFIX}*")}
        readable = [step for step, path in sorted(found.items()) if _is_whole(path)]
        if found and not readable:
            raise ValueError(f"none of the checkpoints in {self._folder} can be read.")
        return readable

    def load(self, step: int) -> None:
        """Go on from the checkpoint after ``step`` steps, one of ``steps()``."""
        (path,) = (
            path for path in self._folder.glob(f"{PREFIX}*") if int(path.stem.removeprefix(PREFIX)) == step
        )
        self._checkpoint.load(path)


def _is_whole(path: Path) -> bool:
    """Whether all of an archive is what was written; says so if not."""
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except (zipfile.BadZipFile, OSError) as error:
        damaged = str(error)
    if damaged is not None:
        warnings.warn(f"{path} cannot be read and is passed over: {damaged}", stacklevel=3)
    return damaged is None
