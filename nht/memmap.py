"""Reads TensorDicts from untrusted folders of raw files, in the layout of ``TensorDict.memmap``.

A folder has a ``meta.json``, which says type, shape and batch size, one ``key.memmap`` of raw values for each tensor,
and one folder for each TensorDict inside. TensorDict's own reader trusts the ``meta.json``: it unpickles what is marked
as pickled, and lengthens files that are shorter than they should be. This one compares all sizes with the files first,
maps privately, so that neither reading nor writing to a tensor can change a file, and unpickles nothing.
"""

from __future__ import annotations

import math
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from tensordict import LazyStackedTensorDict, NonTensorStack, TensorDict, TensorDictBase
from torch import Tensor

from nht.memmap_files import DTYPES, META, STORAGE, TENSORDICT_TYPE, file_name
from nht.reading import entry, plain_file, read_json, shortened

STACK = "<class 'tensordict._lazy.LazyStackedTensorDict'>"
DATA = "<class 'tensordict.tensorclass.NonTensorData'>"
DATA_STACK = "<class 'tensordict.tensorclass.NonTensorStack'>"
TRUSTED_MEMMAP = (
    "If you trust the folder, load it yourself with tensordict.TensorDict.load_memmap(folder, allow_pickle=True) and "
    "hand the data over: nht.Demos.from_tensordict(data)"
)


def read_tensordict(folder: str | Path) -> TensorDictBase:
    """A TensorDict from its folder of raw files, or from that of a TorchRL storage, as far as it is filled.

    Values stay on disk until they are looked at. Whatever is then done to the tensors, the files stay as they are.

    Raises:
        FileNotFoundError: if ``folder`` has no ``meta.json``.
        ValueError: if a file has another length than ``meta.json`` says, is missing, a link or pickled, or is of a kind
            that is not read.
    """
    folder = Path(folder)
    if not (folder / META).is_file():
        raise FileNotFoundError(f"{folder} holds no TensorDict: there is no {META} in it.")
    try:
        data = _read(folder)
    except (RuntimeError, TypeError, KeyError) as error:  # TensorDict's own, and folders nested without end
        raise ValueError(f"the TensorDict in {folder} cannot be read: {shortened(error)}.") from error
    if not isinstance(data, TensorDictBase):
        raise ValueError(f"{folder / META} holds no tensors.")
    if math.prod(data.batch_size) and not any(value.numel() for value in _tensors(data)):
        raise ValueError(f"{folder / META} says batch size {list(data.batch_size)}, but there are no values.")
    if (folder / STORAGE).exists():
        return data[: _filled(folder / STORAGE, data)]
    return data


def _tensors(data: TensorDictBase) -> list[Tensor]:
    return [value for value in data.values(True, True) if isinstance(value, Tensor)]


def _filled(file: Path, data: TensorDictBase) -> int:
    """How many rows of a storage are filled: it may have room for more."""
    record = read_json(file)
    if entry(record, "is_pytree", bool, str(file)):
        raise ValueError(f"{file} is of a storage of nested tuples or lists, expected one of a TensorDict.")
    length = entry(record, "len", int, str(file))
    room = data.batch_size[0] if data.batch_size else 0
    if not 0 <= length <= room:
        raise ValueError(f"{file}: 'len' must be between 0 and the {room} rows that there are, got {length}.")
    return int(length)


def _read(folder: Path) -> Any:
    """What a folder holds: a TensorDict, or a value that is no tensor."""
    file = folder / META
    record = read_json(file)
    kind = entry(record, "_type", str, str(file))
    pickled = [name for name in ("other.pickle", "pickle.pkl") if os.path.lexists(folder / name)]
    if pickled or (kind == DATA_STACK and record.get("data") == "pickle.pkl"):
        raise ValueError(
            f"{folder} holds pickled data, which could run any code, and is not read. {TRUSTED_MEMMAP}."
        )
    if kind == DATA:
        return _Value(record.get("data"))
    if kind == DATA_STACK and "data" in record:
        return NonTensorStack.from_list(entry(record, "data", list, str(file)))
    if kind in (STACK, DATA_STACK):
        return _read_stack(folder, record)
    if kind != TENSORDICT_TYPE:
        raise ValueError(
            f"{file} is of {shortened(kind, 80)}, expected a TensorDict or a stack of them. {TRUSTED_MEMMAP}."
        )
    return _read_plain(folder, record)


class _Value:
    """A value that is no tensor."""

    def __init__(self, value: Any) -> None:
        self.value = value


def _read_plain(folder: Path, record: dict[str, Any]) -> TensorDict:
    file = folder / META
    batch = _shape(record.get("shape", []), file, "shape")
    data = TensorDict(batch_size=batch, device="cpu")
    for key, about in record.items():
        if not isinstance(about, dict):
            continue  # shape, device and type of the whole
        where = f"{file}, entry {shortened(key, 80)!r}"
        value = (
            _read(_inner(folder, key, where)) if "type" in about else _read_tensor(folder, key, about, where)
        )
        if isinstance(value, _Value):
            data.set_non_tensor(key, value.value)
            continue
        shape = value.shape if isinstance(value, Tensor) else value.batch_size
        if list(shape[: len(batch)]) != batch:
            raise ValueError(
                f"{where} has shape {list(shape)}, which does not begin with the batch size {batch}."
            )
        data.set(key, value)
    return data


def _read_stack(folder: Path, record: dict[str, Any]) -> TensorDictBase:
    file = folder / META
    dim: int = entry(record, "stack_dim", int, str(file))
    parts: list[Any] = []
    while (part := folder / str(len(parts))).exists():
        parts.append(_read(_inner(folder, part.name, str(part))))
    shapes = {tuple(part.batch_size) for part in parts if isinstance(part, TensorDictBase)}
    if len(shapes) != 1 or not all(isinstance(part, TensorDictBase) for part in parts):
        raise ValueError(
            f"{file} is of a stack, expected folders 0, 1, ... with TensorDicts of one batch size."
        )
    if not 0 <= dim <= len(shapes.pop()):
        raise ValueError(f"{file}: 'stack_dim' must be one of the dimensions, got {dim}.")
    return LazyStackedTensorDict(*parts, stack_dim=dim)


def _read_tensor(folder: Path, key: str, about: Mapping[str, Any], where: str) -> Tensor:
    """One raw file, mapped so that it cannot be changed."""
    if about.get("is_nested"):
        raise ValueError(f"{where} is a nested tensor, which is not read. {TRUSTED_MEMMAP}.")
    name = entry(about, "dtype", str, where)
    if name not in DTYPES:
        raise ValueError(f"{where} is of type {shortened(name, 80)!r}, expected one of {', '.join(DTYPES)}.")
    dtype, shape = DTYPES[name], _shape(about.get("shape"), where, "shape")
    size = math.prod(shape)
    if not size:
        return torch.empty(shape, dtype=dtype)  # TensorDict writes no file for these
    file = plain_file(_named(folder, f"{key}", ".memmap", where))
    needed, found = size * dtype.itemsize, file.stat().st_size
    if found != needed:
        raise ValueError(
            f"{file} has {found:,} bytes, expected {needed:,} for {name} {shape} as {META} says: it was cut short, or "
            f"{META} is of other data."
        )
    return torch.from_file(str(file), shared=False, size=size, dtype=dtype).view(shape)


def _inner(folder: Path, key: str, where: str) -> Path:
    """The folder of a TensorDict inside: a folder, not a link to one."""
    inner = _named(folder, key, "", where)
    if not os.path.lexists(inner) or not stat.S_ISDIR(inner.lstat().st_mode):
        raise ValueError(f"{where}: {inner} is no folder, or a link to one.")
    if not (inner / META).is_file():
        raise ValueError(f"{where}: there is no {META} in {inner}.")
    return inner


def _named(folder: Path, key: str, suffix: str, where: str) -> Path:
    """The file of a key: TensorDict writes what is unsafe in a name as ``%2F``; older versions wrote it as it was."""
    names = [file_name(key)]
    if not set("/\\\0") & set(key) and key not in ("", ".", ".."):
        names.append(key)
    try:
        found = [folder / f"{name}{suffix}" for name in names if os.path.lexists(folder / f"{name}{suffix}")]
    except (OSError, ValueError) as error:
        raise ValueError(f"{where} has no possible file: {error}.") from None
    if not found:
        raise ValueError(f"{where} has no file {shortened(folder / f'{names[0]}{suffix}')}.")
    return found[0]


def _shape(value: Any, where: object, name: str) -> list[int]:
    if not isinstance(value, list) or not all(type(size) is int and size >= 0 for size in value):
        raise ValueError(f"{where}: {name!r} must be a list of sizes, got {shortened(repr(value), 80)}.")
    if math.prod(value) >= 2**60:
        raise ValueError(f"{where}: {name!r} says {shortened(value, 80)}, more than any file holds.")
    return value
