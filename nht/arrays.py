"""Arrays from elsewhere, of any type and byte order, as tensors that torch computes with."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from nht.reading import shortened

WIDER: dict[str, type[np.generic]] = {
    "u2": np.int32,
    "u4": np.int64,
    "f2": np.float32,
    "f16": np.float64,
    "f12": np.float64,
}
"""NumPy types that torch hardly supports, each with a type that holds its values; a long double is rounded."""


def as_tensor(values: Tensor | ArrayLike, name: str) -> Tensor:
    """A tensor of the same values: floats, integers or truth values.

    Args:
        values: a tensor, which is handed through, or an array or list of any byte order.
        name: of the values, for messages.

    Raises:
        ValueError: on text, dates, complex numbers, objects, and integers that fit no int64.
    """
    if isinstance(values, Tensor):
        return values
    try:
        array: Any = np.asarray(values)
    except ValueError as error:  # lists of different lengths
        raise ValueError(f"{name} is no array: {shortened(error)}.") from None
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{name} must hold numbers or truth values, got an array of type {array.dtype}.")
    kind = array.dtype.str[1:]
    if kind == "u8":
        if array.size and array.max() > np.iinfo(np.int64).max:
            raise ValueError(f"{name} holds unsigned integers up to {array.max()}, more than an int64 can.")
        array = array.astype(np.int64)
    wanted = np.dtype(WIDER[kind]) if kind in WIDER else array.dtype.newbyteorder("=")
    array = array.astype(wanted, copy=False)
    if not (array.flags.writeable and array.flags.c_contiguous):
        array = array.copy()
    return torch.from_numpy(array)
