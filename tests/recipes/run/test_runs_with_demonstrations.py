"""Runs that learn from demonstrations: alone, together, stopped and gone on with."""

from __future__ import annotations

import json
from pathlib import Path

import pandas
import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

import nht
import populations
import tiny_runs
from nht.recipes.agents.policy import load_policy
from nht.recipes.data.recording import record_expert
from nht.recipes.run.demonstrations import demo_steps
from nht.recipes.run.environments import mapped_env
from nht.recipes.run.saved_run import read_config
from nht.recipes.sections import DemosConfig, EnvConfig

OFF_POLICY = ("ddpg", "sac", "td3")
CLONING = [
    "algo.demos.cloning=3",
    "algo.demos.cloning_start=20",
    "algo.demos.cloning_frames=350",
    "algo.demos.q_filter=true",
]
COUNT = 250
FRAME = pandas.testing.assert_frame_equal


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demos") / "wipe"
    record_expert(EnvConfig(), DemosConfig(transitions=600), 0, folder)
    return folder


def told(demos: Path, share: float) -> list[str]:
    return [f"demos.path={demos}", f"algo.demos.transitions={COUNT}", f"algo.demos.share={share}"]


def run(algorithm: str, folder: Path, *overrides: str) -> pandas.DataFrame:
    short = ["algo.total_frames=200", "evaluation.every=100", "algo.random_frames=0"]
    return tiny_runs.train(algorithm, folder, *short, *overrides)


@pytest.mark.parametrize("algorithm", OFF_POLICY)
def test_a_run_learns_from_them_and_says_how_they_fit(algorithm: str, demos: Path, tmp_path: Path) -> None:
    without = run(algorithm, tmp_path / "without")
    prefilled, beside = (run(algorithm, tmp_path / str(share), *told(demos, share)) for share in (0.0, 0.5))
    assert "demos_clipped" not in without
    for found in (prefilled, beside):
        assert (found["demos_missed"] < 1e-9).all()
        assert (found["demos_clipped"] == 0.0).all()
        assert not found["loss_actor"].equals(without["loss_actor"])
    assert not prefilled["loss_actor"].equals(beside["loss_actor"])
    noted = json.loads((tmp_path / "0.5" / "demos.json").read_text())
    assert noted["fingerprint"] == nht.load_demos(demos).fingerprint


@pytest.mark.parametrize("algorithm", ["ddpg", "td3"])
def test_a_run_may_imitate_them(algorithm: str, demos: Path, tmp_path: Path) -> None:
    plain = run(algorithm, tmp_path / "plain", *told(demos, 0.5))
    imitating = run(algorithm, tmp_path / "imitating", *told(demos, 0.5), "algo.demos.cloning=3")
    assert (imitating["loss_actor"] > plain["loss_actor"]).all()


@pytest.mark.parametrize("algorithm", tiny_runs.RECIPES)
def test_a_run_may_start_from_them(algorithm: str, demos: Path, tmp_path: Path) -> None:
    """A run of a few steps ends near what its actor started with."""
    data, distances = nht.load_demos(demos).data[:COUNT], []
    for updates in (1, 400):
        folder = tmp_path / str(updates)
        asked = [
            f"demos.path={demos}",
            f"algo.demos.transitions={COUNT}",
            f"algo.demos.cloning_start={updates}",
        ]
        short = ["algo.hidden=[32,32]", "algo.total_frames=100", "evaluation.every=100"]
        tiny_runs.start(algorithm, folder, *asked, *short)
        config = read_config(folder)
        policy = load_policy(folder, mapped_env(config.env, nht.Identity(7), seed=0, num_envs=1), config)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            action = policy(data.select("observation"))["action"]
        shown = demo_steps(config, nht.Identity(7))[0]["action"]
        distances.append(float((action - shown).square().mean()))
    assert distances[1] < 0.5 * distances[0]


def test_without_a_folder_the_expert_records_them_in_the_run(tmp_path: Path) -> None:
    asked = ["demos.transitions=300", "algo.demos.transitions=200", "map=nht", "map.max_steps=20"]
    recorded = run("ddpg", tmp_path / "recorded", *asked)
    kept = nht.load_demos(tmp_path / "recorded" / "demos")
    assert len(kept) >= 300
    map = nht.load_map(tmp_path / "recorded" / "map.safetensors")
    assert map.data_fingerprint == kept.fingerprint  # of the map, too
    given = run("ddpg", tmp_path / "given", *asked, f"demos.path={tmp_path / 'recorded' / 'demos'}")
    FRAME(recorded, given)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_stopped_it_goes_on_as_if_it_had_not_been(
    share: float, demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    longer = [*told(demos, share), "algo.total_frames=400", "algo.n_steps=2", *(CLONING if share else [])]
    whole = run("td3", tmp_path / "whole", *longer)
    with pytest.raises(KeyboardInterrupt), populations.breaking_off(monkeypatch, 300):
        run("td3", tmp_path / "stopped", *longer)
    FRAME(run("td3", tmp_path / "stopped", *longer, "run.resume=true"), whole)
    policies = [(tmp_path / name / "policy.safetensors").read_bytes() for name in ("whole", "stopped")]
    assert policies[0] == policies[1]


@pytest.mark.parametrize("share", [pytest.param(0.0, marks=pytest.mark.slow), 0.4])
def test_a_population_is_as_many_runs(
    share: float, demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each learner's demonstrations go through its own map."""
    learners = {}
    for seed, (name, own) in enumerate(populations.OWN["ddpg"].items()):
        file = populations.map_of(tmp_path / "maps", seed)
        more = [
            "map=nht",
            "map.residual=1.0",
            f"map.file={file}",
            "algo.updates_per_batch=10",
            "algo.n_steps=2",
        ]
        learners[name] = [*own, *more, *told(demos, share), *(CLONING if share else [])]
    with populations.watched(monkeypatch) as together:
        found = populations.train("ddpg", tmp_path / "together", learners)
    for learner, (name, own) in enumerate(learners.items()):
        with populations.watched(monkeypatch) as alone:
            expected = populations.train("ddpg", tmp_path / "alone", {name: own})[name]
        for loss, values in alone.items():
            torch.testing.assert_close(together[loss][:10, learner], values[:10], rtol=1e-5, atol=1e-5)
        FRAME(found[name], expected, rtol=1e-3, atol=1e-3)


def test_a_stopped_population_goes_on(demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    learners = {
        name: [*populations.OWN["ddpg"][name], *told(demos, 0.5), "algo.total_frames=300"] for name in "ab"
    }
    whole = populations.train("ddpg", tmp_path / "whole", learners)
    with pytest.raises(KeyboardInterrupt), populations.breaking_off(monkeypatch, 300):
        populations.train("ddpg", tmp_path / "stopped", learners)
    resumed = {name: [*own, "run.resume=true"] for name, own in learners.items()}
    found = populations.train("ddpg", tmp_path / "stopped", resumed)
    for name in learners:
        FRAME(found[name], whole[name])
