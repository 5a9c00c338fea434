"""Reads HDF5 files from elsewhere: only what is in the file itself; a reference to another file is refused by name.

An HDF5 file can name other files in three ways: external links, external storage, and virtual datasets. h5py follows
all of them without a word.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from nht.reading import plain_file, shortened

HDF5_ERRORS = (OSError, ValueError, KeyError, RuntimeError, TypeError, MemoryError, OverflowError)
"""What h5py raises on files that are cut short or damaged."""

HOPS = 16
"""Number of soft links followed before they are taken for a circle."""

TRUSTED_HDF5 = (
    "If you trust it, copy what it names into one file first: h5repack, or h5py's "
    "Group.copy(expand_external=True)"
)


@contextmanager
def opened(path: Path) -> Iterator[Any]:
    """The file, open for reading only.

    Raises:
        ImportError: without h5py.
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be opened, or what is done within fails for a reason of h5py's.
    """
    h5py = import_h5py()
    plain_file(path.resolve())
    try:
        with h5py.File(path, "r") as file:
            yield file
    except _RefusedError as error:
        raise ValueError(str(error)) from None
    except HDF5_ERRORS as error:
        raise ValueError(
            f"{path} cannot be read, it is cut short or no HDF5 file: {shortened(error)}."
        ) from error


class _RefusedError(Exception):
    """An error of this module, which is told apart from h5py's own."""


def find(file: Any, key: str, hops: int = 0) -> Any:
    """The dataset or group at a key, soft links within the file followed; None if there is none.

    Raises:
        ValueError: through ``opened``, if links lead out of the file or in a circle.
    """
    h5py = import_h5py()
    found, parts = file["/"], [part for part in key.split("/") if part not in ("", ".")]
    for place, part in enumerate(parts):
        if not isinstance(found, h5py.Group):
            return None
        link = found.get(part, None, getlink=True)
        if link is None:
            return None
        if isinstance(link, h5py.ExternalLink):
            name = "/".join(parts[: place + 1])
            raise _RefusedError(
                f"{file.filename}: {name!r} is a link to {link.path!r} in another file, {link.filename!r}, which is "
                f"not followed. {TRUSTED_HDF5}."
            )
        if isinstance(link, h5py.SoftLink):
            if hops >= HOPS:
                raise _RefusedError(f"{file.filename}: the links at {key!r} lead in a circle.")
            target = link.path if link.path.startswith("/") else f"{found.name}/{link.path}"
            found = find(file, target, hops + 1)
        else:
            found = found[part]
    return found


def read_array(file: Any, key: str) -> NDArray[Any] | None:
    """The array of the dataset at a key, which is all in this file; None if there is none.

    Raises:
        ValueError: through ``opened``, if any of it lies in another file, was never written, or exceeds the memory.
    """
    dataset = find(file, key)
    if not isinstance(dataset, import_h5py().Dataset):
        return None
    check_hdf5_dataset(file, dataset, key)
    try:
        return np.asarray(dataset[()])
    except HDF5_ERRORS as error:
        raise _RefusedError(f"{file.filename}: {key!r} cannot be read: {shortened(error)}.") from error


def check_hdf5_dataset(file: Any, dataset: Any, key: str, hops: int = 0) -> int:
    """Check that all values of a dataset are in this file. Returns how many bytes of memory they take."""
    where = f"{file.filename}: {key!r}"
    try:
        shape, external, virtual = dataset.shape, dataset.external, dataset.is_virtual
    except HDF5_ERRORS as error:
        raise _RefusedError(f"{where} cannot be read: {shortened(error)}.") from error
    if shape is None:
        raise _RefusedError(f"{where} holds no values.")
    if external:
        raise _RefusedError(
            f"{where} keeps its values in another file, {external[0][0]!r}, which is not read. {TRUSTED_HDF5}."
        )
    if virtual:
        _check_virtual(file, dataset, where, hops)
    width = dataset.id.get_type().get_size()
    size, chunk = math.prod(shape) * width, math.prod(dataset.chunks or ()) * width
    if size and not virtual:
        _check_written(dataset, where, size)
    if max(size, chunk) > available_memory():
        raise _RefusedError(
            f"{where} has the shape {shape} and takes {size / 1e9:.1f} GB, more than there is memory."
        )
    return int(size)


def _check_virtual(file: Any, dataset: Any, where: str, hops: int) -> None:
    h5py = import_h5py()
    for source in dataset.virtual_sources():
        if source.file_name != ".":
            raise _RefusedError(
                f"{where} is made of values in another file, {source.file_name!r}, which is not read. {TRUSTED_HDF5}."
            )
        inner = find(file, source.dset_name)
        if not isinstance(inner, h5py.Dataset) or hops >= HOPS:
            raise _RefusedError(f"{where} is made of {source.dset_name!r}, which is not there.")
        check_hdf5_dataset(file, inner, source.dset_name, hops + 1)


def _check_written(dataset: Any, where: str, size: int) -> None:
    """Raise for values that were never written: they would be read as zeros."""
    if dataset.chunks is None:
        missing = dataset.id.get_storage_size() < size
    else:
        pairs = zip(dataset.shape, dataset.chunks, strict=True)
        missing = dataset.id.get_num_chunks() < math.prod(-(-length // chunk) for length, chunk in pairs)
    if missing:
        raise _RefusedError(f"{where} has the shape {dataset.shape}, but not all of its values were written.")


def check_file(file: Any) -> None:
    """Check that nothing in a file leads out of it, whoever reads it afterwards.

    Raises:
        ValueError: through ``opened``, with the name of what does.
    """
    h5py = import_h5py()
    outside: list[str] = []

    def look_at_link(name: bytes, info: Any) -> None:
        if info.type not in (h5py.h5l.TYPE_HARD, h5py.h5l.TYPE_SOFT):
            outside.append(name.decode(errors="replace"))

    file.id.links.visit(look_at_link, info=True)
    if outside:
        find(file, outside[0])  # says where it leads
        raise _RefusedError(
            f"{file.filename}: {outside[0]!r} is a link of an unknown kind, which is not followed."
        )
    total = 0

    def look_at_entry(name: str, entry: Any) -> None:
        nonlocal total
        if isinstance(entry, h5py.Dataset):
            total += check_hdf5_dataset(file, entry, name)

    file.visititems(look_at_entry)
    if total > available_memory():
        raise _RefusedError(
            f"{file.filename} takes {total / 1e9:.1f} GB when it is read, more than there is memory."
        )


def names(file: Any, at_most: int) -> list[str]:
    """Keys of the datasets in the file itself, the first ``at_most`` of them."""
    h5py, found = import_h5py(), []

    def note(name: str, entry: Any) -> bool | None:
        if isinstance(entry, h5py.Dataset):
            found.append(name)
        return True if len(found) >= at_most else None

    file.visititems(note)
    return found


def available_memory() -> int:
    """Available memory in bytes."""
    try:
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")


def import_h5py() -> ModuleType:
    """Import h5py; the ImportError says how to install it."""
    try:
        import h5py
    except ImportError as error:
        raise ImportError("HDF5 files need an optional package: pip install 'nht[minari]'.") from error
    return h5py
