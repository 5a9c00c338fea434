"""Checks the folder of a Minari dataset before Minari opens it.

Minari itself runs code for a dataset that does not say its spaces: it makes the environment that the metadata name, by
an entry point of the file's choice. It also follows HDF5's links into other files, and opens frames as whatever kind
of picture they turn out to be.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from nht.hdf5_file import check_file, find, opened
from nht.minari_internals import (
    DATA,
    FOLDER,
    JPEG,
    METADATA,
    datasets_root,
    episode_entry,
    tuple_entry,
)
from nht.reading import entry, parse_json, plain_file, read_json, shortened

TRUSTED_MINARI = (
    "If you trust the dataset, open it yourself and hand it over: "
    "nht.from_minari(minari.MinariDataset(folder)) or nht.from_minari(minari.load_dataset(id))"
)
DEEPEST = 32
"""Largest depth of nested spaces."""


def local_datasets() -> list[str]:
    """Ids of the datasets that are here."""
    root = datasets_root()
    return sorted(str(file.parent.parent.relative_to(root)) for file in root.glob(f"**/{FOLDER}/{METADATA}"))


def check_minari_dataset(folder: Path) -> None:
    """Check that opening a dataset's ``data`` folder runs nothing, and that all that is read lies in it.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: on metadata that lack spaces or hold none, on other storage than HDF5, and on an HDF5 file that
            cannot be read or names other files.
    """
    file = folder / METADATA
    about = read_json(file)
    kind = entry(about, "data_format", str, str(file))
    if kind != "hdf5":
        raise ValueError(
            f"{file}: 'data_format' is {shortened(kind, 40)!r}, expected 'hdf5', the one that is read. "
            f"{TRUSTED_MINARI}."
        )
    for name in ("total_episodes", "total_steps"):
        if not 0 <= entry(about, name, int, str(file)) < 2**48:
            raise ValueError(f"{file}: {name!r} must be a count, got {about[name]}.")
    for name in ("dataset_id", "minari_version"):
        entry(about, name, str, str(file))
    for name in ("env_spec", "eval_env_spec", "algorithm_name"):
        if about.get(name) is not None:
            entry(about, name, str, str(file))
    spaces = {name: _space(about, f"{name}_space", file) for name in ("observation", "action")}
    data = plain_file(folder / DATA)
    with opened(data) as handle:
        check_file(handle)
        if about["total_episodes"] > len(handle):
            raise ValueError(
                f"{file} says {about['total_episodes']:,} episodes, {data.name} has {len(handle):,}: it was cut short."
            )
        if about.get("jpeg_encoding", True):
            for episode in range(about["total_episodes"]):
                for name, space in spaces.items():
                    _check_frames(handle, episode_entry(episode, f"{name}s"), space)


def _space(about: dict[str, Any], name: str, file: Path) -> dict[str, Any]:
    """A space as the metadata describe it, checked."""
    if name not in about:
        raise ValueError(
            f"{file} has no {name!r}: to find it, Minari would make the environment that 'env_spec' names, which can "
            f"run any code. {TRUSTED_MINARI}."
        )
    where = f"{file}: {name!r}"
    space = parse_json(entry(about, name, str, str(file)), where)
    _check_space(space, where, 0)
    return space


def _check_space(space: Any, where: str, depth: int) -> None:
    if depth > DEEPEST:
        raise ValueError(f"{where} holds spaces within spaces, more than {DEEPEST} of them.")
    if not isinstance(space, dict):
        raise ValueError(f"{where} holds {shortened(repr(space), 60)} where a space should be.")
    kind = entry(space, "type", str, where)
    if kind in ("Dict", "Tuple"):
        inner = entry(space, "subspaces", dict if kind == "Dict" else list, where)
        for one in inner.values() if isinstance(inner, dict) else inner:
            _check_space(one, where, depth + 1)
    elif kind == "Box":
        _check_box(space, where)
    elif kind == "Text":
        for name, type_ in (("max_length", int), ("min_length", int), ("charset", str)):
            entry(space, name, type_, where)
    elif kind not in ("Discrete", "MultiDiscrete", "MultiBinary"):
        raise ValueError(f"{where} is of an unknown kind of space, {shortened(kind, 60)!r}.")


def _check_box(space: dict[str, Any], where: str) -> None:
    """Check that all bounds are given: Minari would expand a single number to whatever shape the file says."""
    shape = entry(space, "shape", list, where)
    if not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError(f"{where}: 'shape' must be a list of sizes, got {shortened(repr(shape), 60)}.")
    try:
        type_ = np.dtype(entry(space, "dtype", str, where))
    except TypeError:
        raise ValueError(f"{where}: {shortened(space['dtype'], 60)!r} is no type of numbers.") from None
    if type_.kind not in "biuf":
        raise ValueError(f"{where}: {shortened(space['dtype'], 60)!r} is no type of numbers.")
    for name in ("low", "high"):
        try:
            found: Any = np.shape(entry(space, name, (list, int, float), where))
        except ValueError:
            found = None
        if found != tuple(shape):
            raise ValueError(
                f"{where}: {name!r} must have the shape {tuple(shape)} of the space, got {found}."
            )


def _check_frames(file: Any, key: str, space: dict[str, Any]) -> None:
    """Check that encoded frames are JPEG: a library that opens any kind of picture would run PostScript, too."""
    if space["type"] in ("Dict", "Tuple"):
        inner = space["subspaces"]
        pairs = (
            inner.items()
            if isinstance(inner, dict)
            else ((tuple_entry(i), one) for i, one in enumerate(inner))
        )
        for name, one in pairs:
            _check_frames(file, f"{key}/{name}", one)
        return
    if space["type"] != "Box" or space["dtype"] != "uint8" or len(space["shape"]) not in (2, 3):
        return
    dataset = find(file, key)
    if dataset is None or not hasattr(dataset, "dtype"):
        return
    if math.prod(dataset.shape[1:]) == math.prod(space["shape"]) and dataset.ndim == 1 + len(space["shape"]):
        return  # stored as they are
    for frame in dataset[()]:
        if bytes(np.asarray(frame).astype(np.uint8)[:3].tobytes()) != JPEG:
            raise ValueError(f"{file.filename}: {key!r} holds a frame that is no JPEG.")


def leaves_that_are_no_arrays(space: Any, name: str = "observation") -> Iterator[str]:
    """Names of the parts of a Gymnasium space whose values are no arrays: texts, graphs, sequences."""
    from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Tuple

    if isinstance(space, Dict):
        for key, one in space.spaces.items():
            yield from leaves_that_are_no_arrays(one, key if name == "observation" else f"{name}/{key}")
    elif isinstance(space, Tuple):
        for number, one in enumerate(space.spaces):
            yield from leaves_that_are_no_arrays(one, f"{name}/{number}")
    elif not isinstance(space, (Box, Discrete, MultiBinary, MultiDiscrete)):
        yield name
