"""How ``TensorDict.memmap`` lays a TensorDict out in raw files: the names of the files, and writing them.

The layout is TensorDict's own and not documented. Tests compare it, both ways, with what TensorDict writes and reads.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

META, STORAGE = "meta.json", "storage_metadata.json"
DTYPES = {
    str(dtype): dtype
    for dtype in (
        torch.bool,
        torch.uint8,
        torch.uint16,
        torch.uint32,
        torch.uint64,
        torch.int8,
        torch.int16,
        torch.int32,
        torch.int64,
        torch.float16,
        torch.bfloat16,
        torch.float32,
        torch.float64,
        torch.complex64,
        torch.complex128,
    )
}
TENSORDICT_TYPE = "<class 'tensordict._td.TensorDict'>"
"""The type of a TensorDict in its ``meta.json``."""


def file_name(key: str) -> str:
    """What TensorDict calls the file of a key: always a name within its folder."""
    if key in ("", ".", ".."):
        return "%2E" * len(key) or "%"
    unsafe = set('/<>:"|?*\\ %\x7f')
    return "".join(f"%{ord(char):02X}" if char in unsafe or ord(char) < 32 else char for char in key)


def write_tensordict(data: TensorDictBase, folder: Path) -> None:
    """Write a TensorDict of tensors into a new folder, as ``TensorDict.memmap`` lays it out.

    Files are written, not mapped: on a full disk this raises, where writing into mapped memory kills the process.

    Raises:
        OSError: if there is no room.
        ValueError: on an entry that is no tensor.
    """
    folder.mkdir(parents=True)
    record: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, TensorDictBase):
            write_tensordict(value, folder / file_name(key))
            record[key] = {"type": "TensorDict"}
            continue
        if not isinstance(value, Tensor):
            raise ValueError(f"only tensors are written, but key {key!r} holds a {type(value).__name__}.")
        record[key] = {
            "device": "cpu",
            "shape": list(value.shape),
            "dtype": str(value.dtype),
            "is_nested": False,
        }
        if value.numel():
            (folder / f"{file_name(key)}.memmap").write_bytes(raw(value))
    record |= {"shape": list(data.batch_size), "device": "cpu", "_type": TENSORDICT_TYPE}
    (folder / META).write_text(json.dumps(record, separators=(",", ":")))


def raw(value: Tensor) -> memoryview:
    """The bytes of a tensor's values, in order."""
    return value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().data
