"""State dictionaries as JSON with tensors beside it, in TorchRL's format; reading gives plain values only."""

from __future__ import annotations

import re
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nht.reading import entry, shortened
from nht.recipes.torch_internals import layout_versions, set_layout_versions

DEVICE = re.compile(r"cpu|(cuda|xpu|mps)(:\d{1,3})?")


def as_json(value: Any, tensors: dict[str, Tensor]) -> dict[str, Any]:
    """A value as JSON, with a name for each tensor or array; these are put into ``tensors`` by name."""
    if isinstance(value, (Tensor, np.ndarray)):
        key = f"tensor_{len(tensors):08d}"
        tensors[key] = value.detach() if isinstance(value, Tensor) else torch.from_numpy(value.copy())
        if isinstance(value, Tensor):
            return {"kind": "tensor", "key": key, "device": str(value.device)}
        return {"kind": "numpy", "key": key, "dtype": value.dtype.str}
    if isinstance(value, Mapping):
        about = layout_versions(value)
        items = [[as_json(key, tensors), as_json(item, tensors)] for key, item in value.items()]
        kind = "ordered_dict" if isinstance(value, OrderedDict) else "dict"
        return {"kind": kind, "items": items} | (
            {} if about is None else {"metadata": as_json(about, tensors)}
        )
    if isinstance(value, (list, tuple)):
        if isinstance(value, torch.Size):
            return {"kind": "torch_size", "items": list(value)}
        kind = "list" if isinstance(value, list) else "tuple"
        return {"kind": kind, "items": [as_json(item, tensors) for item in value]}
    if isinstance(value, np.generic):
        return {"kind": "numpy_scalar", "dtype": value.dtype.str, "value": value.item()}
    if value is None or isinstance(value, (bool, int, float, str)):
        return {"kind": "value", "value": value}
    raise TypeError(
        f"a checkpoint holds tensors, numbers, text, lists and dictionaries, not {type(value).__name__}."
    )


def from_json(node: Any, tensors: Mapping[str, Tensor], where: str) -> Any:
    """The value that ``as_json``, or TorchRL, wrote: plain values, lists, dictionaries, tensors and arrays only."""
    if not isinstance(node, dict):
        raise ValueError(f"{where}/state.json holds {shortened(repr(node), 60)} where an object should be.")
    kind = entry(node, "kind", str, where)
    if kind in ("tensor", "numpy"):
        key = entry(node, "key", str, where)
        if key not in tensors:
            raise ValueError(f"{where}/state.json names {shortened(key, 60)!r}, which is not there.")
        return _placed(tensors[key], node, where) if kind == "tensor" else _array(tensors[key], node, where)
    if kind == "value":
        value = node.get("value")
        if value is None or isinstance(value, (bool, int, float, str)):
            return value
    elif kind == "numpy_scalar":
        return _array(torch.tensor(entry(node, "value", (bool, int, float), where)), node, where)[()]
    elif kind in ("dict", "ordered_dict"):
        return _mapping(node, tensors, where)
    elif kind in ("list", "tuple", "torch_size"):
        items = entry(node, "items", list, where)
        if kind == "torch_size":
            return torch.Size(size for size in items if type(size) is int)
        return {"list": list, "tuple": tuple}[kind](from_json(item, tensors, where) for item in items)
    raise ValueError(f"{where}/state.json holds a value of the unknown kind {shortened(kind, 60)!r}.")


def _mapping(node: dict[str, Any], tensors: Mapping[str, Tensor], where: str) -> dict[Any, Any]:
    found: Any = OrderedDict() if node["kind"] == "ordered_dict" else {}
    for pair in entry(node, "items", list, where):
        if not isinstance(pair, list) or len(pair) != 2:
            raise ValueError(f"{where}/state.json holds a dictionary whose items are no pairs.")
        key = from_json(pair[0], tensors, where)
        if not isinstance(key, (str, int, float, bool, type(None))):
            raise ValueError(
                f"{where}/state.json holds a dictionary with a key that is a {type(key).__name__}."
            )
        found[key] = from_json(pair[1], tensors, where)
    if node.get("metadata") is not None and isinstance(found, OrderedDict):
        set_layout_versions(found, from_json(node["metadata"], tensors, where))
    return found


def _placed(tensor: Tensor, node: dict[str, Any], where: str) -> Tensor:
    """The tensor on the device that it was saved from, if this machine has it."""
    device = entry(node, "device", str, where)
    if not DEVICE.fullmatch(device):
        raise ValueError(f"{where}/state.json names the unknown device {shortened(device, 60)!r}.")
    if device.startswith("cuda") and torch.cuda.is_available():
        return tensor.to(device)
    return tensor


def _array(tensor: Tensor, node: dict[str, Any], where: str) -> Any:
    name = entry(node, "dtype", str, where)
    try:
        dtype = np.dtype(name)
    except TypeError:
        dtype = np.dtype("V")
    if dtype.kind not in "biuf":
        raise ValueError(f"{where}/state.json names {shortened(name, 60)!r}, which is no type of numbers.")
    return tensor.numpy().astype(dtype, copy=False)
