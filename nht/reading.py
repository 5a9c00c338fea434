"""Reads files that others may have written: plain files of bounded size, whose contents are checked before use.

Nothing here follows a link, opens a pipe or runs what it reads. Every error names the file, what is wrong with it and
what was expected.
"""

from __future__ import annotations

import hashlib
import json
import stat
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

MAX_TEXT = 64 * 2**20
"""Size of the largest text file that is read [bytes]."""

MAX_SHOWN = 12
"""Names that a message lists before it says how many more there are."""


def plain_file(file: Path) -> Path:
    """Check that a file is a plain one, no link, pipe, device or folder, and return it.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a plain file.
    """
    try:
        mode = file.lstat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(f"there is no file {file}.") from None
    except (OSError, ValueError) as error:  # a name that is too long, or has a zero in it
        raise ValueError(f"{str(file)[:200]!r} is no name of a file: {error}.") from None
    if stat.S_ISLNK(mode):
        raise ValueError(
            f"{file} is a link, expected a plain file: links within a folder of data are not followed."
        )
    if not stat.S_ISREG(mode):
        raise ValueError(f"{file} is not a plain file.")
    return file


def read_text(file: Path) -> str:
    """The text of a plain file in UTF-8.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is no plain file, no text, or too large to be what it is said to be.
    """
    size = plain_file(file).stat().st_size
    if size > MAX_TEXT:
        raise ValueError(f"{file} has {size:,} bytes, expected text of at most {MAX_TEXT:,}.")
    try:
        return file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} is not text in UTF-8: {error}.") from None


def read_json(file: Path) -> dict[str, Any]:
    """The JSON object in a plain file. Raises as ``read_text`` does, and ValueError on anything but an object."""
    return parse_json(read_text(file), str(file))


def parse_json(text: str | bytes, name: str) -> dict[str, Any]:
    """The JSON object in ``text``, which came from the file ``name``.

    Raises:
        ValueError: if it is no JSON, has a name twice, or is no object.
    """
    try:
        value = json.loads(text, object_pairs_hook=_unique)
    except RecursionError:
        raise ValueError(f"{name} is not JSON that can be read: it is nested too deeply.") from None
    except ValueError as error:
        raise ValueError(f"{name} is not JSON: {shortened(error)}.") from None
    if not isinstance(value, dict):
        raise ValueError(f"{name} holds a JSON {type(value).__name__}, expected an object.")
    return value


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("an object has the same name twice.")
    return found


@contextmanager
def naming(file: object) -> Iterator[None]:
    """Within, errors about the contents of a file name it, and torch's errors about shapes become ValueErrors."""
    try:
        yield
    except (ValueError, KeyError) as error:
        text = str(error.args[0]) if error.args else ""
        if type(error) not in (ValueError, KeyError) or str(file) in text:
            raise
        raise type(error)(f"{file}: {text.removesuffix('.')}.") from error
    except (RuntimeError, IndexError, TypeError) as error:
        raise ValueError(f"{file} holds arrays that do not go together: {shortened(error)}.") from error


def entry(record: Mapping[str, Any], name: str, kind: type | tuple[type, ...], where: str) -> Any:
    """The value at ``name`` in a JSON object, of the type that it must have.

    Args:
        record: the object.
        name: of the value.
        kind: type or types that are allowed; a bool never counts as an integer.
        where: the file, for messages.

    Raises:
        ValueError: if it is missing or of another type.
    """
    kinds = kind if isinstance(kind, tuple) else (kind,)
    expected = " or ".join("null" if one is type(None) else one.__name__ for one in kinds)
    if name not in record:
        raise ValueError(f"{where} lacks {name!r}, expected {expected}.")
    value = record[name]
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise ValueError(f"{where}: {name!r} must be {expected}, got {shortened(repr(value), 80)}.")
    return value


def known_entries(record: Mapping[str, Any], names: Iterable[str], where: str) -> None:
    """Raise ValueError if a JSON object has other names than ``names``."""
    if unknown := sorted(record.keys() - set(names)):
        raise ValueError(
            f"{where} has unknown entries {shown(unknown)}; known are {shown(sorted(names), 20)}."
        )


def checksum(record: Mapping[str, Any]) -> str:
    """SHA-256 of a JSON object, whatever the order of its names and the spaces between them."""
    return hashlib.sha256(json.dumps(record, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def shown(names: Iterable[object], at_most: int = MAX_SHOWN) -> str:
    """Names for a message: ``['a', 'b', and 3 more]``."""
    found = [repr(name) for name in names]
    more = [f"and {len(found) - at_most:,} more"] if len(found) > at_most else []
    return shortened(f"[{', '.join([*found[:at_most], *more])}]", 1000)


def shortened(text: object, at_most: int = 300) -> str:
    """A text for a message, on one line and cut where it is long; without a full stop at its end."""
    line = " ".join(str(text).split()).removesuffix(".")
    return line if len(line) <= at_most else f"{line[:at_most]}..."
