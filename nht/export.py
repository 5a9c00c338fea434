"""A map as a program in a file, for a control loop in C++, ROS or Python that knows nothing of this package."""

from __future__ import annotations

import copy
import importlib.util
import json
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.export import Dim, ExportedProgram

from nht.action_map import ActionMap
from nht.description import describe
from nht.torch_internals import write_machine_code
from nht.writing import replacing

SUFFIXES = (".pt2", ".onnx")


Limits = float | Sequence[float] | Tensor


def export_map(
    map: ActionMap,
    path: str | Path,
    *,
    action_scale: float | None = None,
    low: Limits | None = None,
    high: Limits | None = None,
    compiled: bool = False,
) -> Path:
    """Write what a policy's action in [-1, 1]^k does: ``map.decode(action, context, low, high)``.

    Inputs, in this order: "action" (batch, k) and "context" (batch, context_dim, which may be 0); output: "actuation"
    (batch, n). All are in the map's precision, and for any batch. Without limits, the program does not limit the
    actuation.

    - ``name.onnx``: for ONNX Runtime and other engines.
    - ``name.pt2``: for ``torch.export.load``.
    - ``name.pt2``, compiled: machine code for the kind of processor and the PyTorch version that exported it, for
      ``torch::inductor::AOTIModelPackageLoader`` in C++ and ``torch._inductor.aoti_load_package``. Inputs of a wrong
      width are noticed only if the environment has AOTI_RUNTIME_CHECK_INPUTS=1. Takes a C++ compiler and a minute.

    In each, "map" holds the description that a map file has (context keys in order, widths, demonstrated bounds ...)
    as JSON: in the metadata of the ONNX model, the extra files of the exported program, the metadata of the compiled
    package. "action_scale" in it is the one that is applied here; do not scale again. "low" and "high", where they were
    given, are the limits that the program keeps to, as "saturation" says; null for a motor without one.

    A reader of ``path`` sees the old file or the whole new one, never a part. The map itself stays as it is.

    Args:
        map: any action map.
        path: its suffix, .onnx or .pt2, decides the format.
        action_scale: what 1 stands for, in the map's own units, in the exported copy. Default: the map's.
        low: the smallest actuations that the motors take, one for all or (n,); -infinity where there is no limit.
        high: the largest ones, likewise.
        compiled: compile for C++; .pt2 only.

    Returns:
        The path.

    Raises:
        TypeError: if ``map`` is no ActionMap.
        ValueError: on another suffix, on ``compiled`` for ONNX, on an ``action_scale`` that is not positive and finite,
            or on limits that are NaN, of another number than n, or the wrong way round.
        ImportError: if what the extra ``nht[onnx]`` installs is missing.
    """
    path = Path(path)
    if not isinstance(map, ActionMap):
        raise TypeError(f"map must be an nht.ActionMap, got {type(map).__name__}.")
    _check_format(path, compiled)
    exported = copy.deepcopy(map).cpu().requires_grad_(False)
    if action_scale is not None:
        exported.set_action_scale(action_scale)
    limits = _limits(exported, low, high)
    given = {
        name: _as_json(limit)
        for name, limit in zip(("low", "high"), limits, strict=True)
        if limit is not None
    }
    description = json.dumps(describe(exported) | given)
    program = _traced(_Interface(exported, *limits))
    with replacing(path) as scratch:
        if path.suffix == ".onnx":
            _write_onnx(program, scratch, description)
        elif compiled:
            write_machine_code(program, scratch, {"map": description})
        else:
            torch.export.save(program, scratch, extra_files={"map": description})
    return path


class _Interface(nn.Module):
    """The function that is exported."""

    low: Tensor | None
    high: Tensor | None

    def __init__(self, map: ActionMap, low: Tensor | None, high: Tensor | None) -> None:
        super().__init__()
        self.map = map
        self.register_buffer("low", low)
        self.register_buffer("high", high)
        self.eval()

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return self.map.decode(action, context, self.low, self.high)


def _limits(map: ActionMap, low: Limits | None, high: Limits | None) -> tuple[Tensor | None, Tensor | None]:
    """Both in the map's precision, (n,), or None."""
    n, limits = map.actuation_dim, []
    for name, given in (("low", low), ("high", high)):
        limit = None if given is None else torch.as_tensor(given).to(map.action_scale)
        if limit is not None and (limit.shape not in ((), (n,)) or limit.isnan().any()):
            raise ValueError(f"{name} must be one number or {n}, got {given}.")
        limits.append(None if limit is None else limit.expand(n).clone())
    lowest, highest = limits
    if lowest is not None and highest is not None and (lowest > highest).any():
        raise ValueError(f"low must not exceed high, got low={low} and high={high}.")
    return lowest, highest


def _as_json(limit: Tensor) -> list[float | None]:
    return [value if math.isfinite(value) else None for value in limit.tolist()]


def _check_format(path: Path, compiled: bool) -> None:
    if path.suffix not in SUFFIXES:
        raise ValueError(f"the suffix must be one of {', '.join(SUFFIXES)}, got {path.name!r}.")
    if path.suffix != ".onnx":
        return
    if compiled:
        raise ValueError(f"compiled is for .pt2 only, got {path.name!r}.")
    if missing := [name for name in ("onnx", "onnxscript") if importlib.util.find_spec(name) is None]:
        raise ImportError(f"ONNX needs {' and '.join(missing)}: pip install 'nht[onnx]'.")


def _traced(interface: _Interface) -> ExportedProgram:
    map, batch = interface.map, Dim("batch")
    dtype = map.action_scale.dtype
    example = torch.zeros(2, map.action_dim, dtype=dtype), torch.zeros(2, map.context_dim, dtype=dtype)
    shapes = {"action": {0: batch}, "context": {0: batch}}
    program = torch.export.export(interface, example, dynamic_shapes=shapes)
    for node in program.graph.nodes:  # where each step stands in the source, on the machine that exports
        node.meta.pop("stack_trace", None)
    return program


def _write_onnx(program: ExportedProgram, path: Path, description: str) -> None:
    solve = torch.ops.aten.linalg_solve_ex.default
    if any(node.target is solve for node in program.graph.nodes):
        program = program.run_decompositions({solve: _solve})
    model = torch.onnx.export(
        program,
        input_names=["action", "context"],
        output_names=["actuation"],
        dynamic_shapes=({0: "batch"}, {}),  # the other input shares it
        verbose=False,
    )
    assert model is not None
    model.model.metadata_props["map"] = description
    model.save(path)


def _solve(matrix: Tensor, right: Tensor, *, left: bool = True) -> tuple[Tensor, Tensor]:
    """Gauss-Jordan elimination with pivots, in place of torch.linalg.solve_ex: ONNX has no operator for it.

    Rows are not swapped, as indices would be needed for this; which row was the pivot of which column is remembered.
    """
    if not left or right.ndim != matrix.ndim:
        raise NotImplementedError(
            "to ONNX, only AX = B with matrices X and B is exported, not XA = B or vectors."
        )
    size = matrix.shape[-1]
    rows = torch.cat([matrix, right], dim=-1)
    unused = torch.ones_like(matrix[..., 0])
    pivots = []
    for column in range(size):
        values = rows[..., column]
        best = (values.abs() * unused).argmax(-1, keepdim=True)
        pivot = (torch.arange(size, device=best.device) == best).to(
            rows.dtype
        )  # (*batch, size), one of them 1
        row = (pivot.unsqueeze(-1) * rows).sum(-2, keepdim=True)
        row = row / row[..., column : column + 1]
        rows = rows + (pivot - values).unsqueeze(-1) * row  # the pivot's row becomes ``row``, others get a 0
        unused = unused - pivot
        pivots.append(pivot)
    solution = torch.stack(pivots, dim=-2) @ rows[..., size:]
    return solution, torch.zeros_like(matrix[..., 0, 0], dtype=torch.int32)
