"""What this package relies on in Minari beside its public interface; tests fail by name when an upgrade breaks one.

That is where and how datasets lie on disk: they are checked before Minari opens them, and moved into place after it
wrote them.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from minari.data_collector import EpisodeBuffer

FOLDER, METADATA, DATA = "data", "metadata.json", "main_data.hdf5"
"""The folder in a dataset, and the two files in that folder."""

NAMESPACE = "namespace_metadata.json"
"""What Minari writes about the part before the slash of a dataset's id, in the folder of that name."""

JPEG = b"\xff\xd8\xff"
"""What every JPEG file begins with; Minari stores frames so, unless the metadata's ``jpeg_encoding`` is false."""

MINARI_ERRORS = (
    OSError,
    ValueError,
    LookupError,
    AssertionError,
    RuntimeError,
    TypeError,
    AttributeError,
    ArithmeticError,
    MemoryError,
)
"""What Minari, Gymnasium and h5py raise on files that are damaged."""


def import_minari() -> ModuleType:
    """Import Minari; the ImportError says how to install it."""
    try:
        import minari
    except ImportError as error:
        raise ImportError("Minari datasets need an optional package: pip install 'nht[minari]'.") from error
    return minari


def datasets_root() -> Path:
    """Where Minari keeps local datasets; not made if it is not there, as ``minari.storage`` would."""
    return Path(os.environ.get("MINARI_DATASETS_PATH") or Path.home() / ".minari" / "datasets")


@contextmanager
def datasets_in(root: Path) -> Iterator[None]:
    """Within, Minari reads and writes below ``root``; only an environment variable can tell it so."""
    before = os.environ.get("MINARI_DATASETS_PATH")
    os.environ["MINARI_DATASETS_PATH"] = str(root)
    try:
        yield
    finally:
        os.environ.pop("MINARI_DATASETS_PATH")
        if before is not None:
            os.environ["MINARI_DATASETS_PATH"] = before


def check_dataset_id(dataset_id: str) -> None:
    """Raise ValueError for an invalid dataset id.

    Relies on ``minari.dataset.minari_dataset.parse_dataset_id``, which fails otherwise where the version is missing.
    """
    from minari.dataset.minari_dataset import parse_dataset_id

    try:
        parse_dataset_id(dataset_id)
    except TypeError:
        raise ValueError(
            f"Malformed dataset ID: {dataset_id}. It must end in a version, such as {dataset_id}-v0."
        ) from None


def episode_buffer(**arrays: Any) -> EpisodeBuffer:
    """An episode for ``minari.create_dataset_from_buffers``.

    Relies on ``EpisodeBuffer`` taking arrays where Minari says lists: arrays keep their types.
    """
    from minari.data_collector import EpisodeBuffer

    return EpisodeBuffer(**arrays)


def episode_entry(episode: int, name: str) -> str:
    """Where the observations or actions of an episode stand in the file."""
    return f"episode_{episode}/{name}"


def tuple_entry(number: int) -> str:
    """What Minari calls the part of a tuple in the file."""
    return f"_index_{number}"
