"""Every kind of file that is read, with what it means; and what becomes of it when it is changed."""

import hashlib
import json
import random
import struct
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer

import nht
import toy_search
from mutations import mutated
from nht.memmap import read_tensordict
from nht.recipes.agents.policy_file import read_policy, write_policy
from nht.recipes.agents.ppo import PPO
from nht.recipes.data.files import read_episodes
from nht.recipes.launch import configure
from nht.recipes.run.checkpoint_file import CheckpointFile
from nht.recipes.run.checkpoints import Checkpoints
from nht.recipes.run.metrics_file import read_metrics
from nht.recipes.run.saved_run import read_config
from nht.recipes.run.statistics import Counters
from nht.recipes.sections import SourceConfig
from nht.recipes.study.jobs import Ending
from nht.recipes.study.results import read_results
from nht.recipes.study.space import read_search_manifest, write_search_manifest
from toy_demos import as_rollout, demonstrations, episodes, write_hdf5
from untouched import only_reads


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        make: makes a good one in a folder; gives the files to change.
        read: what is in the folder, so that equal meanings are equal.
        sealed: whether a checksum must notice every change of meaning. Files that people edit, and those that others
            define, have none: what is taken then is what somebody could have written.
    """

    make: Callable[[Path], list[Path]]
    read: Callable[[Path], Any]
    sealed: bool = True


def meaning(value: Any) -> Any:
    """Nested values in a form that can be compared."""
    if isinstance(value, TensorDictBase):
        return {
            "/".join(key) if isinstance(key, tuple) else key: meaning(one)
            for key, one in value.items(True, True)
        }
    if isinstance(value, (torch.Tensor, np.ndarray)):
        array = np.ascontiguousarray(value.detach().numpy() if isinstance(value, torch.Tensor) else value)
        return str(array.dtype), array.shape, hashlib.sha256(array.tobytes()).hexdigest()
    if isinstance(value, dict):
        return {name: meaning(one) for name, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [meaning(one) for one in value]
    return repr(value)


def make_map(folder: Path) -> list[Path]:
    torch.manual_seed(0)
    map = nht.NHT(context_dim=4, actuation_dim=3, action_dim=2, hidden=(8,))
    map.context_keys = ("observation",)
    file = nht.save_map(map, folder / "map.safetensors")
    content = file.read_bytes()
    (length,) = struct.unpack("<Q", content[:8])
    header = json.dumps(
        json.loads(content[8 : 8 + length]), sort_keys=True
    ).encode()  # safetensors' order changes
    file.write_bytes(struct.pack("<Q", len(header)) + header + content[8 + length :])
    return [file]


def read_map(folder: Path) -> Any:
    map = nht.load_map(folder / "map.safetensors")
    return (
        type(map).__name__,
        meaning(dict(map.state_dict())),
        meaning(map.init_args()),
        repr(map.context_keys),
    )


def make_policy(folder: Path) -> list[Path]:
    torch.manual_seed(0)
    write_policy(torch.nn.Linear(4, 2).state_dict(), folder / "policy.safetensors")
    return [folder / "policy.safetensors"]


def read_a_policy(folder: Path) -> Any:
    return meaning(read_policy(folder / "policy.safetensors", torch.nn.Linear(4, 2).state_dict()))


def parts_of_a_run(rows: int) -> dict[str, Any]:
    torch.manual_seed(0)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(20))
    if rows:
        buffer.extend(
            TensorDict({"a": torch.randn(rows, 2), "next": {"b": torch.randn(rows)}}, batch_size=rows)
        )
    return {"loss": torch.nn.Linear(3, 2), "counters": Counters(100, 7), "buffer": buffer}


def make_checkpoint(folder: Path) -> list[Path]:
    Checkpoints(folder, **parts_of_a_run(10)).save(100)
    return list(folder.glob("checkpoint-*"))


def read_checkpoint(folder: Path) -> Any:
    with CheckpointFile(folder / "checkpoint-000000000100.torchrl") as file:
        file.check()
    parts = parts_of_a_run(0)
    Checkpoints(folder, **parts).load(100)
    return meaning([dict(parts["loss"].state_dict()), parts["counters"].state_dict(), parts["buffer"][:]])


def make_demos(folder: Path) -> None:
    nht.save_demos(demonstrations(), folder / "demos", settings={"start": "fixed", "sizes": [1, 2]})


def make_demos_manifest(folder: Path) -> list[Path]:
    make_demos(folder)
    return [folder / "demos" / "manifest.json"]


def make_demos_data(folder: Path) -> list[Path]:
    make_demos(folder)
    return sorted(path for path in (folder / "demos" / "data").rglob("*") if path.is_file())


def read_demos(folder: Path) -> Any:
    demos = nht.load_demos(folder / "demos")
    return meaning(demos.manifest), meaning(demos.data)


def make_tensordict(folder: Path) -> list[Path]:
    as_rollout(episodes()).memmap(folder / "data")
    files = sorted(path for path in (folder / "data").rglob("*") if path.is_file())
    return files + 5 * [file for file in files if file.name == "meta.json"]


def read_folder(folder: Path) -> Any:
    found = read_episodes(SourceConfig(kind="tensordict", path=str(folder / "data")))
    return meaning(read_tensordict(folder / "data")), meaning(found.data), found.left_out


def make_minari(folder: Path) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        nht.to_minari(demonstrations(), "fuzz-v0")  # which goes where Minari's datasets are
    return folder / "fuzz-v0" / "data"


def make_minari_metadata(folder: Path) -> list[Path]:
    return [make_minari(folder) / "metadata.json"]


def make_minari_data(folder: Path) -> list[Path]:
    return [make_minari(folder) / "main_data.hdf5"]


def read_minari(folder: Path) -> Any:
    demos = nht.from_minari(folder / "fuzz-v0")
    return meaning(demos.manifest), meaning(demos.data)


def make_config(folder: Path) -> list[Path]:
    config = asdict(configure(PPO, "ppo", ["env=wam_wipe", "map=nht", "run.wandb=false"]))
    (folder / "config.yaml").write_text(yaml.safe_dump({"recipe": "ppo", **config}, sort_keys=False))
    return [folder / "config.yaml"]


def make_metrics(folder: Path) -> list[Path]:
    heading = "frames,train_success,eval_success,eval_failure,eval_return,updates,seconds\r\n"
    rows = "".join(
        f"{300 * n},,0.{n},0.0,-2{n}.5,{15 * n},{n}.25\r\n".replace(",,", ",nan,") for n in range(1, 5)
    )
    (folder / "metrics.csv").write_bytes((heading + rows).encode())
    return [folder / "metrics.csv"]


def make_rows(folder: Path) -> list[Path]:
    rows = toy_search.rows(configurations=2, seeds=1, evaluations=2, best_seeds=1)
    rows.to_csv(folder / "rows.csv", index=False)
    return [folder / "rows.csv"]


def read_rows(folder: Path) -> Any:
    results = read_results(folder / "rows.csv")
    return results.rows.to_csv(), results.runs["score"].tolist()


def make_outcome(folder: Path) -> list[Path]:
    Ending("failed", "ValueError: out of luck").write(folder)
    return [folder / "outcome.json"]


def make_manifest(folder: Path) -> list[Path]:
    write_search_manifest(
        folder / "manifest.json", {"configs": 3, "seeds": 2, "space": {"agent": {"a": [0.1, 1.0]}}}
    )
    return [folder / "manifest.json"]


def make_hdf5(folder: Path) -> list[Path]:
    return [write_hdf5(folder / "toy.hdf5")]


KINDS: dict[str, Kind] = {
    "map": Kind(make_map, read_map),
    "policy": Kind(make_policy, read_a_policy),
    "checkpoint": Kind(make_checkpoint, read_checkpoint),
    "demonstrations: manifest.json": Kind(make_demos_manifest, read_demos),
    "demonstrations: data": Kind(make_demos_data, read_demos),
    "TensorDict folder": Kind(make_tensordict, read_folder, sealed=False),
    "Minari metadata.json": Kind(make_minari_metadata, read_minari, sealed=False),
    "Minari main_data.hdf5": Kind(make_minari_data, read_minari, sealed=False),
    "HDF5": Kind(make_hdf5, lambda folder: meaning(nht.from_hdf5(folder / "toy.hdf5").data), sealed=False),
    "config.yaml": Kind(make_config, lambda folder: repr(read_config(folder)), sealed=False),
    "metrics.csv": Kind(make_metrics, lambda folder: read_metrics(folder / "metrics.csv"), sealed=False),
    "rows.csv": Kind(make_rows, read_rows, sealed=False),
    "outcome.json": Kind(make_outcome, Ending.read, sealed=False),
    "manifest.json of a search": Kind(
        make_manifest, lambda folder: read_search_manifest(folder / "manifest.json"), sealed=False
    ),
}


def fuzz(kind: str, folder: Path, tries: int, seed: int) -> tuple[Counter[str], list[str]]:
    """Changes a file ``tries`` times, each time from the good one, and reads it.

    Returns:
        how often it was refused clearly ("clear"), taken with an equal meaning ("equal"), taken as something else that
        somebody could have written ("taken"), or answered in any other way ("other"); and what these others were.
    """
    rng = random.Random(f"{kind}-{seed}")
    about = KINDS[kind]
    files = about.make(folder)
    expected = about.read(folder)
    counts: Counter[str] = Counter()
    others: list[str] = []
    for number in range(tries):
        file = rng.choice(files)
        before = file.read_bytes()
        file.write_bytes(mutated(file, rng))
        try:
            outcome, what = _outcome(about, folder, expected)
        except AssertionError as error:
            outcome, what = "other", f"touched something: {error}"
        counts[outcome] += 1
        if outcome == "other":
            others.append(f"{number}, {file.name}: {what}"[:400])
        file.write_bytes(before)
    return counts, others


def _outcome(about: Kind, folder: Path, expected: Any) -> tuple[str, str]:
    try:
        with only_reads(folder), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = about.read(folder)
    except (ValueError, FileNotFoundError, KeyError) as error:
        text = str(error)
        named = str(folder) in text and type(error) in (ValueError, FileNotFoundError, KeyError)
        return ("clear", "") if named and len(text) < 2000 else ("other", f"{type(error).__name__}: {text}")
    except Exception as error:  # noqa: BLE001 - all others are what is looked for
        return "other", f"{type(error).__name__}: {error}"
    if found == expected:
        return "equal", ""
    return ("other", "taken though changed") if about.sealed else ("taken", "")
