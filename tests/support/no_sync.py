"""Finds what would make a GPU wait: values of tensors that Python, or the shape of another tensor, asks for."""

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

aten = torch.ops.aten
WAITING = {
    aten._local_scalar_dense.default,
    aten.is_nonzero.default,
    aten.nonzero.default,
    aten.masked_select.default,
    aten.equal.default,
    aten.unique_dim.default,
    aten._unique2.default,
}
"""Kernels whose result the host waits for."""
COPYING = {Tensor.numpy, Tensor.__array__, Tensor.cpu, Tensor.tolist}
"""What brings a tensor to the host; on the CPU no kernel shows it."""


class _Kernels(TorchDispatchMode):
    def __init__(self, found):
        super().__init__()
        self.found = found

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func in WAITING or (func is aten.index.Tensor and any(_is_mask(index) for index in args[1])):
            self.found.append(str(func))
        return func(*args, **(kwargs or {}))


class _Copies(TorchFunctionMode):
    def __init__(self, found):
        super().__init__()
        self.found = found

    def __torch_function__(self, func, types, args=(), kwargs=None):
        if func in COPYING:
            self.found.append(func.__name__)
        return func(*args, **(kwargs or {}))


def _is_mask(index):
    return index is not None and index.dtype in (torch.bool, torch.uint8)


class Waits:
    """While this is entered, ``found`` lists what a GPU would be waited for."""

    def __init__(self):
        self.found = []
        self._modes = [_Kernels(self.found), _Copies(self.found)]

    def __enter__(self):
        for mode in self._modes:
            mode.__enter__()
        return self

    def __exit__(self, *error):
        for mode in reversed(self._modes):
            mode.__exit__(*error)
