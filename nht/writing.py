"""Writing files and folders that appear whole or not at all, and survive a power cut.

Each is written beside its place under a hidden name that says which process writes it, brought to disk, and renamed.
What a killed process left behind is known by that name, and removed by the next one that writes there.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import socket
import stat
import time
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

OWNED = re.compile(r"^\.(?P<name>.+)\.(?P<host>[^.]+)-(?P<pid>\d+)-(?P<born>\d+)-[0-9a-f]{8}$")
OLD = re.compile(r"^\.(?P<name>.+)\.[0-9a-f]{32}$")
"""Names of scratch files from earlier versions, which do not say who writes them."""

FORGOTTEN = 24 * 3600.0
"""Seconds without a change after which a scratch file of unknown owner is taken for left over."""


@contextmanager
def scratch(path: Path) -> Iterator[Path]:
    """A name beside ``path`` for a file or folder of this process; what is there at the end is removed.

    What processes that are dead left for the same ``path`` is removed first.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent, path.name)
    owner = f"{_host()}-{os.getpid()}-{_born(os.getpid())}"
    place = path.with_name(f".{path.name}.{owner}-{uuid.uuid4().hex[:8]}")
    try:
        yield place
    finally:
        _remove(place)


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A scratch file of the same name, which takes the place of ``path`` once it is written whole and on disk.

    Its permissions are those of any new file: the umask's. Whatever fails leaves ``path`` as it was.
    """
    with scratch(path) as folder:
        folder.mkdir(mode=0o700)
        place = folder / path.name  # some writers look at the end of the name
        yield place
        place.chmod(_mode_of_new_files(folder))
        publish(place, path)


def publish(source: Path, path: Path) -> None:
    """Bring a scratch file or folder to disk, give it its name, and bring that to disk too.

    Raises:
        FileExistsError: if a folder is to be published where one is.
    """
    if source.is_dir():
        if os.path.lexists(path):
            raise FileExistsError(f"{path} exists by now.")
        for folder, _, names in os.walk(source):
            for name in names:
                _sync(Path(folder) / name)
            _sync(Path(folder))
    else:
        _sync(source)
    os.rename(source, path)
    _sync(path.parent)


def check_room(folder: Path, size: float, what: str) -> None:
    """Raise OSError unless the file system of ``folder`` has room for ``size`` bytes and a little more."""
    while not folder.exists():
        folder = folder.parent
    free = shutil.disk_usage(folder).free
    if free < 1.05 * size + 2**20:
        text = f"{what} takes {size / 1e6:.1f} MB, only {free / 1e6:.1f} MB are left in {folder}."
        raise OSError(errno.ENOSPC, text)


def remove_leftovers(folder: Path, name: str | None = None) -> list[Path]:
    """Remove what dead processes left in a folder, for ``name`` or for all names; returns what was removed.

    Only a process of this machine can be known to be dead; what processes of other machines left stays.
    """
    dead = []
    for place in folder.glob(".*"):
        owned, old = OWNED.match(place.name), OLD.match(place.name)
        match = owned or old
        if match is None or (name is not None and match["name"] != name):
            continue
        if _is_dead(owned) if owned is not None else _silence(place) > FORGOTTEN:
            _remove(place)
            dead.append(place)
    return dead


def _mode_of_new_files(folder: Path) -> int:
    """The mode of a file that is made for this: reading the umask means setting it, for other threads too."""
    probe = folder / f"{uuid.uuid4().hex}.mode"
    probe.touch()
    return stat.S_IMODE(probe.stat().st_mode)


def _is_dead(owner: re.Match[str]) -> bool:
    return owner["host"] == _host() and _born(int(owner["pid"])) != int(owner["born"])


def _host() -> str:
    """The name of this machine and container; process numbers are unique only within one container."""
    try:
        container = os.readlink("/proc/self/ns/pid")
    except OSError:
        container = ""
    return re.sub(r"[^A-Za-z0-9]+", "_", f"{socket.gethostname()} {container}").strip("_")


def _born(pid: int) -> int:
    """When a process began, in clock ticks since boot, as its number may be used again; 0 if there is none."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text(errors="replace").rpartition(")")[2].split()
    except OSError:
        return 0
    return 0 if fields[0] in "ZX" else int(fields[19])


def _silence(place: Path) -> float:
    """Seconds since anything in a file or folder was changed."""
    try:
        times = [inner.lstat().st_mtime for inner in [place, *place.rglob("*")]]
    except FileNotFoundError:  # its owner goes on
        return 0.0
    return time.time() - max(times)


def _remove(place: Path) -> None:
    if place.is_dir() and not place.is_symlink():
        shutil.rmtree(place, ignore_errors=True)
    else:
        place.unlink(missing_ok=True)


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
