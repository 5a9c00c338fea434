"""Demonstrations that a run learns from: what is stored of them, and what is refused."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

import nht
import populations
import tiny_runs
from nht.recipes.agents.replay import storable
from nht.recipes.agents.returns import charge_failure, n_step_returns
from nht.recipes.agents.table import find_algorithm
from nht.recipes.data.recording import record_expert
from nht.recipes.launch import configure
from nht.recipes.run.demonstrations import demo_steps, demonstrated
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.memory import replay_bytes
from nht.recipes.run.ranks import Ranks
from nht.recipes.sections import DemosConfig, EnvConfig

COUNT = 250


@pytest.fixture(scope="module")
def demos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demos") / "wipe"
    record_expert(EnvConfig(), DemosConfig(transitions=600), 0, folder)
    return folder


def told(demos: Path, share: float = 0.0, count: int = COUNT) -> list[str]:
    return [f"demos.path={demos}", f"algo.demos.transitions={count}", f"algo.demos.share={share}"]


def run(algorithm: str, folder: Path, *overrides: str) -> None:
    tiny_runs.start(algorithm, folder, "algo.total_frames=200", "evaluation.every=100", *overrides)


def config(demos: Path, *overrides: str) -> Any:
    words = tiny_runs.settings("ddpg", demos.parent / "unused", *told(demos), *overrides)
    return configure(find_algorithm("ddpg").schema, "ddpg", words)


def context_of(demos: Path, map: nht.ActionMap) -> torch.Tensor:
    return nht.load_demos(demos).context(map.context_keys or ())[:COUNT]


# What is stored.


@pytest.mark.parametrize("kind", ["nht", "svd", "scl", "laser", "jacobian", "none"])
def test_stored_actions_stand_for_what_the_map_can_express(kind: str, demos: Path) -> None:
    data = nht.load_demos(demos)
    keys = ["joint_angle"] if kind == "jacobian" else ["tool_position", "joint_angle"]
    settings = config(demos, f"map={kind}")
    untrained = nht.recipes.maps.kinds.make_map(
        settings.map, data.context(keys).shape[-1], 7, 0, settings.env
    )
    map = nht.train_map(data, untrained, context_keys=keys, max_steps=60, seed=0).map
    steps, measured = demo_steps(settings, map)
    context, actuation = context_of(demos, map), data.actuation[:COUNT]
    with torch.no_grad():
        free = map.encode(actuation, context)
        inside = (free.abs() <= 1).all(-1)
        expressed = map(map.project(actuation, context), context)
        decoded = map.decode(steps["action"], context)
        torch.testing.assert_close(decoded[inside], expressed[inside], rtol=1e-4, atol=1e-5)
    assert inside.any()
    assert steps["action"].abs().max() <= 1.0
    assert measured["demos_clipped"] == pytest.approx(float((free.abs() > 1).float().mean()))
    if kind == "none":
        torch.testing.assert_close(decoded, actuation)
        assert measured["demos_missed"] == pytest.approx(0.0, abs=1e-10)


def test_large_corrections_express_everything_and_small_ones_are_clipped(demos: Path, tmp_path: Path) -> None:
    map = nht.load_map(populations.map_of(tmp_path, 0))
    settings = config(demos)
    missed = [
        demo_steps(settings, each)[1] for each in (map, *(nht.Residual(map, size) for size in (0.01, 2.0)))
    ]
    assert missed[2]["demos_missed"] == pytest.approx(0.0, abs=1e-9)
    assert missed[2]["demos_clipped"] == 0.0
    assert missed[1]["demos_clipped"] > 0.1
    assert 0.1 < missed[1]["demos_missed"] < missed[0]["demos_missed"] <= 1.0


def test_steps_are_those_that_were_recorded(demos: Path) -> None:
    data = nht.load_demos(demos).data[:COUNT]
    steps = demonstrated([config(demos)], [nht.Identity(7)])
    assert steps is not None
    assert steps.shape == (1, COUNT)
    for name in ("observation", "reward", "terminated"):
        place = "observation" if name == "observation" else ("next", name)
        assert steps[0][place].equal(data[name])
    assert steps[0]["next", "observation"].equal(data["next", "observation"])
    last = torch.cat([data["episode"][1:] != data["episode"][:-1], torch.tensor([True])])
    assert steps[0]["next", "done"].squeeze(-1).equal(last)
    assert not steps["next", "failure"].any()  # good episodes end in success


def test_targets_look_ahead_within_an_episode(demos: Path) -> None:
    gamma, ahead = 0.9, 3
    data = nht.load_demos(demos).data[:COUNT]
    steps = demonstrated([config(demos)], [nht.Identity(7)])
    assert steps is not None
    rows = storable(n_step_returns(gamma, ahead)(charge_failure(steps, gamma, (-1.0, 0.0))))
    assert len(rows) == COUNT
    ends = [
        step
        for step in range(COUNT)
        if step == COUNT - 1 or data["episode"][step] != data["episode"][step + 1]
    ]
    for step in range(COUNT):
        last = min(step + ahead - 1, *(end for end in ends if end >= step))
        rewards = data["reward"][step : last + 1, 0]
        expected = (rewards * gamma ** torch.arange(len(rewards))).sum()
        torch.testing.assert_close(rows["next", "reward"][step, 0], expected)
        assert int(rows["steps_to_next_obs"][step]) == last + 1 - step
        assert rows["next", "observation"][step].equal(data["next", "observation"][last])
        assert bool(rows["next", "terminated"][step]) == bool(data["terminated"][last])


def test_they_are_part_of_the_memory_that_learners_need(demos: Path) -> None:
    without = replay_bytes(config(demos, "algo.demos.transitions=0"))
    steps = 1_000  # of tiny_runs's buffer
    assert replay_bytes(config(demos)) == pytest.approx(without * (steps + COUNT) / steps)


# Bad input. Nothing is trained, and nothing is left behind.


def altered(demos: Path, folder: Path, change: Any, env: str = "wam_wipe") -> Path:
    data = nht.load_demos(demos).data.clone()
    nht.save_demos(change(data), folder, env=env)
    return folder


def refused(demos: Path, folder: Path, error: type[Exception], message: str, *overrides: str) -> None:
    with pytest.raises(error, match=message):
        run("ddpg", folder, *told(demos, 0.5), *overrides)
    assert not folder.exists()


@pytest.mark.parametrize("key", ["reward", "observation", "terminated", "next/observation"])
def test_demonstrations_that_lack_something(key: str, demos: Path, tmp_path: Path) -> None:
    path = tuple(key.split("/"))
    lacking = altered(demos, tmp_path / "demos", lambda data: data.exclude(path if len(path) > 1 else key))
    message = rf"lacks \['{key}'\], which algo.demos needs: it has 'actuation', "
    refused(lacking, tmp_path / "run", KeyError, message, "map=nht")


@pytest.mark.parametrize(
    ("key", "message"),
    [
        ("observation", "does not fit wam_wipe: 'observation' has 17 entries, the task's 16."),
        ("actuation", "does not fit wam_wipe: 'actuation' has 8 entries, the task's 7."),
    ],
)
def test_demonstrations_of_other_widths(key: str, message: str, demos: Path, tmp_path: Path) -> None:
    def widen(data: Any) -> Any:
        return data.set(key, torch.cat([data[key], data[key][:, :1]], dim=-1))

    refused(altered(demos, tmp_path / "demos", widen), tmp_path / "run", ValueError, message)


def test_demonstrations_of_another_task(demos: Path, tmp_path: Path) -> None:
    other = altered(demos, tmp_path / "demos", lambda data: data, env="wam_grasp")
    refused(other, tmp_path / "run", ValueError, "demonstrations of env 'wam_grasp', expected 'wam_wipe'")


def test_rewards_of_another_scale(demos: Path, tmp_path: Path) -> None:
    larger = altered(demos, tmp_path / "demos", lambda data: data.set("reward", 10 * data["reward"] + 1))
    message = r"has rewards from -9 to 1, those of wam_wipe lie in \[-1, 0\]."
    refused(larger, tmp_path / "run", ValueError, message)


def test_more_than_there_are(demos: Path, tmp_path: Path) -> None:
    message = r"algo.demos.transitions=5000 must be at most the \d+ of "
    refused(demos, tmp_path / "run", ValueError, message, "algo.demos.transitions=5000")
    message = "algo.demos.transitions=5000 must be at most demos.transitions=600, which the expert records."
    asked = ["demos.path=null", "demos.transitions=600", "algo.demos.transitions=5000"]
    refused(demos, tmp_path / "run", ValueError, message, *asked)


def test_a_task_without_an_expert(demos: Path, tmp_path: Path) -> None:
    asked = ["env=hopper", "env.options={}", "demos.path=null"]
    refused(demos, tmp_path / "run", ValueError, "expert", *asked)


def test_a_map_that_expresses_little_is_warned_about(demos: Path, tmp_path: Path) -> None:
    told_map = ["map=nht", f"map.file={populations.map_of(tmp_path / 'maps', 0)}"]
    with pytest.warns(
        UserWarning, match=r"miss \d+\.\d% of the demonstrated actuations' energy, and 0.0% of"
    ):
        run("ddpg", tmp_path / "run", *told(demos, 0.5), *told_map)
    with pytest.warns(
        UserWarning, match=r"energy, and [1-9]\d\.\d% of their numbers are clipped to \[-1, 1\]"
    ):
        run("ddpg", tmp_path / "small", *told(demos, 0.5), *told_map, "map.residual=0.01")


def test_a_map_that_expresses_nothing_is_refused(demos: Path, tmp_path: Path) -> None:
    lost = populations.Lost(10, 7, 2)
    lost.context_keys = ("tool_position", "joint_angle")
    file = populations.nht.save_map(lost, tmp_path / "lost.safetensors")
    told_map = ["map.kind=populations:Lost", f"map.file={file}", "map.allow=[populations]"]
    message = "the map cannot express the demonstrations: the actions for .* miss nan%"
    refused(demos, tmp_path / "run", ValueError, message, *told_map)


def test_demonstrations_that_were_changed_since(
    demos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mine = tmp_path / "demos"
    shutil.copytree(demos, mine)
    with pytest.raises(KeyboardInterrupt), populations.breaking_off(monkeypatch, 200):
        run("ddpg", tmp_path / "run", *told(mine, 0.5), "run.checkpoint_every=100")
    shutil.rmtree(mine)
    altered(demos, mine, lambda data: data.set("reward", 0.5 * data["reward"]))
    with pytest.raises(ValueError, match=r"no longer holds the demonstrations that the run began with."):
        run("ddpg", tmp_path / "run", *told(mine, 0.5), "run.checkpoint_every=100", "run.resume=true")


def test_recorded_ones_replace_no_others(demos: Path, tmp_path: Path) -> None:
    shutil.copytree(demos, tmp_path / "run" / "demos")
    with pytest.raises(FileExistsError, match="demonstrations are never overwritten"):
        run("ddpg", tmp_path / "run", "demos.transitions=300", "algo.demos.transitions=200")
    assert nht.load_demos(tmp_path / "run" / "demos").fingerprint == nht.load_demos(demos).fingerprint


def test_learners_share_how_many_they_learn_from(demos: Path, tmp_path: Path) -> None:
    learners = {"a": ["seed=1", *told(demos, 0.5)], "b": ["seed=2", *told(demos, 0.25)]}
    with pytest.raises(ValueError, match=r"learners of one population share algo.demos: it is "):
        populations.train("ddpg", tmp_path, learners)


def test_an_algorithm_without_replay(demos: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Key 'share' not in 'StartDemosConfig'"):
        run("ppo", tmp_path / "run", *told(demos))
    asked = [f"demos.path={demos}", f"algo.demos.transitions={COUNT}"]
    with pytest.raises(
        ValueError, match=f"with algo.demos.transitions={COUNT}, set algo.demos.cloning_start"
    ):
        run("ppo", tmp_path / "run", *asked)


def test_the_folder_of_a_run_refuses_before_a_map_is_trained(demos: Path, tmp_path: Path) -> None:
    def never(*_: Any) -> Any:
        raise AssertionError("a map was trained")

    settings = config(
        demos, "algo.demos.transitions=5000", f"run.folder={tmp_path / 'run'}", "algo.buffer_size=9000"
    )
    with pytest.raises(ValueError, match="must be at most the"):
        RunFolder(settings, Ranks(), never)
