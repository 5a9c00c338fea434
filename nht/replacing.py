"""Files that are whole: whoever reads one sees the old or the new one, never a part."""

from __future__ import annotations

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nht.scratch import publish, scratch


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A scratch file of the same name, which takes the place of ``path`` once it is written whole and on disk.

    Its permissions are those of any new file: the umask's. Whatever fails leaves ``path`` as it was. What a killed
    process left behind is removed by the next one that writes the same file.
    """
    with scratch(path) as folder:
        folder.mkdir()
        place = folder / path.name
        yield place
        place.chmod(_mode_of_new_files(folder))
        publish(place, path)


def _mode_of_new_files(folder: Path) -> int:
    """Asked of a file that is just made, for reading the umask means setting it, for other threads too."""
    probe = folder / "mode"
    probe.touch()
    return stat.S_IMODE(probe.stat().st_mode)
