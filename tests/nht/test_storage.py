"""A map file gives back the very same map, or says what is wrong with it."""

import json
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

import nht
from nht.maps import ActionMap
from nht.storage import _checksum, load_map, save_map
from nht.writing import replacing

KEYS = ("tool_position", ("arm", "joint_angle"))


class ScaledIdentity(ActionMap):
    """A class of a user's own."""

    def __init__(self, actuation_dim: int, scale: float) -> None:
        super().__init__(0, actuation_dim, actuation_dim)
        self.scale = scale

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return self.scale * action

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        return actuation / self.scale


def trained(map: ActionMap) -> ActionMap:
    """As training would leave it: buffers, keys and fingerprint set."""
    generator = torch.Generator().manual_seed(0)
    for value in map.state_dict().values():
        value.copy_(torch.rand(value.shape, generator=generator))
    map.saturation = "scale"
    map.context_keys = KEYS
    map.data_fingerprint = "abc"
    return map


MAPS: dict[str, Callable[[], ActionMap]] = {
    "nht": lambda: nht.NHT(10, 7, 2, (16, 8), "sigmoid", normalise=True, lipschitz=4.0, seed=3),
    "double": lambda: nht.NHT(10, 7, 3, hidden=()).double(),
    "nht with heads": lambda: nht.NHT(10, 7, 3, (16, 8), multi_head=True),
    "scl": lambda: nht.SCL(10, 7, 2, (16, 8), "relu", lipschitz=4.0),
    "svd": lambda: nht.SVD(7, 2, 10),
    "identity": lambda: nht.Identity(7),
    "own": lambda: ScaledIdentity(7, 0.5),
}


@pytest.mark.parametrize("make", MAPS.values(), ids=MAPS)
def test_maps_come_back_bit_for_bit(make: Callable[[], ActionMap], tmp_path: Path) -> None:
    map = trained(make())
    loaded = load_map(save_map(map, tmp_path / "map.safetensors"))
    assert type(loaded) is type(map)
    assert loaded.init_args() == map.init_args()
    assert loaded.context_keys == KEYS
    assert loaded.data_fingerprint == "abc"
    assert loaded.saturation == "scale"
    weights, expected = loaded.state_dict(), map.state_dict()
    assert weights.keys() == expected.keys()
    for name, value in expected.items():
        assert weights[name].dtype == value.dtype
        assert torch.equal(weights[name], value)
    assert not loaded.training
    assert not any(weight.requires_grad for weight in loaded.parameters())
    action, context = (
        torch.ones(3, map.action_dim).to(map.action_scale),
        torch.ones(3, map.context_dim).to(map.action_scale),
    )
    assert torch.equal(loaded(action, context), map(action, context))


def test_an_untrained_map_keeps_its_unknowns(tmp_path: Path) -> None:
    loaded = load_map(save_map(nht.SVD(7, 2), tmp_path / "map.safetensors"))
    assert loaded.context_keys is None
    assert loaded.data_fingerprint is None
    assert loaded.actuation_high.isinf().all()


def test_the_header_explains_the_file_without_this_package(tmp_path: Path) -> None:
    map = trained(nht.NHT(10, 7, 2, (16, 8)))
    with safe_open(save_map(map, tmp_path / "map.safetensors"), "pt") as file:
        metadata = file.metadata()
    assert metadata["format"] == "nht.action_map"
    assert metadata["format_version"] == "2"
    header = json.loads(metadata["map"])
    assert (header["module"], header["class"]) == ("nht", "NHT")
    assert header["saturation"] == map.saturation
    assert header["init_args"]["hidden"] == [16, 8]
    assert header["context_keys"] == ["tool_position", ["arm", "joint_angle"]]
    assert (header["context_dim"], header["actuation_dim"], header["action_dim"]) == (10, 7, 2)
    assert header["action_scale"] == float(map.action_scale)
    assert header["actuation_low"] == map.actuation_low.tolist()
    assert header["lipschitz_certificate"] == nht.certificate(map)
    assert header["data_fingerprint"] == "abc"
    assert header["nht_version"]


def test_the_header_is_strict_json_where_numbers_are_infinite(tmp_path: Path) -> None:
    with safe_open(save_map(ScaledIdentity(2, 0.5), tmp_path / "map.safetensors"), "pt") as file:
        text = file.metadata()["map"]
    assert "Infinity" not in text
    assert json.loads(text)["lipschitz_certificate"] is None


def test_saving_replaces_a_file_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = save_map(nht.SVD(7, 2), tmp_path / "new folder" / "map.safetensors")
    save_map(nht.SVD(5, 2), path)
    assert load_map(path).actuation_dim == 5

    write = Path.write_bytes

    def fail(file: Path, content: bytes) -> None:
        write(file, content[: len(content) // 2])
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(OSError, match="disk full"):
        save_map(nht.SVD(3, 2), path)
    assert load_map(path).actuation_dim == 5
    assert [file.name for file in path.parent.iterdir()] == ["map.safetensors"]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return save_map(trained(nht.NHT(10, 7, 2, (16,))), tmp_path / "map.safetensors")


def rewrite(
    path: Path,
    *,
    header: dict[str, str] | None = None,
    description: dict[str, Any] | None = None,
    **tensors: Any,
) -> None:
    """Changes parts of a map file, its checksum with them; a tensor of None is left out."""
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    metadata["map"] = json.dumps(json.loads(metadata["map"]) | (description or {}))
    metadata |= header or {}
    weights = load_file(path) | {name.replace("__", "."): value for name, value in tensors.items()}
    weights = {name: value for name, value in weights.items() if value is not None}
    save_file(weights, path, metadata | {"checksum": _checksum(metadata["map"], weights)})


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"there is no map file .*nothing"):
        load_map(tmp_path / "nothing")


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.99])
def test_truncated_files_are_refused(path: Path, share: float) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ValueError, match="is no safetensors file, or is cut short"):
        load_map(path)


def test_pickles_and_other_files_are_refused_unopened(path: Path, tmp_path: Path) -> None:
    class Bomb:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "exploded",))

    torch.save({"weights": torch.ones(3)}, path)
    with pytest.raises(ValueError, match="is no safetensors file"):
        load_map(path)
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(ValueError, match="is no safetensors file"):
        load_map(path)
    assert not (tmp_path / "exploded").exists()


def test_safetensors_files_of_others_are_refused(path: Path) -> None:
    save_file({"weight": torch.ones(3)}, path)
    with pytest.raises(ValueError, match=r"holds no action map: its header is not marked 'nht.action_map'"):
        load_map(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"header": {"format_version": "3"}}, "format version 3, this version of nht reads 1 and 2"),
        ({"header": {"map": "{"}}, "its description is damaged"),
        ({"header": {"map": "{}"}}, "its description is damaged: KeyError: 'module'"),
        (
            {"description": {"class": "Unheard"}},
            "unknown class 'Unheard'; those of nht are .*Identity.*NHT.*SVD",
        ),
        (
            {
                "description": {
                    "class": "SCL",
                    "init_args": {"context_dim": 10, "actuation_dim": 7, "action_dim": 2, "hidden": [16]},
                }
            },
            r"do not fit SCL: network.layers.1.weight is .* \(12, 16\), .* \(14, 16\)",
        ),
        (
            {"description": {"class": "SVD", "init_args": {"actuation_dim": 7, "action_dim": 2}}},
            r"do not fit SVD: missing \['frame'\], unexpected \['network",
        ),
        (
            {
                "description": {
                    "class": "Residual",
                    "init_args": {"map": {"class": "Path", "module": "nht"}, "scale": 1},
                }
            },
            "unknown class 'Path'",
        ),
        (
            {"description": {"class": "Residual", "init_args": {"map": 3, "scale": 1}}},
            "must be an action map",
        ),
        ({"description": {"init_args": 3}}, "its description is damaged"),
        ({"description": {"class": "LinearActionMap"}}, "unknown class 'LinearActionMap'"),
        ({"description": {"init_args": {"width": 3}}}, "arguments that NHT does not take: .*'width'"),
        (
            {"network__layers__0__weight": None},
            r"do not fit NHT: missing \['network.layers.0.weight'\], unexpected \[\]",
        ),
        ({"extra": torch.ones(2)}, r"missing \[\], unexpected \['extra'\]"),
        (
            {"network__layers__0__bias": torch.ones(17)},
            r"layers.0.bias is torch.float32 \(17,\), expected .* \(16,\)",
        ),
        (
            {"network__layers__0__bias": torch.ones(16).half()},
            "layers.0.bias is torch.float16 .* expected torch.float32",
        ),
    ],
)
def test_files_that_do_not_fit_are_refused(path: Path, change: dict[str, Any], message: str) -> None:
    rewrite(path, **change)
    with pytest.raises(ValueError, match=message):
        load_map(path)


KILLED = """
import os, signal, sys
from pathlib import Path
from nht.writing import replacing
with replacing(Path(sys.argv[1])) as scratch:
    scratch.write_text("half of")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def test_what_a_killed_writer_left_goes_when_the_file_is_written_again(tmp_path: Path) -> None:
    file, other = tmp_path / "config.yaml", tmp_path / "other.yaml"
    file.write_text("old")
    process = subprocess.run([sys.executable, "-c", KILLED, file], timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 2
    assert file.read_text() == "old"
    with replacing(other) as scratch, replacing(file) as scratch_too:  # of a living one, nothing is taken
        scratch.write_text("new")
        scratch_too.write_text("new")
    assert sorted(tmp_path.iterdir()) == [file, other]
    assert file.read_text() == "new"
