"""Old, foreign, changed and hostile map files: each is loaded as it was meant, or refused by one sentence."""

import json
import math
import os
import random
import subprocess
import sys
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

import nht
from nht.demos import Demos
from nht.maps import ActionMap
from nht.storable import check_storable
from nht.storage import load_map, save_map

FILES = Path(__file__).parent / "files"
PACKAGE = """
import nht, torch

class Twofold(nht.ActionMap):
    def __init__(self, actuation_dim, factor):
        super().__init__(0, actuation_dim, actuation_dim)
        self.factor = factor

    def forward(self, action, context):
        return self.factor * action

    def project(self, actuation, context):
        return actuation / self.factor
"""


class SVD(nht.ActionMap):
    """Someone's own, of the name, arguments and buffers of ours."""

    def __init__(
        self, actuation_dim: int, action_dim: int, context_dim: int = 0, offset: str = "none"
    ) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        self.offset = offset
        self.register_buffer("frame", torch.eye(actuation_dim, action_dim))

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return -(action @ self.frame.mT)

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        return -(actuation @ self.frame)


def make_twin(name: str) -> type[ActionMap]:
    """A class of this name, as a second module would have it."""
    return type(name, (SVD,), {"__qualname__": name, "__module__": "someone.elses"})


# Format version 1.


@pytest.mark.parametrize(("file", "columns"), [("map", 2), ("nested", 6)])
def test_files_of_version_1_mean_what_they_meant(file: str, columns: int) -> None:
    path = FILES / ("map_version_1.safetensors" if file == "map" else "nested_map_version_1.safetensors")
    expected = json.loads((FILES / "maps_version_1.json").read_text())
    map = load_map(path)
    action, context = torch.tensor(expected["action"])[:, :columns], torch.tensor(expected["context"])
    torch.testing.assert_close(map(action, context), torch.tensor(expected[file]), rtol=1e-6, atol=1e-7)
    assert map.saturation == "clip"
    low, high = torch.full((4,), -0.1), torch.full((4,), 0.2)
    assert torch.equal(
        map.decode(action, context, low, high), map(map.action_scale * action, context).clamp(low, high)
    )
    for name, value in load_file(path).items():
        assert torch.equal(map.state_dict()[name], value)


def test_a_file_of_version_1_keeps_what_training_left() -> None:
    map = load_map(FILES / "map_version_1.safetensors")
    assert isinstance(map, nht.NHT)
    assert (map.multi_head, map.activation, map.lipschitz, map.start, map.offset) == (
        True,
        "sigmoid",
        4.0,
        "random",
        "none",
    )
    assert map.context_keys == ("context",)
    assert map.data_fingerprint
    assert torch.equal(map(torch.zeros(1, 2), torch.zeros(1, 3)), torch.zeros(1, 4))


def as_version_1(path: Path, **description: Any) -> Path:
    """The file as the format before would have had it."""
    with safe_open(path, "pt") as file:
        header = json.loads(file.metadata()["map"]) | description
    header = {key: value for key, value in header.items() if key not in ("module", "saturation")}
    metadata = {"format": "nht.action_map", "format_version": "1", "map": json.dumps(header)}
    save_file(load_file(path), path, metadata)
    return path


def test_names_alone_mean_our_classes_or_the_only_one(tmp_path: Path) -> None:
    path = as_version_1(save_map(nht.SVD(4, 2), tmp_path / "map.safetensors"))
    assert type(load_map(path)) is nht.SVD
    kinds = [make_twin("OnlyHere")]
    as_version_1(save_map(kinds[0](4, 2), path))
    assert type(load_map(path)) is kinds[0]
    kinds.append(make_twin("OnlyHere"))
    with pytest.raises(ValueError, match="2 classes are called 'OnlyHere'"):
        load_map(path)


# Whose class it is.


def test_classes_of_one_name_are_told_apart(tmp_path: Path) -> None:
    ours, theirs = nht.SVD(4, 2), SVD(4, 2)
    for map in (ours, theirs):
        loaded = load_map(save_map(map, tmp_path / "map.safetensors"))
        assert type(loaded) is type(map)
        assert torch.equal(loaded(torch.ones(2), torch.ones(0)), map(torch.ones(2), torch.ones(0)))


def test_a_module_is_imported_only_if_that_is_allowed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "someones_package"
    package.mkdir()
    (package / "__init__.py").touch()
    (package / "maps.py").write_text(PACKAGE)
    monkeypatch.syspath_prepend(str(tmp_path))
    code = "import nht, someones_package.maps as m; nht.save_map(m.Twofold(3, 2.5), 'map.safetensors')"
    environment = os.environ | {"PYTHONPATH": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True)
    path = tmp_path / "map.safetensors"
    for allow in ((), ("someones",), ("someones_package.other",), ("nht",)):
        with pytest.raises(
            ValueError, match=r"'Twofold' is in the module 'someones_package.maps', which is not imp"
        ):
            load_map(path, allow=allow)
    assert "someones_package" not in sys.modules
    map = load_map(path, allow=("someones_package",))
    assert type(map) is sys.modules["someones_package.maps"].Twofold  # type: ignore[attr-defined]
    assert map(torch.ones(3), torch.ones(0)).tolist() == [2.5, 2.5, 2.5]
    assert type(load_map(path)) is type(map)  # it is imported now


def test_modules_that_cannot_help_are_named(tmp_path: Path) -> None:
    module = types.ModuleType("passing_module")
    sys.modules["passing_module"] = module
    exec(PACKAGE, module.__dict__)
    path = save_map(module.Twofold(3, 2.0), tmp_path / "map.safetensors")
    try:
        assert type(load_map(path)) is module.Twofold
        exec(PACKAGE, module.__dict__)  # as a notebook does: the class that stands there now is meant
        assert type(load_map(path)) is module.Twofold
    finally:
        del sys.modules["passing_module"]
    relabel(path, module="module_that_never_was", **{"class": "Twofold"})
    with pytest.raises(
        ValueError, match="needs the module 'module_that_never_was': ModuleNotFoundError: No module"
    ):
        load_map(path, allow=("module_that_never_was",))
    relabel(path, module="pathlib", **{"class": "Path"})
    with pytest.raises(ValueError, match="the module 'pathlib' is imported, but has no action map 'Path'"):
        load_map(path)


def relabel(path: Path, **changes: Any) -> None:
    """Changes entries of the description, and the checksum with them."""
    from nht.storage import _checksum

    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    metadata["map"] = json.dumps(json.loads(metadata["map"]) | changes)
    weights = load_file(path)
    save_file(weights, path, metadata | {"checksum": _checksum(metadata["map"], weights)})


# What trains also saves.


class Warm(nht.NHT):
    """Passes on what it does not know."""

    def __init__(self, *args: Any, temperature: float = 1.0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.temperature = temperature


class Tied(nht.ActionMap):
    """Two names for one weight, one of them that of a method."""

    def __init__(self, context_dim: int, actuation_dim: int, action_dim: int, /) -> None:
        super().__init__(context_dim, actuation_dim, action_dim)
        self.encode = nn.Linear(actuation_dim, action_dim, bias=False)  # type: ignore[assignment]
        self.again = nn.Linear(actuation_dim, action_dim, bias=False)
        self.again.weight = self.encode.weight

    def forward(self, action: Tensor, context: Tensor) -> Tensor:
        return action @ self.again.weight

    def project(self, actuation: Tensor, context: Tensor) -> Tensor:
        return self.again(actuation)


class Settings(nht.Identity):
    """Keeps none of its arguments; one buffer is of a precision of its own."""

    def __init__(self, size: Any, *, options: Any = None, largest: float = math.inf) -> None:
        super().__init__(size)
        self.register_buffer("table", torch.arange(3, dtype=torch.float64))
        self.register_buffer(
            "limits", torch.tensor([-math.inf, math.inf])
        )  # an infinity that means something


class Keeps(nht.Identity):
    """Keeps an argument under its name, but another value."""

    def __init__(self, actuation_dim: int, gain: float) -> None:
        super().__init__(actuation_dim)
        self.gain = 2 * gain


class Takes(nht.Identity):
    """Takes what no file can hold."""

    def __init__(self, actuation_dim: int, function: Any) -> None:
        super().__init__(actuation_dim)


@pytest.fixture(scope="module")
def demos() -> Demos:
    generator = torch.Generator().manual_seed(0)
    data = {
        key: torch.randn(100, width, generator=generator) for key, width in (("context", 3), ("actuation", 4))
    }
    return Demos.from_tensors(**data, episode=torch.arange(100) // 10)


@pytest.mark.parametrize(
    "map",
    [
        Warm(3, 4, 2, hidden=(4,), temperature=0.5),
        Warm(3, 4, action_dim=2, hidden=[4]),
        nht.NHT(3, 4, np.arange(1, 4)[1], hidden=(np.int64(4),)),
        Tied(3, 4, 2),
        Settings(np.int64(4), options={"class": {"deep": [1, None, (2.5, math.nan)]}}, largest=math.inf),
    ],
    ids=["kwargs", "partly by name", "numpy", "tied and positional", "forgotten"],
)
def test_what_trains_also_saves_and_loads(map: ActionMap, demos: Demos, tmp_path: Path) -> None:
    keys = ["context"] if map.context_dim else []
    trained = nht.train_map(demos, map, context_keys=keys, max_steps=3).map
    loaded = load_map(save_map(trained, tmp_path / "map.safetensors"))
    assert type(loaded) is type(map)
    action, context = torch.ones(5, map.action_dim), torch.ones(5, map.context_dim)
    assert torch.equal(loaded(action, context), trained(action, context))
    for name, value in trained.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value)
        assert loaded.state_dict()[name].dtype == value.dtype


def test_arguments_come_back_as_they_were(tmp_path: Path) -> None:
    options = {"class": {"deep": [1, None, -math.inf]}, "number": "inf"}
    map = Settings(4, options=options)
    loaded = load_map(save_map(map, tmp_path / "map.safetensors"))
    assert loaded.init_args() == {"size": 4, "options": options, "largest": math.inf}
    warm = load_map(save_map(Warm(3, 4, 2, temperature=0.5, seed=7), tmp_path / "map.safetensors"))
    assert isinstance(warm, Warm)
    assert (warm.temperature, warm.seed) == (0.5, 7)
    assert (warm.init_positional(), warm.init_args()) == ((3, 4, 2), {"temperature": 0.5, "seed": 7})


@pytest.mark.parametrize(
    ("map", "error", "message"),
    [
        (Takes(4, abs), TypeError, "the argument 'function' of Takes can stand in no file"),
        (
            Keeps(4, 1.5),
            ValueError,
            "attribute named like an argument of the constructor must be that argument",
        ),
    ],
)
def test_what_cannot_be_saved_is_refused_before_it_is_trained(
    map: ActionMap, error: type[Exception], message: str, demos: Demos
) -> None:
    before = map.actuation_low.clone()
    with pytest.raises(error, match=message):
        nht.train_map(demos, map)
    assert torch.equal(map.actuation_low, before)


def test_a_constructor_that_makes_other_weights_each_time_is_refused() -> None:
    class Growing(nht.Identity):
        made = 0

        def __init__(self) -> None:
            super().__init__(4)
            Growing.made += 1
            self.register_buffer("table", torch.zeros(Growing.made))

    with pytest.raises(ValueError, match="constructed again, its weights differ"):
        check_storable(Growing())


# Files that are not what they seem.


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return save_map(nht.NHT(3, 4, 2, (5,)), tmp_path / "map.safetensors")


def test_files_have_the_mode_that_the_umask_asks_for(path: Path) -> None:
    before = os.umask(0o027)
    try:
        assert save_map(nht.SVD(4, 2), path).stat().st_mode & 0o777 == 0o640
        assert nht.export_map(nht.SVD(4, 2), path.with_suffix(".pt2")).stat().st_mode & 0o777 == 0o640
    finally:
        os.umask(before)


def test_a_file_that_may_not_be_read_is_said_to_be_there(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)  # the superuser, who may run the tests, may read anything
    with pytest.raises(PermissionError, match=r"the map file .*map.safetensors may not be read by this user"):
        load_map(path)


def test_a_map_is_written_alike_every_time(tmp_path: Path) -> None:
    map = nht.NHT(2, 5, 2, hidden=(3,))
    map.context_keys = ("joint angle \u00e9", "\x7f\n")  # text that JSON may write in several ways
    files = [save_map(map, tmp_path / f"{number}.safetensors").read_bytes() for number in range(20)]
    assert len(set(files)) == 1
    assert load_map(tmp_path / "0.safetensors").context_keys == map.context_keys
    size = 8 + int.from_bytes(files[0][:8], "little")
    assert size % 8 == 0
    assert list(json.loads(files[0][8:size])["__metadata__"]) == [
        "checksum",
        "format",
        "format_version",
        "map",
    ]


def test_folders_and_devices_are_no_map_files(tmp_path: Path) -> None:
    for other in (tmp_path, Path("/dev/zero")):
        with pytest.raises(ValueError, match=f"{other} is no file that holds a map"):
            load_map(other)
    with pytest.raises(FileNotFoundError, match="there is no map file"):
        load_map(tmp_path / "nothing" / "map.safetensors")


@pytest.mark.parametrize(
    ("kind", "arguments"),
    [
        ("NHT", {"context_dim": 3, "actuation_dim": 4, "action_dim": 2, "hidden": [30_000, 30_000]}),
        ("NHT", {"context_dim": 3, "actuation_dim": 10**12, "action_dim": 2}),
        ("SVD", {"actuation_dim": 50_000, "action_dim": 50_000}),
        ("Identity", {"actuation_dim": 10**30}),
        ("SCL", {"context_dim": 10**10, "actuation_dim": 4, "action_dim": 2}),
        ("CAE", {"context_dim": 3, "actuation_dim": 4, "action_dim": 2, "hidden": [1000] * 2000}),
    ],
)
@pytest.mark.parametrize("version", [1, 2])
def test_a_small_file_gets_no_large_memory(
    path: Path, kind: str, arguments: dict[str, Any], version: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if version == 1:
        as_version_1(path, init_args=arguments, **{"class": kind})
    else:
        relabel(path, init_args=arguments, **{"class": kind})
    largest = 0
    empty = torch.empty

    def watched(*args: Any, **kwargs: Any) -> Tensor:
        nonlocal largest
        made = empty(*args, **kwargs)
        largest = max(largest, 0 if made.is_meta else made.nbytes)
        return made

    monkeypatch.setattr(torch, "empty", watched)
    with pytest.raises(ValueError, match=str(path)):
        load_map(path)
    assert largest < 2**26


def changed(path: Path, tensors: dict[str, Tensor] | None = None, **description: Any) -> None:
    """Changes a file without mending its checksum."""
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
    metadata["map"] = json.dumps(json.loads(metadata["map"]) | description)
    save_file(load_file(path) | (tensors or {}), path, metadata)


@pytest.mark.parametrize(
    "change",
    [
        {"data_fingerprint": "of other data"},
        {"action_scale": 2.0},
        {"saturation": "scale"},
        {"saturation": "clip"},
        {"context_keys": ["elsewhere"]},
        {"tensors": {"action_scale": torch.tensor(2.0)}},
        {"tensors": {"network.layers.0.bias": torch.zeros(5)}},
        {"tensors": {"network.layers.0.bias": torch.full((5,), torch.nan)}},
    ],
)
def test_changed_files_are_noticed(path: Path, change: dict[str, Any]) -> None:
    if change.get("saturation") == nht.load_map(path).saturation:
        pytest.skip("no change")
    changed(path, **change)
    with pytest.raises(
        ValueError, match=r"map.safetensors has been changed since it was written: its checksum"
    ):
        load_map(path)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("network.layers.0.weight", "network.layers.0.weight is not finite"),
        ("network.context_std", "network.context_std is not finite"),
        ("action_scale", "action_scale"),
        ("actuation_low", "actuation_low is not finite"),
    ],
)
def test_numbers_that_are_not_finite_are_neither_saved_nor_loaded(
    path: Path, name: str, message: str, value: float
) -> None:
    if name == "actuation_low" and not math.isnan(value):
        return  # bounds may be infinite
    map = nht.NHT(3, 4, 2, (5,))
    map.state_dict()[name].fill_(value)
    with pytest.raises(ValueError, match=message):
        save_map(map, path)
    as_version_1(path)  # a format without a checksum
    changed(path, {name: map.state_dict()[name]})
    with pytest.raises(ValueError, match=message):
        load_map(path)


def test_a_device_that_is_not_there_is_no_fault_of_the_file(path: Path) -> None:
    with pytest.raises(RuntimeError, match="nowhere"):
        load_map(path, "nowhere")


def test_version_1_must_not_contradict_itself(path: Path) -> None:
    as_version_1(path, action_scale=2.0)
    with pytest.raises(ValueError, match=r"its description has action_scale 2\.0, its map 1"):
        load_map(path)


@pytest.mark.parametrize(
    "description",
    [
        {"context_keys": 3},
        {"context_keys": [3]},
        {"context_keys": [[]]},
        {"data_fingerprint": 3},
        {"saturation": "squash"},
        {"saturation": None},
        {"init_args": []},
        {"init_args": {"context_dim": "three", "actuation_dim": 4, "action_dim": 2}},
        {"init_args": {"context_dim": 3, "actuation_dim": 4, "action_dim": 2, "seed": 10**40}},
        {"init_args": {"context_dim": 3, "actuation_dim": 4, "action_dim": 2, "hidden": {"dict": 3}}},
        {"init_args": {"context_dim": 3, "actuation_dim": 4, "action_dim": 2, "hidden": {"number": "x"}}},
        {"module": 3},
        {"module": "..nht"},
        {"class": None},
        {"action_dim": 3},
    ],
)
def test_damaged_descriptions_are_refused(path: Path, description: dict[str, Any]) -> None:
    relabel(path, **description)
    with pytest.raises(ValueError, match=r"map\.safetensors "):
        load_map(path)


def refusal(path: Path) -> str | None:
    """What a ValueError says of the file; None if it is taken."""
    try:
        load_map(path)
    except ValueError as error:
        return str(error)
    return None


@pytest.mark.parametrize("version", [1, 2])
def test_every_mutation_is_taken_whole_or_refused_by_one_sentence(path: Path, version: int) -> None:
    """A changed byte, a cut, an insertion: 2,000 each. Of version 1, what has no checksum may go unnoticed."""
    if version == 1:
        as_version_1(path)
    content, generator = path.read_bytes(), random.Random(version)
    taken = 0
    for _ in range(2_000):
        at = generator.randrange(len(content))
        kind = generator.choice(["byte", "cut", "more", "text"])
        if kind == "byte":
            mutated = content[:at] + bytes([generator.randrange(256)]) + content[at + 1 :]
        elif kind == "cut":
            mutated = content[:at] + content[at + generator.randrange(1, 9) :]
        elif kind == "more":
            mutated = content[:at] + generator.randbytes(generator.randrange(1, 9)) + content[at:]
        else:  # a number or a word of the header
            old = generator.choice([b"3", b"4", b"NHT", b"tanh", b"null", b"F32", b"nht", b"true", b"0,"])
            new = generator.choice([b"9", b"-", b"nan", b"{}", b"[]", b"null", b"1e999", b'"', b"\xff"])
            mutated = content.replace(old, new, generator.randrange(1, 4))
        if mutated == content:
            continue
        path.write_bytes(mutated)
        answer = refusal(path)
        taken += answer is None
        assert answer is None or (answer.startswith(str(path)) and len(answer) < 1_000)
        assert path.read_bytes() == mutated
    assert taken == 0 if version == 2 else taken < 1_000
