"""Files that are whole: whoever reads one sees the old or the new one, never a part."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A scratch file of the same name, which takes the place of ``path`` once it is written whole and on disk.

    Its permissions are those of any new file: the umask's. Whatever fails leaves ``path`` as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        scratch = Path(folder) / path.name
        yield scratch
        scratch.chmod(_mode_of_new_files(Path(folder)))
        _sync(scratch)
        os.replace(scratch, path)
        _sync(path.parent)


def _mode_of_new_files(folder: Path) -> int:
    """Asked of a file that is just made, for reading the umask means setting it, for other threads too."""
    probe = folder / "mode"
    probe.touch()
    return stat.S_IMODE(probe.stat().st_mode)


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
