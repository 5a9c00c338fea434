"""All private parts of PyTorch that this package needs; tests check each against its description."""

from __future__ import annotations

from pathlib import Path

from torch._inductor import aoti_compile_and_package
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
    options = {"aot_inductor.metadata": metadata}
    aoti_compile_and_package(program, package_path=str(path), inductor_configs=options)
