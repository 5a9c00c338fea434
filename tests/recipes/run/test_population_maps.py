"""The maps of a population are trained together, and are those of as many runs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch

import nht
import populations
from nht.recipes.data.recording import record_expert
from nht.recipes.run.population import open_run
from nht.recipes.run.ranks import Ranks
from nht.recipes.sections import DemosConfig, EnvConfig

SHARED = ["map=nht", "map.max_steps=60", "algo.total_frames=100"]
LEARNERS = {
    "a": ["seed=3", "map.hidden=[12]", "map.lipschitz=2.0", "map.learning_rate=0.01"],
    "b": ["seed=8", "map.hidden=[9,20]", "map.activation=relu", "map.batch_size=30"],
    "c": ["seed=5", "map.hidden=[7]", "map.activation=sigmoid", "map.action_scale=3.0", "map.max_steps=40"],
}


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demos") / "wipe"
    record_expert(EnvConfig(), DemosConfig(transitions=600), 0, folder)
    return folder


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many maps were trained together, by call."""
    counts: list[int] = []
    train_maps = nht.train_maps

    def counted(demos: Any, maps: Any, **options: Any) -> Any:
        counts.append(len(maps))
        return train_maps(demos, maps, **options)

    monkeypatch.setattr(nht, "train_maps", counted)
    return counts


def opened(folder: Path, learners: dict[str, list[str]], demos: Path) -> Any:
    told = [f"demos.path={demos}", *SHARED]
    configs = [populations.config("ddpg", folder / name, *told, *own) for name, own in learners.items()]
    return open_run(configs, Ranks(), together=str(folder))


def measured(folder: Path) -> dict[str, float]:
    found: dict[str, float] = json.loads((folder / "map.json").read_text())
    return {name: value for name, value in found.items() if name != "seconds"}


def test_every_map_is_that_of_a_single_run(tmp_path: Path, demos: Path, asked: list[int]) -> None:
    opened(tmp_path / "together", LEARNERS, demos).close()
    assert asked == [3]
    for name, own in LEARNERS.items():
        opened(tmp_path / "alone", {name: own}, demos).close()
        maps = [nht.load_map(tmp_path / where / name / "map.safetensors") for where in ("together", "alone")]
        assert maps[0].init_args() == maps[1].init_args()
        torch.testing.assert_close(maps[0].state_dict(), maps[1].state_dict(), rtol=1e-4, atol=1e-5)
        alone_measured = measured(tmp_path / "alone" / name)
        assert measured(tmp_path / "together" / name) == pytest.approx(alone_measured, rel=1e-3)
    assert asked == [3]


def test_maps_that_are_there_are_not_trained_again(tmp_path: Path, demos: Path, asked: list[int]) -> None:
    opened(tmp_path, {"a": LEARNERS["a"]}, demos).close()
    before = (tmp_path / "a" / "map.safetensors").read_bytes()
    goes_on = {name: [*told, "run.resume=auto"] for name, told in LEARNERS.items()}
    opened(tmp_path, goes_on, demos).close()
    assert asked == [2]
    assert (tmp_path / "a" / "map.safetensors").read_bytes() == before


def test_other_kinds_and_offsets_are_trained_apart(tmp_path: Path, demos: Path, asked: list[int]) -> None:
    offset = {"d": ["seed=1", "map.offset=constant"], "e": ["seed=2", "map=svd"]}
    opened(tmp_path, LEARNERS | offset, demos).close()
    assert asked == [3]
    assert type(nht.load_map(tmp_path / "e" / "map.safetensors")) is nht.SVD


def test_a_map_that_diverges_is_that_runs_failure(tmp_path: Path, demos: Path) -> None:
    learners = LEARNERS | {"b": [*LEARNERS["b"], "map.learning_rate=inf"]}
    with pytest.raises(FloatingPointError, match="training diverged in the first 60 steps"):
        opened(tmp_path, learners, demos)
    assert not any((tmp_path / name).exists() for name in learners)
