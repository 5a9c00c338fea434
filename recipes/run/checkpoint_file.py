"""Reads the file of a checkpoint without pickle: state dictionaries in one archive in TorchRL's layout.

An archive is a ZIP file of members that are stored, not compressed. For each part it has ``state.json``, which says how
dictionaries, lists and numbers are nested, and a raw file for each tensor with a ``meta.json`` beside them; and
``manifest.json`` says what parts there are, with a checksum of each member. Archives of earlier versions have no
checksums but those of ZIP, and hold the replay buffer as TorchRL's ``dump`` leaves it.
"""

from __future__ import annotations

import hashlib
import math
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

import torch
from torch import Tensor

from nht.memmap_files import DTYPES, META, STORAGE, TENSORDICT_TYPE, file_name, raw
from nht.reading import MAX_TEXT, checksum, entry, parse_json, plain_file, shortened
from nht.recipes.run.state_json import from_json

FORMAT, FORMAT_VERSION = "torchrl.checkpoint", 1
CHECKPOINT_MANIFEST = "manifest.json"
CHUNK_BYTES = 2**24
DAMAGED = (
    zipfile.BadZipFile,
    OSError,
    EOFError,
    NotImplementedError,
    RuntimeError,
    KeyError,
    ValueError,
    OverflowError,
)
"""What ``zipfile`` raises on archives that are damaged."""


class CheckpointFile:
    """A checkpoint that is open for reading; nothing is unpickled, unpacked or written.

    Args:
        file: of the checkpoint.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is damaged, was changed, or is not a checkpoint.
    """

    def __init__(self, file: Path) -> None:
        self.file = plain_file(file)
        try:
            self._archive = zipfile.ZipFile(file)
            self._members = self._checked_members()
        except DAMAGED as error:
            raise ValueError(f"{file} is no checkpoint, or is cut short: {shortened(error)}.") from error
        self._sums: dict[str, str] = {}
        self.manifest = self._read_manifest()
        self._sums = self.manifest.get("sha256", {})

    def __enter__(self) -> CheckpointFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._archive.close()

    def _checked_members(self) -> dict[str, zipfile.ZipInfo]:
        """The members by name, after checking that each is there once, uncompressed, and all fit into the file."""
        members = {info.filename: info for info in self._archive.infolist()}
        if len(members) < len(self._archive.infolist()):
            raise ValueError("two members have the same name.")
        for name, info in members.items():
            if info.compress_type != zipfile.ZIP_STORED or info.flag_bits & 1:
                raise ValueError(f"{shortened(name, 80)!r} is compressed or encrypted, expected it as it is.")
            if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or "\\" in name:
                raise ValueError(f"{shortened(name, 80)!r} would lie outside.")
        if sum(info.file_size for info in members.values()) > self.file.stat().st_size:
            raise ValueError("its members are said to be larger than the file.")
        return members

    def _read_manifest(self) -> dict[str, Any]:
        where = f"{self.file}, {CHECKPOINT_MANIFEST}"
        manifest = self._json(CHECKPOINT_MANIFEST)
        if manifest.get("format") != FORMAT:
            raise ValueError(f"{where} is not marked {FORMAT!r}.")
        if entry(manifest, "format_version", int, where) != FORMAT_VERSION:
            raise ValueError(
                f"{where} has format version {manifest['format_version']}, expected {FORMAT_VERSION}."
            )
        expected = manifest.pop("checksum", None)
        if ("sha256" in manifest or expected is not None) and expected != checksum(manifest):
            raise ValueError(
                f"{where} was changed since it was written: its checksum is that of another one."
            )
        for name, record in entry(manifest, "components", dict, where).items():
            if not isinstance(record, dict):
                raise ValueError(f"{where}: component {shortened(name, 80)!r} must be an object.")
            entry(record, "path", str, where)
            entry(record, "adapter", str, where)
        return manifest

    def check(self) -> None:
        """Raise ValueError unless all members have their checksums."""
        if self._sums and self._sums.keys() != self._members.keys() - {CHECKPOINT_MANIFEST}:
            raise ValueError(f"{self.file} has other members than its {CHECKPOINT_MANIFEST} says.")
        for name in self._members:
            self._read(name)

    def read(self) -> dict[str, Any]:
        """The state dictionaries by part. A replay buffer that TorchRL dumped is a dictionary of rows and writer."""
        found = {}
        for name, record in self.manifest["components"].items():
            try:
                if record["adapter"] == "torchrl.dump_load":
                    found[name] = self._dumped_buffer(record["path"])
                else:
                    found[name] = self._state(record["path"])
            except RecursionError:
                raise ValueError(f"{self.file}, {name!r} is nested too deeply.") from None
        return found

    def _state(self, folder: str) -> Any:
        about = self._json(f"{folder}/state/meta.json")
        where = f"{self.file}, {folder}"
        tensors = {
            key: self._tensor(f"{folder}/state/{key}.memmap", entry_, f"{where}, {shortened(key, 40)!r}")
            for key, entry_ in about.items()
            if isinstance(entry_, dict)
        }
        return from_json(self._json(f"{folder}/state.json"), tensors, where)

    def _tensor(self, name: str, about: dict[str, Any], where: str) -> Tensor:
        kind, shape = entry(about, "dtype", str, where), entry(about, "shape", list, where)
        if kind not in DTYPES or not all(type(size) is int and size >= 0 for size in shape):
            raise ValueError(
                f"{where} has no possible type and shape: {shortened(kind, 40)} {shortened(shape, 80)}."
            )
        needed = math.prod(shape) * DTYPES[kind].itemsize
        if not needed:
            return torch.empty(shape, dtype=DTYPES[kind])
        found = self._member(name).file_size
        if found != needed:
            raise ValueError(f"{where} has {found:,} bytes, expected {needed:,} for {kind} {shape}.")
        tensor = torch.empty(shape, dtype=DTYPES[kind])
        self._read(name, raw(tensor))
        return tensor

    def _dumped_buffer(self, folder: str) -> dict[str, Any]:
        """A replay buffer from TorchRL's ``dump``, without what that pickles: a queue that is empty here."""
        where = f"{self.file}, {folder}"
        storage = self._json(f"{folder}/storage/{STORAGE}")
        if entry(storage, "is_pytree", bool, where):
            raise ValueError(f"{where} is of nested tuples or lists, expected a TensorDict.")
        rows = self._rows(f"{folder}/storage", entry(storage, "len", int, where))
        writer = self._json(f"{folder}/writer/metadata.json")
        names = ("cursor", "write_count")
        return {"rows": rows, "writer": {f"_{name}": entry(writer, name, int, where) for name in names}}

    def _rows(self, folder: str, length: int) -> dict[str, Any]:
        """The first rows of a TensorDict that is stored in raw files."""
        about = self._json(f"{folder}/{META}")
        if about.get("_type") != TENSORDICT_TYPE:
            raise ValueError(f"{self.file}, {folder}/{META} is of another type than TensorDict.")
        rows: dict[str, Any] = {}
        for key, record in about.items():
            name, where = f"{folder}/{file_name(key)}", f"{self.file}, {folder}, {shortened(key, 60)!r}"
            if not isinstance(record, dict):
                continue  # shape, device and type of the whole
            if "type" in record:
                rows[key] = self._rows(name, length)
                continue
            values = self._tensor(f"{name}.memmap", record, where)
            if not 0 <= length <= (len(values) if values.ndim else 0):
                raise ValueError(
                    f"{where} has the shape {list(values.shape)}, of which {length} rows are filled."
                )
            rows[key] = values[:length]
        return rows

    def _member(self, name: str) -> zipfile.ZipInfo:
        if name not in self._members:
            raise ValueError(f"{self.file} lacks {shortened(name, 120)!r}.")
        return self._members[name]

    def _json(self, name: str) -> dict[str, Any]:
        size = self._member(name).file_size
        if size > MAX_TEXT:
            raise ValueError(
                f"{self.file}, {name} has {size:,} bytes, expected text of at most {MAX_TEXT:,}."
            )
        content = memoryview(bytearray(size))
        self._read(name, content)
        return parse_json(bytes(content), f"{self.file}, {name}")

    def _read(self, name: str, into: memoryview | None = None) -> None:
        """Read all of a member, into ``into`` if given, and compare its checksums."""
        digest, done = hashlib.sha256(), 0
        try:
            with self._archive.open(self._member(name)) as member:
                while chunk := member.read(CHUNK_BYTES):
                    digest.update(chunk)
                    if into is not None:
                        into[done : done + len(chunk)] = chunk
                    done += len(chunk)
        except DAMAGED as error:
            raise ValueError(
                f"{self.file}, {shortened(name, 120)} is damaged: {shortened(error)}."
            ) from error
        if self._sums and name != CHECKPOINT_MANIFEST and self._sums.get(name) != digest.hexdigest():
            raise ValueError(
                f"{self.file}, {name} was changed since it was written: its checksum is another."
            )
