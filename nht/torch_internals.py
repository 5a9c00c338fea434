"""All private parts of PyTorch that this package needs; tests check each against its description."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor
from torch.export import ExportedProgram


def write_machine_code(program: ExportedProgram, path: Path, metadata: dict[str, str]) -> None:
    """Compile an exported program for this kind of processor, into a package for C++ and Python.

    Relies on ``torch._inductor.aoti_compile_and_package`` and its option ``aot_inductor.metadata``: the compiled
    package gives these entries back as its metadata. PyTorch documents both, under this private name alone.

    Args:
        program: what is compiled.
        path: of the package, ending in .pt2.
        metadata: entries, by name.
    """
    from torch._inductor import aoti_compile_and_package  # takes a second, and few compile

    options = {"aot_inductor.metadata": metadata}
    aoti_compile_and_package(program, package_path=str(path), inductor_configs=options)


@torch.no_grad()
def adam_step(
    parameters: list[Tensor],
    gradients: list[Tensor],
    means: list[Tensor],
    squares: list[Tensor],
    step: Tensor,
    rate: float,
) -> None:
    """Take the step that ``torch.optim.Adam(fused=True)`` takes, without what it looks up each time.

    Relies on ``torch._fused_adam_``, the operation behind that optimiser, and on its arguments.

    Args:
        parameters: what is moved, in place.
        gradients: of each parameter.
        means: running means of the gradients, at first 0; changed in place.
        squares: running means of their squares, likewise.
        step: scalar float32, on the parameters' device: how many steps this one makes.
        rate: the learning rate.
    """
    torch._fused_adam_(
        parameters,
        gradients,
        means,
        squares,
        [],
        len(parameters) * [step],
        lr=rate,
        beta1=0.9,
        beta2=0.999,
        weight_decay=0.0,
        eps=1e-8,
        amsgrad=False,
        maximize=False,
    )
