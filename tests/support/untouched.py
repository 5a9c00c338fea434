"""What reading must not do: run anything, or change, make or remove a file."""

import hashlib
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
FORBIDDEN = {
    "os.chmod",
    "os.exec",
    "os.fork",
    "os.link",
    "os.mkdir",
    "os.posix_spawn",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.symlink",
    "os.system",
    "os.truncate",
    "os.utime",
    "pickle.find_class",
    "shutil.copyfile",
    "shutil.rmtree",
    "subprocess.Popen",
}
_noted: list[str] | None = None


def _note(event: str, arguments: tuple) -> None:
    if _noted is None:
        return
    if event == "open" and isinstance(arguments[2], int) and arguments[2] & WRITES:
        if not str(arguments[0]).startswith(("/dev/", "/proc/")) and "__pycache__" not in str(arguments[0]):
            _noted.append(f"open {arguments[0]} to write")
    elif event in FORBIDDEN and "__pycache__" not in str(arguments):
        _noted.append(f"{event} {arguments}")


sys.addaudithook(_note)


@contextmanager
def only_reads(*folders: Path) -> Iterator[None]:
    """Within, nothing is run, unpickled, written or removed, and all files in ``folders`` stay as they are."""
    global _noted
    before = [state_of(folder) for folder in folders]
    _noted = []
    try:
        yield
    finally:
        noted, _noted = _noted, None
    assert not noted, noted
    assert [state_of(folder) for folder in folders] == before


def state_of(folder: Path) -> dict[str, tuple]:
    """Size, time, mode and contents of every file and folder, links not followed."""
    found = {}
    for path in [folder, *sorted(folder.rglob("*"))]:
        about = path.lstat()
        content = path.read_bytes() if path.is_file() and not path.is_symlink() else b""
        time = None if path.is_dir() else about.st_mtime_ns
        found[str(path)] = (about.st_size, time, about.st_mode, hashlib.sha256(content).hexdigest())
    return found
