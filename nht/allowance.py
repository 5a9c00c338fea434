"""Limits the memory that a constructor may allocate: a file of two kilobytes could describe networks of any size."""

from __future__ import annotations

from typing import Any

import torch
from torch.overrides import TorchFunctionMode

FACTORIES = (torch.empty, torch.zeros, torch.ones, torch.full, torch.eye, torch.rand, torch.randn)
SLACK = 2**24  # [bytes]


class FarLargerError(ValueError):
    """A file describes something that takes far more memory than the file holds."""


class Allowance(TorchFunctionMode):
    """A context manager within which new tensors may not be much larger than a file's weights.

    ``FarLargerError`` is raised before the tensor that exceeds the limit is made.

    Args:
        size: of the weights that the file holds [bytes].
        described: what it describes, for the message.
    """

    def __init__(self, size: int, described: str = "a map") -> None:
        super().__init__()
        self.described = described
        self.size, self.left = size, 4 * size + SLACK  # what is made on the way counts too

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        if func in FACTORIES:
            sized = {
                key: value for key, value in kwargs.items() if key not in ("generator", "out", "pin_memory")
            }
            try:
                self.left -= func(*args, **sized | {"device": "meta"}).nbytes
            except (RuntimeError, TypeError) as error:
                if "overflow" not in str(error).lower():  # sizes that cannot be counted
                    raise
                self.left = -1
            if self.left < 0:
                raise FarLargerError(
                    f"describes {self.described} far larger than the {self.size} bytes of weights that it holds."
                )
        return func(*args, **kwargs)
