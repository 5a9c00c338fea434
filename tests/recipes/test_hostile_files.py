"""Files that would run code, write, or lead elsewhere: refused with a reason, and nothing happens."""

import json
import os
import pickle
import re
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from tensordict import NonTensorData, NonTensorStack, TensorDict
from torchrl.checkpoint import Checkpoint
from torchrl.data import LazyMemmapStorage, LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer

import nht
import tiny_runs
from nht.memmap import read_tensordict
from nht.memmap_files import write_tensordict
from nht.recipes import collect_demos, evaluate, inspect_demos
from nht.recipes.agents.policy_file import read_policy, write_policy
from nht.recipes.config import CollectDemos, Evaluate
from nht.recipes.launch import configure
from nht.recipes.run.checkpoint_file import CheckpointFile
from nht.recipes.run.checkpoints import Checkpoints
from nht.recipes.run.saved_run import read_config
from nht.recipes.run.statistics import Counters
from toy_demos import demonstrations, episodes, write_hdf5
from untouched import only_reads

h5py = pytest.importorskip("h5py")


class Bomb:
    """Makes a file where it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


@pytest.fixture
def outside(tmp_path):
    """A folder next to that of the files, which nothing must touch; bombs would leave a file there."""
    folder = tmp_path / "outside"
    folder.mkdir()
    (folder / "file").write_bytes(b"thirteen byte")
    return folder


@pytest.fixture(autouse=True)
def minari_home(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "home"))
    return tmp_path / "home"


def refused(folder: Path, read, message: str, error: type[Exception] = ValueError) -> None:
    """``read()`` raises, and nothing in or beside the folder has changed."""
    with only_reads(folder.parent), pytest.raises(error, match=message):
        read()


# TensorDicts: folders of raw files.


@pytest.fixture
def folder(tmp_path):
    """A TensorDict of 200 rows, as TensorDict writes it."""
    rows = {"action": torch.randn(200, 3), "observation": torch.randn(200, 4)}
    outcome = {"done": torch.arange(200)[:, None] % 20 == 19, "observation": torch.randn(200, 4)}
    data = TensorDict({**rows, "next": outcome}, batch_size=200)
    data.memmap(tmp_path / "data")
    return tmp_path / "data"


def edit(file: Path, **changes) -> None:
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def test_a_good_folder_is_read_and_stays_as_it_is(folder):
    expected = TensorDict.load_memmap(folder)
    with only_reads(folder.parent):
        found = read_tensordict(folder)
        assert (found == expected).all()
        found["action"].zero_()  # a private copy of the page
        found["next", "observation"] += 1
    assert (TensorDict.load_memmap(folder) == expected).all()


def test_what_we_write_tensordict_reads(tmp_path):
    data = TensorDict({"a/b c": torch.arange(6).reshape(3, 2), "n": {"x": torch.rand(3, 0)}}, batch_size=3)
    write_tensordict(data, tmp_path / "data")
    for found in (TensorDict.load_memmap(tmp_path / "data"), read_tensordict(tmp_path / "data")):
        assert (found == data).all()
        assert found["a/b c"].dtype == torch.int64


def test_text_and_stacks_in_a_folder_are_read(tmp_path):
    from tensordict import LazyStackedTensorDict

    parts = [
        TensorDict({"x": torch.rand(2), "note": NonTensorData("hi", batch_size=[2])}, 2) for _ in range(3)
    ]
    LazyStackedTensorDict(*parts, stack_dim=0).memmap(tmp_path / "data")
    with only_reads(tmp_path):
        found = read_tensordict(tmp_path / "data")
    assert found.batch_size == (3, 2)
    assert torch.equal(found["x"], torch.stack([part["x"] for part in parts]))
    assert found[1]["note"] == "hi"


def with_pickle(folder: Path, outside: Path) -> None:
    inner = folder / "note"
    inner.mkdir()
    kind = "<class 'tensordict.tensorclass.NonTensorData'>"
    edit(folder / "meta.json", note={"type": "NonTensorData"})
    (inner / "meta.json").write_text(json.dumps({"_type": kind, "_is_non_tensor": True, "_metadata": None}))
    (inner / "other.pickle").write_bytes(pickle.dumps({"data": Bomb(outside / "exploded")}))


def with_pickled_stack(folder: Path, outside: Path) -> None:
    NonTensorStack(*[NonTensorData(Path("a")), NonTensorData(Path("b"))]).memmap(folder / "note")
    edit(folder / "meta.json", note={"type": "NonTensorStack"})
    (folder / "note" / "pickle.pkl").write_bytes(pickle.dumps([Bomb(outside / "exploded")] * 2))


def with_another_class(folder: Path, outside: Path) -> None:
    edit(folder / "meta.json", _type="<class 'hostile.Exploding'>")


def truncated(folder: Path, outside: Path) -> None:
    os.truncate(folder / "action.memmap", 100 * 12)


def longer(folder: Path, outside: Path) -> None:
    with (folder / "action.memmap").open("ab") as file:
        file.write(b"more")


def meta_says_more(folder: Path, outside: Path) -> None:
    record = json.loads((folder / "meta.json").read_text())
    record["shape"] = [50_000_000_000]
    record["action"]["shape"] = record["observation"]["shape"] = [50_000_000_000, 1]
    (folder / "meta.json").write_text(json.dumps(record))


def storage_says_more(folder: Path, outside: Path) -> None:
    storage = {"metadata": {}, "is_pytree": False, "len": 1_000_000}
    (folder / "storage_metadata.json").write_text(json.dumps(storage))


def storage_names_a_path(folder: Path, outside: Path) -> None:
    metadata = {
        str(outside / "file").replace(".", "_<dot>_"): {"shape": [1_000_000], "dtype": "torch.float32"}
    }
    storage = {"metadata": metadata, "is_pytree": True, "len": 1_000_000}
    (folder / "storage_metadata.json").write_text(json.dumps(storage))


def a_key_leads_out(folder: Path, outside: Path) -> None:
    (outside / "x.memmap").write_bytes(bytes(800))
    about = {"device": "cpu", "shape": [200], "dtype": "torch.float32", "is_nested": False}
    edit(folder / "meta.json", **{"../outside/x": about})


def an_absolute_key(folder: Path, outside: Path) -> None:
    (outside / "x.memmap").write_bytes(bytes(800))
    about = {"device": "cpu", "shape": [200], "dtype": "torch.float32", "is_nested": False}
    edit(folder / "meta.json", **{str(outside / "x"): about})


def a_link_leads_out(folder: Path, outside: Path) -> None:
    (folder / "action.memmap").rename(outside / "action.memmap")
    (folder / "action.memmap").symlink_to(outside / "action.memmap")


def a_folder_is_a_link(folder: Path, outside: Path) -> None:
    (folder / "next").rename(outside / "next")
    (folder / "next").symlink_to(outside / "next")


def a_folder_is_its_own_inside(folder: Path, outside: Path) -> None:
    (folder / "again").symlink_to("..")
    edit(folder / "meta.json", again={"type": "TensorDict"})


def a_pipe(folder: Path, outside: Path) -> None:
    (folder / "action.memmap").unlink()
    os.mkfifo(folder / "action.memmap")


def missing(folder: Path, outside: Path) -> None:
    (folder / "action.memmap").unlink()


def a_nested_tensor(folder: Path, outside: Path) -> None:
    record = json.loads((folder / "meta.json").read_text())
    record["action"]["is_nested"] = True
    (folder / "meta.json").write_text(json.dumps(record))


HOSTILE_FOLDERS = [
    (with_pickle, r"note holds pickled data.*If you trust the folder, load it yourself.*allow_pickle=True"),
    (with_pickled_stack, "note holds pickled data"),
    (with_another_class, r"meta.json is of <class 'hostile.Exploding'>, expected a TensorDict"),
    (truncated, r"action.memmap has 1,200 bytes, expected 2,400 for torch.float32 \[200, 3\]"),
    (longer, r"action.memmap has 2,404 bytes, expected 2,400"),
    (meta_says_more, r"has [\d,]+ bytes, expected 200,000,000,000"),
    (a_key_leads_out, r"entry '../outside/x' has no file"),
    (an_absolute_key, r"has no file"),
    (a_link_leads_out, r"action.memmap is a link, expected a plain file"),
    (a_folder_is_a_link, r"next is no folder, or a link to one"),
    (a_folder_is_its_own_inside, r"again is no folder, or a link to one"),
    (a_pipe, r"action.memmap is not a plain file"),
    (missing, r"entry 'action' has no file"),
    (a_nested_tensor, r"entry 'action' is a nested tensor"),
]


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        *HOSTILE_FOLDERS,
        (storage_says_more, r"'len' must be between 0 and the 200 rows that there are, got 1000000"),
        (storage_names_a_path, r"is of a storage of nested tuples or lists"),
    ],
)
def test_a_hostile_folder_of_a_tensordict(attack, message, folder, outside, tmp_path):
    attack(folder, outside)
    refused(folder, lambda: read_tensordict(folder), message)
    refused(folder, lambda: inspect_demos.read_source(str(folder)), message)
    overrides = ["source=tensordict", f"source.path={folder}", "env.name=toy", f"out={tmp_path / 'out'}"]
    config = configure(CollectDemos, "collect_demos", overrides)
    refused(folder, lambda: collect_demos.main(config), message)


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        (with_pickle, "holds pickled data"),
        (truncated, r"action.memmap has"),
        (storage_says_more, r"'len' must be between"),
        (storage_names_a_path, r"nested tuples"),
        (a_key_leads_out, r"has no file"),
        (a_link_leads_out, r"is a link"),
        (a_folder_is_a_link, r"or a link to one"),
    ],
)
def test_hostile_demonstrations(attack, message, outside, tmp_path):
    data = episodes()
    data["action"] = torch.randn(15, 25)  # of a size that the attacks know how to cut
    nht.save_demos(data, tmp_path / "demos", env="toy", seed=0, expert="Toy")
    attack(tmp_path / "demos" / "data", outside)
    refused(
        tmp_path / "demos", lambda: nht.load_demos(tmp_path / "demos"), rf"the data of .*demos.*{message}"
    )


def test_storage_metadata_that_shortens_demonstrations_is_noticed(tmp_path):
    nht.save_demos(demonstrations(), tmp_path / "demos")
    edit(tmp_path / "demos" / "data" / "storage_metadata.json", len=5)
    refused(tmp_path / "demos", lambda: nht.load_demos(tmp_path / "demos"), "not those of its manifest")


@pytest.mark.parametrize(
    ("name", "value"),
    [("env", "other"), ("episodes", 4), ("settings", {"left_out_episodes": 1}), ("seed", 1)],
)
def test_a_manifest_that_was_changed_is_noticed(name, value, tmp_path):
    nht.save_demos(demonstrations(), tmp_path / "demos")
    edit(tmp_path / "demos" / "manifest.json", **{name: value})
    refused(tmp_path / "demos", lambda: nht.load_demos(tmp_path / "demos"), r"manifest.json was changed")


def test_read_only_folders_are_read(tmp_path):
    expected = nht.save_demos(demonstrations(), tmp_path / "demos")
    places = sorted((tmp_path / "demos").rglob("*"), reverse=True)
    for place in places:
        place.chmod(0o555 if place.is_dir() else 0o444)
    with only_reads(tmp_path):
        found = nht.load_demos(tmp_path / "demos")
        assert (found.data == expected.data).all()
    for place in places:
        place.chmod(0o755)


def test_demonstrations_as_earlier_versions_wrote_them(tmp_path):
    """With TorchRL's storage, and no checksum in the manifest."""
    expected = nht.save_demos(demonstrations(), tmp_path / "demos")
    (tmp_path / "demos" / "data").rename(tmp_path / "new")
    storage = LazyMemmapStorage(15, scratch_dir=tmp_path / "demos" / "data")
    ReplayBuffer(storage=storage).extend(expected.data)
    storage.dumps(tmp_path / "demos" / "data")
    manifest = json.loads((tmp_path / "demos" / "manifest.json").read_text())
    del manifest["checksum"]
    (tmp_path / "demos" / "manifest.json").write_text(json.dumps(manifest))
    with only_reads(tmp_path):
        found = nht.load_demos(tmp_path / "demos")
    assert found.manifest == expected.manifest
    assert (found.data == expected.data).all()


# HDF5 files.


def external_link(file, outside: Path) -> None:
    file["observations"] = h5py.ExternalLink(str(outside / "other.hdf5"), "/observations")


def external_group(file, outside: Path) -> None:
    file["group"] = h5py.ExternalLink(str(outside / "other.hdf5"), "/")
    file["observations"] = h5py.SoftLink("/group/observations")


def external_storage(file, outside: Path) -> None:
    place = [(str(outside / "raw"), 0, 15 * 16)]
    file.create_dataset("observations", (15, 4), "f4", external=place)


def virtual(file, outside: Path) -> None:
    layout = h5py.VirtualLayout((15, 4), "f4")
    layout[:] = h5py.VirtualSource(str(outside / "other.hdf5"), "observations", (15, 4))
    file.create_virtual_dataset("observations", layout)


def circle(file, outside: Path) -> None:
    file["observations"], file["there"] = h5py.SoftLink("/there"), h5py.SoftLink("/observations")


def never_written(file, outside: Path) -> None:
    dataset = file.create_dataset("observations", (15, 4), "f4", chunks=(5, 4))
    dataset[:5] = 1.0


def never_written_at_all(file, outside: Path) -> None:
    file.create_dataset("observations", (15, 4), "f4")


def huge(file, outside: Path) -> None:
    file.create_dataset("observations", (2**46, 4), "f4", chunks=(2**20, 4), compression="gzip")


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        (
            external_link,
            r"'observations' is a link to '/observations' in another file, '.*other.hdf5'.*If you trust",
        ),
        (external_group, r"'group' is a link to '/' in another file"),
        (external_storage, r"'observations' keeps its values in another file, '.*raw'"),
        (virtual, r"'observations' is made of values in another file, '.*other.hdf5'"),
        (circle, r"the links at '.*' lead in a circle"),
        (never_written, r"'observations' has the shape \(15, 4\), but not all of its values were written"),
        (never_written_at_all, r"not all of its values were written"),
        (huge, r"not all of its values were written|more than there is memory"),
    ],
)
def test_a_hostile_hdf5_file(attack, message, outside, tmp_path):
    write_hdf5(outside / "other.hdf5")
    (outside / "raw").write_bytes(bytes(15 * 16))
    (tmp_path / "files").mkdir()
    path = write_hdf5(tmp_path / "files" / "toy.hdf5", observations=None, next_observations=None)
    with h5py.File(path, "a") as file:
        attack(file, outside)
    refused(path.parent, lambda: nht.from_hdf5(path), rf"toy.hdf5: .*({message})")


def test_links_within_an_hdf5_file_are_followed(tmp_path):
    path = write_hdf5(tmp_path / "toy.hdf5", observations=None)
    data = episodes()["observation"].numpy()
    with h5py.File(path, "a") as file:
        file["stored/here"] = data[:10]
        file["stored/there"] = data[10:]
        layout = h5py.VirtualLayout((15, 4), "f4")
        layout[:10] = h5py.VirtualSource(file["stored/here"])
        layout[10:] = h5py.VirtualSource(file["stored/there"])
        file.create_virtual_dataset("stored/all", layout)
        file["group"] = h5py.SoftLink("stored")
        file["observations"] = h5py.SoftLink("group/all")
        file["hard"] = file["actions"]
    with only_reads(tmp_path):
        found = nht.from_hdf5(path, actuation_key="hard")
    np.testing.assert_array_equal(found.data["observation"], data)
    assert torch.equal(found.actuation, episodes()["actuation"])


def test_an_hdf5_file_in_robomimics_layout_is_named(tmp_path):
    with h5py.File(tmp_path / "low_dim.hdf5", "w") as file:
        for number in range(50):
            for key in ("actions", "rewards", "obs/object", "next_obs/object"):
                file[f"data/demo_{number}/{key}"] = np.zeros((10, 3), "f4")
    with pytest.raises(KeyError, match="robomimic's") as raised:
        nht.from_hdf5(tmp_path / "low_dim.hdf5")
    assert len(str(raised.value)) < 1000


# Minari datasets.


@pytest.fixture
def dataset(minari_home):
    pytest.importorskip("minari")
    nht.to_minari(demonstrations(), "toy-v0")
    return minari_home / "toy-v0" / "data"


@pytest.fixture
def hostile_module(tmp_path, outside, monkeypatch):
    """A module that makes a file when it is imported, and when anything of it is called."""
    (tmp_path / "code").mkdir()
    text = f"open({str(outside / 'imported')!r}, 'w')\ndef explode(*_, **__): open({str(outside / 'ran')!r}, 'w')\n"
    (tmp_path / "code" / "hostile_module.py").write_text(text)
    monkeypatch.syspath_prepend(str(tmp_path / "code"))
    yield "hostile_module"
    assert "hostile_module" not in sys.modules


def no_space(folder: Path, outside: Path, module: str) -> None:
    about = json.loads((folder / "metadata.json").read_text())
    del about["observation_space"]
    spec = {"id": "Hostile-v0", "entry_point": f"{module}:explode", "additional_wrappers": [], "kwargs": {}}
    (folder / "metadata.json").write_text(json.dumps(about | {"env_spec": json.dumps(spec)}))


def linked_data(folder: Path, outside: Path, module: str) -> None:
    (folder / "main_data.hdf5").rename(outside / "main_data.hdf5")
    (folder / "main_data.hdf5").symlink_to(outside / "main_data.hdf5")


def linked_episode(folder: Path, outside: Path, module: str) -> None:
    write_hdf5(outside / "other.hdf5")
    with h5py.File(folder / "main_data.hdf5", "a") as file:
        del file["episode_1/actions"]
        file["episode_1/actions"] = h5py.ExternalLink(str(outside / "other.hdf5"), "/actions")


def another_format(folder: Path, outside: Path, module: str) -> None:
    edit(folder / "metadata.json", data_format="arrow")


def space(folder: Path, **changes) -> None:
    box = {"type": "Box", "dtype": "float32", "shape": [4], "low": [0.0] * 4, "high": [1.0] * 4}
    edit(folder / "metadata.json", observation_space=json.dumps(box | changes))


def blown_up(folder: Path, outside: Path, module: str) -> None:
    space(folder, shape=[10**12], low=0.0, high=1.0)


def of_objects(folder: Path, outside: Path, module: str) -> None:
    space(folder, dtype="object")


def unknown_space(folder: Path, outside: Path, module: str) -> None:
    space(folder, type="os.system")


def deep(folder: Path, outside: Path, module: str) -> None:
    inner = '{"type": "Tuple", "subspaces": [' * 200 + "]}" * 200
    edit(folder / "metadata.json", observation_space=inner)


def postscript(folder: Path, outside: Path, module: str) -> None:
    """A frame that is no JPEG but a program in PostScript, which a library of pictures would run."""
    frame = np.frombuffer(b"%!PS-Adobe-3.0 EPSF-3.0\n", np.uint8)
    low, high = np.zeros((64, 64, 3), int).tolist(), np.full((64, 64, 3), 255).tolist()
    space(folder, dtype="uint8", shape=[64, 64, 3], low=low, high=high)
    with h5py.File(folder / "main_data.hdf5", "a") as file:
        for episode in range(3):
            steps = len(file[f"episode_{episode}/rewards"])
            del file[f"episode_{episode}/observations"]
            file[f"episode_{episode}/observations"] = np.stack([frame] * (steps + 1))


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        (
            no_space,
            r"has no 'observation_space'.*make the environment that 'env_spec' names.*If you trust the dataset",
        ),
        (linked_data, r"main_data.hdf5 is a link, expected a plain file"),
        (linked_episode, r"'episode_1/actions' is a link to '/actions' in another file"),
        (another_format, r"'data_format' is 'arrow', expected 'hdf5'.*If you trust the dataset"),
        (blown_up, r"'low' must have the shape \(1000000000000,\) of the space, got \(\)"),
        (of_objects, r"'object' is no type of numbers"),
        (unknown_space, r"unknown kind of space, 'os.system'"),
        (deep, r"spaces within spaces"),
        (postscript, r"holds a frame that is no JPEG"),
    ],
)
def test_a_hostile_minari_dataset(attack, message, dataset, outside, hostile_module, tmp_path):
    attack(dataset, outside, hostile_module)
    reads = [lambda: nht.from_minari(dataset), lambda: nht.from_minari("toy-v0")]
    reads += [lambda: inspect_demos.read_source(str(dataset.parent))]
    overrides = ["source=minari", "source.path=toy-v0", "env.name=toy", f"out={tmp_path / 'out'}"]
    reads += [lambda: collect_demos.main(configure(CollectDemos, "collect_demos", overrides))]
    for read in reads:
        refused(tmp_path / "outside", read, rf"the Minari dataset .* cannot be read: .*{message}")


def test_a_dataset_that_its_owner_opened_is_taken(dataset, monkeypatch):
    import gymnasium
    import minari
    from gymnasium.spaces import Box

    class Trusted(gymnasium.Env):
        observation_space = Box(-9, 9, (4,), np.float32)
        action_space = Box(-9, 9, (3,), np.float32)

    nht.to_minari(demonstrations(), "mine-v0", observation_keys=["observation"])
    folder = dataset.parents[1] / "mine-v0" / "data"
    no_space(folder, folder, "tests_do_not_have")
    monkeypatch.setattr(gymnasium, "make", lambda *_, **__: Trusted())
    opened = minari.MinariDataset(folder)
    assert len(nht.from_minari(opened)) == 15


def test_looking_for_a_dataset_makes_no_folder(tmp_path, minari_home):
    pytest.importorskip("minari")
    refused(
        tmp_path / "home", lambda: nht.from_minari("toy-v0"), "nor the id of a local one", FileNotFoundError
    )
    assert not minari_home.exists()


# Checkpoints.


def parts() -> dict:
    """Parts of a run: a network, counters and a buffer with ten rows."""
    torch.manual_seed(0)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20))
    buffer.extend(TensorDict({"a": torch.randn(10, 2), "next": {"b": torch.randn(10)}}, batch_size=10))
    return {"loss": torch.nn.Linear(3, 2), "counters": Counters(100, 7), "buffer": buffer}


def rewritten(file: Path, change, **settings) -> None:
    """The archive with other members, and right checksums of ZIP."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    change(members)
    with zipfile.ZipFile(file, "w", **settings) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


@pytest.fixture(params=["ours", "TorchRL's"])
def checkpoint(request, tmp_path):
    """A checkpoint as we write it, or as earlier versions did."""
    folder = tmp_path / "run" / "checkpoints"
    file = folder / "checkpoint-000000000100.torchrl"
    if request.param == "ours":
        Checkpoints(folder, **parts()).save(100)
    else:
        checkpoints = Checkpoints(folder, **parts())
        named = {name: getattr(part, "_buffer", part) for name, part in checkpoints._parts.items()}
        Checkpoint(**named, format="archive").save(file)
    return file


def fresh(file: Path) -> tuple[Checkpoints, dict]:
    made = parts()
    made["counters"] = Counters()
    torch.nn.init.zeros_(made["loss"].weight)
    made["buffer"] = TensorDictReplayBuffer(storage=LazyTensorStorage(20))
    return Checkpoints(file.parent, **made), made


def test_a_checkpoint_comes_back_bit_for_bit(checkpoint):
    checkpoints, made = fresh(checkpoint)
    assert checkpoints.steps() == [100]
    with only_reads(checkpoint.parent):
        checkpoints.load(100)
        checkpoints.load(100)
    expected = parts()
    assert torch.equal(made["loss"].weight, expected["loss"].weight)
    assert made["counters"] == Counters(100, 7)
    assert (made["buffer"][:] == expected["buffer"][:]).all()
    for buffer in (made["buffer"], expected["buffer"]):
        buffer.extend(TensorDict({"a": torch.ones(15, 2), "next": {"b": torch.ones(15)}}, batch_size=15))
    assert (made["buffer"][:] == expected["buffer"][:]).all()


def pickled_queue(members: dict[str, bytes], outside: Path) -> None:
    folder = next(name for name in members if "-buffer/" in name).split("-buffer/")[0]
    members[f"{folder}-buffer/prefetch.pkl"] = pickle.dumps(Bomb(outside / "exploded"))


def with_torch_file(members: dict[str, bytes], outside: Path) -> None:
    folder = next(name for name in members if "-loss/state.json" in name).removesuffix("/state.json")
    members[f"{folder}/state.pt"] = pickle.dumps(Bomb(outside / "exploded"))


def pickled_value(members: dict[str, bytes], outside: Path) -> None:
    folder = next(name for name in members if "-loss/state.json" in name).removesuffix("/state.json")
    about = json.loads(members[f"{folder}/state/meta.json"]) | {"note": {"type": "NonTensorData"}}
    members[f"{folder}/state/meta.json"] = json.dumps(about).encode()
    members[f"{folder}/state/note/meta.json"] = (
        b'{"_type": "<class \'tensordict.tensorclass.NonTensorData\'>"}'
    )
    members[f"{folder}/state/note/other.pickle"] = pickle.dumps({"data": Bomb(outside / "exploded")})


def cut_member(members: dict[str, bytes], outside: Path) -> None:
    name = next(name for name in members if "-loss/state/tensor_00000000" in name)
    members[name] = members[name][:-4]


def member_outside(members: dict[str, bytes], outside: Path) -> None:
    members["../../outside/exploded"] = b"x"


def member_at_root(members: dict[str, bytes], outside: Path) -> None:
    members[f"{outside}/exploded"] = b"x"


def other_value(members: dict[str, bytes], outside: Path) -> None:
    name = next(name for name in members if "-counters/state.json" in name)
    members[name] = members[name].replace(b'"dict"', b'"object"')


IGNORED = (pickled_queue, with_torch_file)
"""In archives that have no checksums: what is not looked at can be anything."""


@pytest.mark.parametrize(
    "attack",
    [pickled_queue, with_torch_file, pickled_value, cut_member, member_outside, member_at_root, other_value],
)
def test_a_hostile_checkpoint(attack, checkpoint, outside):
    with CheckpointFile(checkpoint) as good:
        sealed = "sha256" in good.manifest
    rewritten(checkpoint, lambda members: attack(members, outside))

    def read() -> None:
        with CheckpointFile(checkpoint) as file:
            file.check()
            file.read()

    with only_reads(outside):
        if attack in IGNORED and not sealed:
            read()
        else:
            with pytest.raises(ValueError, match=checkpoint.name):
                read()
    assert not (outside / "exploded").exists()


def bomb(file: Path) -> None:
    rewritten(file, lambda members: members.update(zeros=bytes(10**7)), compression=zipfile.ZIP_DEFLATED)


def said_to_be_large(file: Path) -> None:
    """The archive's directory says that a member is larger than the archive."""
    content = bytearray(file.read_bytes())
    place = content.rindex(b"PK\x01\x02")
    content[place + 20 : place + 28] = 2 * (2**31 - 1).to_bytes(4, "little")
    file.write_bytes(content)


def twice(file: Path) -> None:
    with pytest.warns(UserWarning, match="Duplicate"), zipfile.ZipFile(file, "a") as archive:
        archive.writestr("manifest.json", "{}")


def no_archive(file: Path) -> None:
    file.write_bytes(pickle.dumps(Bomb(file.with_name("exploded"))))


def a_link(file: Path) -> None:
    file.rename(file.parents[1] / "elsewhere")
    file.symlink_to(file.parents[1] / "elsewhere")


@pytest.mark.parametrize(
    ("attack", "message"),
    [
        (bomb, "is compressed or encrypted"),
        (said_to_be_large, "said to be larger than the file"),
        (twice, "two members have the same name"),
        (no_archive, "is no checkpoint, or is cut short"),
        (a_link, "is a link, expected a plain file"),
    ],
)
def test_a_hostile_archive(attack, message, checkpoint):
    attack(checkpoint)
    checkpoints, _ = fresh(checkpoint)
    with (
        only_reads(checkpoint.parents[1]),
        pytest.warns(UserWarning, match=message),
        pytest.raises(ValueError, match=r"none of the checkpoints in .* can be read"),
    ):
        checkpoints.steps()


# Policies and configurations.


def test_a_hostile_policy(tmp_path):
    network = torch.nn.Linear(3, 2)
    file, expected = tmp_path / "run" / "policy.safetensors", network.state_dict()
    write_policy(expected, file)
    with only_reads(tmp_path):
        assert torch.equal(read_policy(file, expected)["weight"], expected["weight"])
    content = file.read_bytes()
    file.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    refused(
        file.parent,
        lambda: read_policy(file, expected),
        "policy.safetensors was changed since it was written",
    )
    file.write_bytes(content[:-1])
    refused(file.parent, lambda: read_policy(file, expected), "no safetensors file, or is cut short")
    write_policy({**expected, "bias": torch.tensor([0.0, float("nan")])}, file)
    refused(file.parent, lambda: read_policy(file, expected), "holds NaN or infinite values in bias")
    write_policy({"weight": torch.ones(4, 4), "bias": torch.ones(2)}, file)
    refused(
        file.parent,
        lambda: read_policy(file, expected),
        r"weight is torch.float32 \(4, 4\), expected .*\(2, 3\)",
    )
    write_policy({"weight": torch.ones(2, 3)}, file)
    refused(file.parent, lambda: read_policy(file, expected), r"missing \['bias'\], unexpected \[\]")
    save_file(dict(expected), file)  # as earlier versions wrote it
    assert torch.equal(read_policy(file, expected)["bias"], expected["bias"])


LAUGHS = "a: &a [x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"{name}: &{name} [{', '.join(9 * [f'*{before}'])}]\n"
    for before, name in zip("abcdef", "bcdefg", strict=True)
)
"""Nine times nine times ... the same."""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("recipe: !!python/object/apply:os.system ['touch {outside}/ran']", "is not YAML that can be read"),
        (
            "recipe: hostile_module:ALGORITHM",
            r"names recipe=hostile_module:ALGORITHM, code that would be run",
        ),
        (
            "env: {name: 'hostile_module:explode'}",
            r"names env.name=hostile_module:explode.*allow=\[hostile_module\]",
        ),
        ("map: {kind: 'hostile_module:explode'}", r"names map.kind=hostile_module:explode"),
        ("device: ${oc.env:HOME}", r"is not looked up"),
        (LAUGHS, r"more than 20,000 values"),
        ("- a list", "holds a list, expected settings by name"),
        ("seed: 2020-01-01", "holds a date"),
        ("recipe: nonsense", r"unknown algorithm 'nonsense'"),
        ("seed: x", "is no configuration of a run"),
        ("elbow: 1", "is no configuration of a run: .*elbow"),
        ("env: {num_threads: 1000000}", r"env.num_threads must be in 1 ... 1024, got 1000000"),
        ("\x00", "is not YAML"),
    ],
)
def test_a_hostile_configuration(text, message, outside, hostile_module, tmp_path):
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text(text.replace("{outside}", str(outside)))
    refused(folder, lambda: read_config(folder), rf"(?s)config.yaml.*{message}")


def test_code_that_a_configuration_names_can_be_allowed(tmp_path):
    (tmp_path / "config.yaml").write_text("env: {name: 'my_package.tasks:Pour'}")
    with pytest.raises(ValueError, match=re.escape("allow=[my_package]")):
        read_config(tmp_path, allow=["my_pack"])
    assert read_config(tmp_path, allow=["my_package"]).env.name == "my_package.tasks:Pour"


@pytest.fixture(scope="module", params=tiny_runs.RECIPES)
def small_run(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param) / "run"
    tiny_runs.train(request.param, folder, "algo.total_frames=200", "evaluation.every=200")
    return folder


@pytest.mark.parametrize(
    ("hidden", "message"),
    [
        ([10**6, 10**6], r"describes a policy far larger than the [\d,]+ bytes of policy.safetensors"),
        ([10**12, 10**12], "describes a policy far larger"),
        ([10**30], "describes a policy far larger"),
        ([-1], "describes no policy: .*negative"),
        ([8], "policy.safetensors is not of this policy"),
    ],
)
def test_a_configuration_of_huge_networks_builds_none(small_run, hidden, message):
    settings = small_run / "config.yaml"
    told = settings.read_text()
    try:
        settings.write_text(told.replace("  - 16\n  - 16\n", "".join(f"  - {one}\n" for one in hidden)))
        assert settings.read_text() != told
        with pytest.raises(ValueError, match=message):
            evaluate.main(Evaluate(run=str(small_run), episodes=2, video=False))
    finally:
        settings.write_text(told)
