"""Contracts: where and how Minari keeps datasets still is what this package relies on."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nht.minari_internals import (
    DATA,
    FOLDER,
    JPEG,
    METADATA,
    NAMESPACE,
    check_dataset_id,
    datasets_in,
    datasets_root,
    episode_buffer,
    episode_entry,
    tuple_entry,
)

minari = pytest.importorskip("minari")
h5py = pytest.importorskip("h5py")
spaces = pytest.importorskip("gymnasium.spaces")

PICTURE = spaces.Box(0, 255, (32, 32, 3), np.uint8)
NUMBERS = spaces.Box(-1.0, 1.0, (2,), np.float32)


@pytest.fixture(autouse=True)
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "home"))
    return tmp_path / "home"


def create(dataset_id: str, **arguments: Any) -> Any:
    """A dataset of one step, whose observations are a picture and two numbers."""
    buffer = episode_buffer(
        observations=(np.zeros((2, 32, 32, 3), np.uint8), np.zeros((2, 2), np.float32)),
        actions=np.zeros((1, 2), np.float32),
        rewards=np.zeros(1, np.float32),
        terminations=np.array([True]),
        truncations=np.array([False]),
        infos={},
    )
    both = spaces.Tuple([PICTURE, NUMBERS])
    return minari.create_dataset_from_buffers(
        dataset_id, [buffer], observation_space=both, action_space=NUMBERS, **arguments
    )


@pytest.mark.filterwarnings("ignore::UserWarning")  # on author and the like, which Minari recommends
def test_minari_lays_a_dataset_out_as_we_look_at_it(root: Path) -> None:
    dataset = create("robots/one-v0")
    folder = root / "robots" / "one-v0" / FOLDER
    assert Path(dataset.storage.data_path) == folder
    assert sorted(file.name for file in folder.iterdir()) == sorted([METADATA, DATA])
    assert [file.relative_to(root) for file in root.rglob(NAMESPACE)] == [Path("robots") / NAMESPACE]
    about = json.loads((folder / METADATA).read_text())
    expected = {"data_format": "hdf5", "total_episodes": 1, "total_steps": 1, "dataset_id": "robots/one-v0"}
    assert {name: about[name] for name in expected} == expected
    described = json.loads(about["observation_space"])
    assert (described["type"], [one["type"] for one in described["subspaces"]]) == ("Tuple", ["Box", "Box"])
    assert np.shape(described["subspaces"][1]["low"]) == (2,)
    with h5py.File(folder / DATA, "r") as file:
        numbers = file[f"{episode_entry(0, 'observations')}/{tuple_entry(1)}"]
        assert (numbers.shape, numbers.dtype) == ((2, 2), np.float32)
        assert file[episode_entry(0, "actions")].shape == (1, 2)
        frames = file[f"{episode_entry(0, 'observations')}/{tuple_entry(0)}"]
        if about.get("jpeg_encoding", True):
            assert [bytes(np.asarray(frame, np.uint8)[:3]) for frame in frames[()]] == [JPEG, JPEG]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_minari_writes_where_the_environment_says_and_is_told_otherwise_meanwhile(
    root: Path, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    with datasets_in(elsewhere):
        create("one-v0")
    assert (elsewhere / "one-v0" / FOLDER / METADATA).is_file()
    assert not (root / "one-v0").exists()
    assert os.environ["MINARI_DATASETS_PATH"] == str(root) == str(datasets_root())


def test_minari_keeps_datasets_in_the_home_where_nothing_else_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from minari.storage import get_dataset_path

    monkeypatch.delenv("MINARI_DATASETS_PATH")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert datasets_root() == get_dataset_path()


def test_an_episode_buffer_keeps_arrays_as_they_are() -> None:
    rewards = np.array([0.5], np.float32)
    assert episode_buffer(rewards=rewards).rewards is rewards


@pytest.mark.parametrize("dataset_id", ["one", "a/b/", "one-v"])
def test_minari_refuses_what_is_no_id(dataset_id: str) -> None:
    check_dataset_id("robots/one-v0")
    with pytest.raises(ValueError, match=re.escape(f"Malformed dataset ID: {dataset_id}.")):
        check_dataset_id(dataset_id)
