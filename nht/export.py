"""A map as a program in a file, for a control loop in C++, ROS or Python that knows nothing of this package."""

import copy
import importlib.util
import json
import math
from pathlib import Path

import torch
from torch import Tensor, nn
from torch._inductor import aoti_compile_and_package
from torch.export import Dim, ExportedProgram

from nht.maps import ActionMap
from nht.storage import describe, replacing

SUFFIXES = (".pt2", ".onnx")


def export_map(
    map: ActionMap, path: str | Path, *, action_scale: float | None = None, compiled: bool = False
) -> Path:
    """Writes what a policy's action in [-1, 1]^k does: actuation = map(action_scale * action, context).

    That is what ActionMapTransform computes, but for the last step: clipping to the limits of the robot is left to
    whoever knows them. Inputs, in this order: "action" (batch, k) and "context" (batch, context_dim, which may be
    0); output: "actuation" (batch, n). All are in the map's precision, and for any batch.

    - `name.onnx`: for ONNX Runtime and other engines.
    - `name.pt2`: for `torch.export.load`.
    - `name.pt2`, compiled: machine code for the kind of processor and the PyTorch version that exported it, for
      `torch::inductor::AOTIModelPackageLoader` in C++ and `torch._inductor.aoti_load_package`. Inputs of a wrong
      width are noticed only if the environment has AOTI_RUNTIME_CHECK_INPUTS=1. Takes a C++ compiler and a minute.

    In each, "map" holds the description that a map file has (context keys in order, widths, demonstrated bounds ...)
    as JSON: in the metadata of the ONNX model, the extra files of the exported program, the metadata of the compiled
    package. "action_scale" in it is the one that is applied here; do not scale again.

    A reader of `path` sees the old file or the whole new one, never a part. The map itself stays as it is.

    Args:
        map: any action map.
        path: its suffix, .onnx or .pt2, decides the format.
        action_scale: what 1 stands for, in the map's own units. Defaults to the map's, as in ActionMapTransform.
        compiled: compile for C++; .pt2 only.

    Returns:
        The path.

    Raises:
        TypeError: if `map` is no ActionMap.
        ValueError: on another suffix, on `compiled` for ONNX, or an `action_scale` that is not positive and finite.
        ImportError: if what the extra `nht[onnx]` installs is missing.
    """
    path = Path(path)
    if not isinstance(map, ActionMap):
        raise TypeError(f"map must be an nht.ActionMap, got {type(map).__name__}")
    _check_format(path, compiled)
    scale = float(map.action_scale) if action_scale is None else action_scale
    if not 0 < scale < math.inf:
        raise ValueError(f"action_scale must be a positive, finite number, got {scale}")
    description = json.dumps(describe(map) | {"action_scale": scale})
    program = _traced(map, scale)
    with replacing(path) as scratch:
        if path.suffix == ".onnx":
            _write_onnx(program, scratch, description)
        elif compiled:
            options = {"aot_inductor.metadata": {"map": description}}
            aoti_compile_and_package(program, package_path=str(scratch), inductor_configs=options)
        else:
            torch.export.save(program, scratch, extra_files={"map": description})
    return path


class _Interface(nn.Module):
    """The function that is exported."""

    action_scale: Tensor

    def __init__(self, map: ActionMap, action_scale: float) -> None:
        super().__init__()
        self.map = copy.deepcopy(map).cpu().requires_grad_(False)
        self.register_buffer("action_scale", torch.full_like(self.map.action_scale, action_scale))
        self.eval()

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return self.map(self.action_scale * action, context)


def _check_format(path: Path, compiled: bool) -> None:
    if path.suffix not in SUFFIXES:
        raise ValueError(f"the suffix must be one of {', '.join(SUFFIXES)}, got {path.name!r}")
    if path.suffix != ".onnx":
        return
    if compiled:
        raise ValueError(f"compiled is for .pt2 only, got {path.name!r}")
    if missing := [name for name in ("onnx", "onnxscript") if importlib.util.find_spec(name) is None]:
        raise ImportError(f"ONNX needs {' and '.join(missing)}: pip install 'nht[onnx]'")


def _traced(map: ActionMap, action_scale: float) -> ExportedProgram:
    batch = Dim("batch")
    dtype = map.action_scale.dtype
    example = torch.zeros(2, map.action_dim, dtype=dtype), torch.zeros(2, map.context_dim, dtype=dtype)
    shapes = {"action": {0: batch}, "context": {0: batch}}
    program = torch.export.export(_Interface(map, action_scale), example, dynamic_shapes=shapes)
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
            "to ONNX, only AX = B with matrices X and B is exported, not XA = B or vectors"
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
        rows = rows + (pivot - values).unsqueeze(-1) * row  # the pivot's row becomes `row`, others get a 0
        unused = unused - pivot
        pivots.append(pivot)
    solution = torch.stack(pivots, dim=-2) @ rows[..., size:]
    return solution, torch.zeros_like(matrix[..., 0, 0], dtype=torch.int32)
