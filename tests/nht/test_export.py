"""An exported map says what the map says, in a file that needs nothing of ours."""

import importlib.util
import json
import math
import runpy
import subprocess
import sys
from collections.abc import Callable
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import onnxruntime
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor

import nht
from nht.description import describe
from nht.export import _solve
from nht.maps import ActionMap
from nht.recipes import export_map as recipe
from nht.recipes.config import ExportMap
from nht.recipes.launch import configure
from nht.transforms import ActionMapTransform

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
FORMATS = ("pt2", "onnx")
# A seven-joint arm of no particular make: lengths [m], twists [rad], offsets [m].
ARM = (
    (0.0, 0.0, 0.05, -0.05, 0.0, 0.0, 0.0),
    (-math.pi / 2, math.pi / 2, -math.pi / 2, math.pi / 2, -math.pi / 2, math.pi / 2, 0.0),
    (0.3, 0.0, 0.5, 0.0, 0.3, 0.0, 0.1),
)

MAPS: dict[str, Callable[[], ActionMap]] = {
    "nht": lambda: nht.NHT(10, 7, 2, normalise=True),
    "scl": lambda: nht.SCL(10, 7, 2, (16,), "sigmoid"),
    "svd": lambda: nht.SVD(7, 2, 10),
    "svd without context": lambda: nht.SVD(7, 2),
    "identity": lambda: nht.Identity(7),
    "laser": lambda: nht.LASER(10, 7, 2, (16,), "relu"),
    "cae": lambda: nht.CAE(10, 7, 2, (16,)),
    "residual": lambda: nht.Residual(nht.NHT(10, 7, 2, (16,)), 0.1),
    "jacobian": lambda: nht.JacobianPinv(
        *ARM
    ).double(),  # J J^T is too ill conditioned for 1e-6 in single precision
    "double": lambda: nht.NHT(10, 7, 3, (16,)).double(),
    "own": lambda: Own(),
    "affine": lambda: nht.NHT(10, 7, 2, (16,), offset="contextual"),
}
SLOW = {
    ("svd", "onnx"),
    ("identity", "onnx"),
    ("cae", "onnx"),
    ("jacobian", "onnx"),
}  # all of them take seconds


class Own(ActionMap):
    """A class of a user's own, whose output depends on neither weights nor the context."""

    def __init__(self) -> None:
        super().__init__(3, 2, 2)

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return action.flip(-1)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        return actuation.flip(-1)


def some(map: ActionMap, batch: int) -> tuple[Tensor, Tensor]:
    dtype = map.action_scale.dtype
    return 2 * torch.rand(batch, map.action_dim, dtype=dtype) - 1, torch.randn(
        batch, map.context_dim, dtype=dtype
    )


def load(path: Path) -> Callable[[Tensor, Tensor], Tensor]:
    if path.suffix == ".pt2":
        return torch.export.load(path).module()
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])

    def run(action: Tensor, context: Tensor) -> Tensor:
        return torch.from_numpy(session.run(None, {"action": action.numpy(), "context": context.numpy()})[0])

    return run


@pytest.mark.parametrize(
    ("name", "suffix"),
    [
        pytest.param(name, suffix, marks=[pytest.mark.slow] if (name, suffix) in SLOW else [])
        for name in MAPS
        for suffix in FORMATS
    ],
)
def test_the_file_agrees_with_the_map_for_any_batch(name: str, suffix: str, tmp_path: Path) -> None:
    map = MAPS[name]()
    exported = load(nht.export_map(map, tmp_path / f"map.{suffix}"))
    for batch in (1, 2, 33):
        action, context = some(map, batch)
        actuation, expected = exported(action, context), map(action, context)
        assert actuation.dtype == expected.dtype
        torch.testing.assert_close(actuation, expected.detach(), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("suffix", "action_scale"), [("pt2", None), ("pt2", 0.25), ("onnx", 0.25)])
def test_the_file_does_what_the_transform_does(
    suffix: str, action_scale: float | None, tmp_path: Path
) -> None:
    map = nht.NHT(3, 4, 2, (16,))
    map.action_scale.fill_(3.0)
    exported = load(nht.export_map(map, tmp_path / f"map.{suffix}", action_scale=action_scale))
    action, context = some(map, 5)
    data = TensorDict({"action": action, "context": context}, [5])
    expected = ActionMapTransform(map, ["joint_angle"], action_scale=action_scale).inv(data)["action"]
    torch.testing.assert_close(exported(action, context), expected, rtol=1e-6, atol=1e-6)
    assert not torch.allclose(expected, map(action, context), atol=0.1)


LIMITS = {"low": [-0.3, -math.inf, -0.2, -1.0, -0.5, -0.5, -0.5], "high": 0.4}


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("saturation", ["scale", "clip"])
@pytest.mark.parametrize("offset", ["none", "constant"])
@torch.no_grad()
def test_the_file_saturates_at_the_limits_that_it_was_given(
    suffix: str, saturation: Any, offset: Any, tmp_path: Path
) -> None:
    map = nht.NHT(3, 7, 2, (8,), offset=offset)
    map.saturation = saturation
    map.set_action_scale(2.0)
    if map.offset_model is not None:
        map.offset_model.value.fill_(0.1)
    path = nht.export_map(map, tmp_path / f"map.{suffix}", **LIMITS)
    action, context = some(map, 64)
    low, high = torch.tensor(LIMITS["low"]), torch.tensor(LIMITS["high"]).expand(7)
    actuation = load(path)(action, context)
    torch.testing.assert_close(actuation, map.decode(action, context, low, high), rtol=1e-6, atol=1e-6)
    assert not torch.allclose(actuation, map.decode(action, context), atol=0.1)
    diverged = load(path)(action.index_fill(0, torch.tensor(3), math.nan), context)
    assert diverged[3].isnan().any()
    assert diverged[4:].isfinite().all()
    description = described(path)
    assert description["saturation"] == saturation
    assert description["high"] == pytest.approx([0.4] * 7)
    assert description["low"][:2] == [pytest.approx(-0.3), None]


def described(path: Path) -> dict[str, Any]:
    if path.suffix == ".onnx":
        session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
        return json.loads(session.get_modelmeta().custom_metadata_map["map"])
    files = {"map": ""}
    torch.export.load(path, extra_files=files)
    return json.loads(files["map"])


def test_a_process_that_knows_nothing_of_ours_runs_both_formats(tmp_path: Path) -> None:
    map = nht.NHT(10, 7, 2, (16,))
    action, context = some(map, 1)
    for suffix in FORMATS:
        nht.export_map(map, tmp_path / f"map.{suffix}")
    torch.save(
        {"action": action, "context": context, "actuation": map(action, context).detach()}, tmp_path / "data"
    )
    installed = [str(Path(module.__path__[0]).parent) for module in (torch, onnxruntime)]
    code = f"""
import sys
sys.path += {installed}
import onnxruntime, torch
data = torch.load("data")
inputs = {{name: data[name] for name in ("action", "context")}}
program = torch.export.load("map.pt2").module()(*inputs.values())
session = onnxruntime.InferenceSession("map.onnx")
(engine,) = session.run(["actuation"], {{name: value.numpy() for name, value in inputs.items()}})
for actuation in (program, torch.from_numpy(engine)):
    torch.testing.assert_close(actuation, data["actuation"], rtol=1e-6, atol=1e-6)
assert not [name for name in sys.modules if name.split(".")[0] in ("nht", "tensordict", "torchrl")]
"""
    # -I drops the working directory from the path, -S the editable install.
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code], cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


def test_the_file_explains_itself(tmp_path: Path) -> None:
    map = nht.NHT(10, 7, 2, (16,))
    map.context_keys = ("tool_position", ("arm", "joint_angle"))
    map.actuation_low.fill_(-1.5)
    map.action_scale.fill_(3.0)
    expected = json.loads(json.dumps(describe(map) | {"action_scale": 0.5}))
    assert expected["context_keys"] == ["tool_position", ["arm", "joint_angle"]]
    program, model = (nht.export_map(map, tmp_path / f"map.{suffix}", action_scale=0.5) for suffix in FORMATS)
    files = {"map": ""}
    torch.export.load(program, extra_files=files)
    assert json.loads(files["map"]) == expected
    session = onnxruntime.InferenceSession(model)
    assert json.loads(session.get_modelmeta().custom_metadata_map["map"]) == expected
    sizes = {entry.name: entry.shape for entry in [*session.get_inputs(), *session.get_outputs()]}
    assert sizes == {"action": ["batch", 2], "context": ["batch", 10], "actuation": ["batch", 7]}
    for file in (program, model):
        assert str(Path.cwd()).encode() not in file.read_bytes()  # nothing of the machine that exported


def test_the_map_stays_as_it_is(tmp_path: Path) -> None:
    map = nht.NHT(3, 4, 2, (16,))
    before = {name: value.clone() for name, value in map.state_dict().items()}
    nht.export_map(map, tmp_path / "map.pt2", action_scale=2.0)
    assert map.training
    assert all(weight.requires_grad for weight in map.parameters())
    for name, value in map.state_dict().items():
        assert torch.equal(value, before[name])


def test_exporting_replaces_a_file_whole_or_not_at_all(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = nht.export_map(nht.SVD(7, 2), tmp_path / "new folder" / "map.pt2")
    nht.export_map(nht.SVD(5, 2), path)
    ones = torch.ones(1, 2), torch.ones(1, 0)
    assert load(path)(*ones).shape == (1, 5)

    def fail(_: Any, path: Path, **__: Any) -> None:
        path.write_bytes(b"half")
        raise OSError("disk full")

    monkeypatch.setattr("torch.export.save", fail)
    with pytest.raises(OSError, match="disk full"):
        nht.export_map(nht.SVD(3, 2), path)
    assert load(path)(*ones).shape == (1, 5)
    assert [file.name for file in path.parent.iterdir()] == ["map.pt2"]


def test_elimination_solves_what_torch_solves() -> None:
    matrix = torch.randn(100, 6, 6, dtype=torch.float64)
    matrix[0] = torch.eye(6).roll(1, 0)  # zeros on the diagonal: without pivots it would divide by them
    right = torch.randn(100, 6, 3, dtype=torch.float64)
    solution, info = _solve(matrix, right)
    torch.testing.assert_close(solution, torch.linalg.solve(matrix, right), rtol=1e-9, atol=1e-9)
    assert not info.any()


def test_equations_of_other_shapes_are_refused() -> None:
    with pytest.raises(NotImplementedError, match="only AX = B"):
        _solve(torch.eye(2), torch.ones(2))
    with pytest.raises(NotImplementedError, match="only AX = B"):
        _solve(torch.eye(2), torch.eye(2), left=False)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("map.pth", {}, r"must be one of \.pt2, \.onnx, got 'map\.pth'"),
        ("map", {}, r"must be one of \.pt2, \.onnx, got 'map'"),
        ("map.onnx", {"compiled": True}, r"compiled is for \.pt2 only, got 'map\.onnx'"),
        ("map.pt2", {"action_scale": 0.0}, "action_scale must be a positive, finite number, got 0.0"),
        ("map.pt2", {"action_scale": math.inf}, "action_scale must be a positive, finite number, got inf"),
        ("map.pt2", {"action_scale": math.nan}, "action_scale must be a positive, finite number, got nan"),
        ("map.pt2", {"low": [0.0] * 6}, "low must be one number or 7, got"),
        ("map.pt2", {"high": math.nan}, "high must be one number or 7, got nan"),
        ("map.pt2", {"low": 1.0, "high": [0.0] * 7}, "low must not exceed high"),
    ],
)
def test_bad_arguments_are_refused(name: str, options: dict[str, Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        nht.export_map(nht.SVD(7, 2), tmp_path / name, **options)
    assert list(tmp_path.iterdir()) == []


def test_what_is_no_map_is_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"must be an nht\.ActionMap, got Linear"):
        nht.export_map(torch.nn.Linear(2, 7), tmp_path / "map.pt2")


def test_a_missing_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def find(
        name: str, find: Callable[[str], ModuleSpec | None] = importlib.util.find_spec
    ) -> ModuleSpec | None:
        return None if name == "onnxscript" else find(name)

    monkeypatch.setattr("importlib.util.find_spec", find)
    with pytest.raises(ImportError, match=r"ONNX needs onnxscript: pip install 'nht\[onnx\]'"):
        nht.export_map(nht.SVD(7, 2), tmp_path / "map.onnx")


def test_the_recipe_exports_with_the_scale_of_the_map(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    map = nht.NHT(3, 4, 2, (16,))
    map.context_keys = ("joint_angle",)
    map.action_scale.fill_(3.0)
    saved, out = nht.save_map(map, tmp_path / "map.safetensors"), tmp_path / "map.pt2"
    recipe.main(configure(ExportMap, "export_map", [f"file={saved}", f"out={out}"]))
    assert "action (batch, 2), context (batch, 3): ['joint_angle']" in capsys.readouterr().out
    action, context = some(map, 3)
    torch.testing.assert_close(load(out)(action, context), map(3.0 * action, context).detach())


@pytest.mark.slow
def test_the_compiled_package_runs_in_python_and_cpp(tmp_path: Path) -> None:
    map = nht.NHT(10, 7, 2)
    path = nht.export_map(map, tmp_path / "map.pt2", compiled=True)
    package = torch._inductor.aoti_load_package(str(path))
    assert json.loads(package.get_metadata()["map"])["action_dim"] == 2
    for batch in (1, 33):
        action, context = some(map, batch)
        expected = map(action, context).detach()
        torch.testing.assert_close(package(action, context), expected, rtol=1e-6, atol=1e-6)
    benchmark = runpy.run_path(str(BENCHMARKS / "speed" / "export_latency.py"))
    actuation, times = benchmark["run_loop"](benchmark["build_loop"](tmp_path), path, map, 10)
    expected = map(torch.ones(1, 2), torch.ones(1, 10)).detach()
    torch.testing.assert_close(actuation, expected, rtol=1e-6, atol=1e-6)
    assert len(times) == 10
