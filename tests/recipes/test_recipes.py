"""The recipes end to end, a few steps each: what they write, that seeds act, that resuming changes nothing."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import imageio.v3 as iio
import pandas
import pytest
import torch

import nht
import wandb_file
from nht.lipschitz import LipschitzProjection
from nht.recipes import collect_demos, ddpg, evaluate, report, train_map
from nht.recipes.config import DDPG, CollectDemos, Evaluate, Report, TrainMap
from nht.recipes.launch import configure
from nht.recipes.maps.interface import map_from_file
from nht.recipes.maps.kinds import make_map, map_context_keys
from nht.recipes.sections import MapConfig
from nht.recipes.study.curves import summarise
from nht.recipes.study.scores import interquartile_mean, interval

TINY = [
    "algo.total_frames=2000",
    "algo.frames_per_batch=200",
    "algo.updates_per_batch=5",
    "algo.warmup_frames=400",
    "algo.hidden=[16,16]",
    "algo.buffer_size=3000",
    "evaluation.every=1000",
    "evaluation.episodes=4",
    "evaluation.video=false",
    "run.checkpoint_every=1000",
    "run.wandb=false",
]

PLAIN = ["run.wandb=false", "video=false"]


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "wam_wipe"
    collect_demos.main(
        configure(CollectDemos, "collect_demos", ["demos.transitions=2000", f"out={path}", "seed=5"])
    )
    return path


@pytest.fixture(scope="module")
def map_file(demos, tmp_path_factory):
    path = tmp_path_factory.mktemp("map") / "nht.safetensors"
    overrides = [f"demos.path={demos}", f"out={path}", "map.max_steps=500", "map.hidden=[32]"]
    train_map.main(configure(TrainMap, "train_map", ["run.wandb=false", *overrides, "run.wandb=false"]))
    return path


def train(folder: Path, map_file: Path, *overrides: str) -> pandas.DataFrame:
    ddpg.main(configure(DDPG, "ddpg", [*TINY, f"map.file={map_file}", f"run.folder={folder}", *overrides]))
    return pandas.read_csv(folder / "metrics.csv").drop(columns="seconds")


@pytest.fixture(scope="module")
def run(map_file, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "nht-seed0"
    return folder, train(folder, map_file)


def test_demonstrations_are_whole_successful_episodes(demos):
    found = nht.load_demos(demos, env="wam_wipe")
    assert len(found) >= 2000
    last = torch.cat([found.episode[1:] != found.episode[:-1], torch.ones(1, dtype=torch.bool)])
    assert found.data["success"].squeeze(-1).equal(last)
    assert found.manifest["seed"] == 5
    assert found.manifest["expert"] == "WipeExpert"
    # What follows a step is what the next one starts from, within an episode.
    following, start = found.data["next", "joint_angle"][:-1], found.data["joint_angle"][1:]
    assert following[~last[:-1]].equal(start[~last[:-1]])


def test_the_map_file_says_what_it_was_trained_on(map_file, demos):
    map = nht.load_map(map_file)
    assert isinstance(map, nht.NHT)
    assert map.context_keys == ("tool_position", "joint_angle")
    assert map.data_fingerprint == nht.load_demos(demos).fingerprint


def test_a_run_leaves_everything_in_its_folder(run):
    folder, metrics = run
    present = {entry.name for entry in folder.iterdir()}
    assert {"config.yaml", "metrics.csv", "map.safetensors", "policy.safetensors", "checkpoints"} <= present
    assert metrics["frames"].tolist() == [1000, 2000]
    assert metrics["updates"].tolist() == [20, 45]
    assert metrics[["loss_actor", "loss_value", "eval_return"]].notna().all(axis=None)
    assert metrics["eval_return"].between(-200, 0).all()


def test_the_same_seed_gives_the_same_run_and_another_a_different_one(run, map_file, tmp_path):
    _, metrics = run
    pandas.testing.assert_frame_equal(train(tmp_path / "same", map_file), metrics)
    assert not train(tmp_path / "other", map_file, "seed=1")["loss_value"].equals(metrics["loss_value"])


def test_stopping_and_resuming_equals_going_on(run, map_file, tmp_path):
    folder, metrics = run
    resumed = tmp_path / "resumed"
    train(resumed, map_file, "algo.total_frames=1000")
    found = train(resumed, map_file, "run.resume=true")
    pandas.testing.assert_frame_equal(found, metrics)
    assert (resumed / "policy.safetensors").read_bytes() == (folder / "policy.safetensors").read_bytes()


@pytest.mark.parametrize("kind", ["scl", "laser", "cae", "svd", "jacobian", "none"])
def test_other_interfaces_run_from_the_demonstrations(kind, demos, tmp_path):
    overrides = [
        *TINY,
        f"map={kind}",
        f"demos.path={demos}",
        f"run.folder={tmp_path}",
        "algo.total_frames=1000",
        "map.max_steps=250",
        "map.hidden=[16]",
    ]
    ddpg.main(configure(DDPG, "ddpg", overrides))
    policy_size = {"none": 7, "jacobian": 6}.get(kind, 2)
    assert nht.load_map(tmp_path / "map.safetensors").action_dim == policy_size


def test_the_papers_settings_run(map_file, tmp_path):
    metrics = train(tmp_path / "run", map_file, "algo=ddpg_paper", "algo.updates_per_batch=45")
    assert metrics["updates"].tolist() == [4 * 45, 9 * 45]
    assert metrics["loss_value"].notna().all()


def test_any_map_can_have_corrections(demos, map_file, tmp_path):
    overrides = ["map=svd", "map.residual=0.1", f"demos.path={demos}", f"out={tmp_path / 'svd'}"]
    train_map.main(configure(TrainMap, "train_map", ["run.wandb=false", *overrides, "run.wandb=false"]))
    saved = map_from_file(MapConfig("svd", str(tmp_path / "svd"), residual=0.1))
    assert (saved.action_dim, saved.scale) == (9, 0.1)
    train(tmp_path / "run", map_file, "map.residual=0.2", "algo.total_frames=1000")  # around a map without
    used = nht.load_map(tmp_path / "run" / "map.safetensors")
    assert (type(used), used.scale, type(used.map)) == (nht.Residual, 0.2, nht.NHT)
    with pytest.raises(ValueError, match=r"a map with residual 0\.1, but map\.residual is None"):
        map_from_file(MapConfig("svd", str(tmp_path / "svd")))
    with pytest.raises(ValueError, match=r"holds a SVD, but map\.kind is 'nht'"):
        map_from_file(MapConfig("nht", str(tmp_path / "svd"), residual=0.1))
    with pytest.raises(
        ValueError, match=r"map\.residual must be positive, or null for no corrections, got -1\.0"
    ):
        configure(TrainMap, "train_map", ["map.residual=-1"])


def test_wandb_works_offline_and_gets_video_and_map(map_file, tmp_path, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "offline")
    overrides = ["run.wandb=true", "evaluation.video=true", "algo.total_frames=1000"]
    train(tmp_path / "run", map_file, *overrides, "env.options.max_episode_steps=10")
    assert list((tmp_path / "run").rglob("*.wandb"))
    frames = iio.imread(tmp_path / "run" / "video.mp4")
    assert frames.shape[0] == 6  # the start and every second of 10 steps
    assert frames.std() > 10  # something is in the picture


def test_evaluate_repeats_itself_and_films(run, tmp_path, capsys):
    folder, _ = run
    copied = tmp_path / "run"
    shutil.copytree(folder, copied)
    config = configure(Evaluate, "evaluate", [f"run={copied}", "episodes=4", "video=false"])
    evaluate.main(config)
    first = capsys.readouterr().out
    evaluate.main(config)
    assert capsys.readouterr().out == first
    assert "eval_success" in first
    evaluate.main(replace(config, video=True, video_episodes=2, env_options={"max_episode_steps": 5}))
    assert len(iio.imread(copied / "evaluation.mp4")) == 4  # the start, every second of 5 steps, and the end


def test_report_compares_the_runs_below_a_folder(run, map_file, tmp_path):
    folder, metrics = run
    shutil.copytree(folder, tmp_path / "runs" / "first")
    train(tmp_path / "runs" / "second", map_file, "seed=1")
    out = tmp_path / "report"
    report.main(
        configure(
            Report,
            "report",
            [
                "run.wandb=false",
                "video=false",
                f"runs=[{tmp_path / 'runs'}]",
                f"out={out}",
                "title=Two seeds",
            ],
        )
    )
    curves = pandas.read_csv(out / "curves.csv")
    assert sorted(curves["seed"].unique()) == [0, 1]
    assert curves[curves["seed"] == 0]["eval_success"].tolist() == metrics["eval_success"].tolist()
    assert "| nht | 2 | 2000 |" in (out / "table.md").read_text()
    assert iio.imread(out / "success.png").ndim == 3


def test_report_stops_where_a_seed_does():
    rows = [(0, 10, 0.2), (0, 20, 0.4), (0, 30, 1.0), (1, 10, 0.4), (1, 20, 0.6)]
    curves = pandas.DataFrame(rows, columns=["seed", "frames", "eval_success"])
    curves = curves.assign(interface="nht", eval_failure=0.0, eval_return=0.0, seconds=60.0)
    (row,) = summarise(curves).to_dict("records")
    assert (row["seeds"], row["steps"], row["success"]) == (2, 20, "0.500")
    assert row["steps to 0.9"] == "1 of 2 seeds"


def test_report_of_returns(run, tmp_path):
    folder, metrics = run
    out = tmp_path / "report"
    report.main(
        configure(
            Report,
            "report",
            [*PLAIN, f"runs=[{folder}]", f"out={out}", "metric=return"],
        )
    )
    last = f"{metrics['eval_return'].iloc[-1]:,.0f}"
    assert f"| nht | 1 | 2000 | {last} | {last} .. {last} | {last} |" in (out / "return-table.md").read_text()
    assert iio.imread(out / "return.png").ndim == 3
    with pytest.raises(ValueError, match="metric must be success or return, got 'reward'"):
        Report(metric="reward")


def test_report_interval_is_seeded_and_covers_the_mean():
    scores = torch.tensor([0.2, 0.4, 0.9, 0.95, 1.0], dtype=torch.float64).numpy()
    low, high = interval(scores)
    assert low < scores.mean() < high
    assert interval(scores) == (low, high)
    assert interval(scores[:1]) == (0.2, 0.2)


def test_interquartile_mean_leaves_out_the_best_and_the_worst_quarter():
    scores = torch.tensor([-100.0, 1.0, 2.0, 6.0, 1000.0], dtype=torch.float64).numpy()
    assert interquartile_mean(scores) == 3.0
    low, high = interval(scores, interquartile_mean)
    assert -100.0 < low < 3.0 < high < 1000.0


# Bad input.


@pytest.mark.parametrize("override", ["seed=1", "algo.total_frames=4000"])
def test_a_run_is_never_overwritten(run, map_file, override):
    folder, metrics = run
    pandas.testing.assert_frame_equal(train(folder, map_file), metrics)  # it is whole, and says so
    with pytest.raises(FileExistsError, match=r"holds a run already: go on with run.resume=true"):
        train(folder, map_file, override)
    pandas.testing.assert_frame_equal(
        pandas.read_csv(folder / "metrics.csv").drop(columns="seconds"), metrics
    )


def test_nothing_to_resume(map_file, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no run to resume"):
        train(tmp_path / "nothing", map_file, "run.resume=true")


def test_demonstrations_and_maps_are_never_overwritten(demos, map_file):
    with pytest.raises(FileExistsError, match=r"never overwritten"):
        collect_demos.main(configure(CollectDemos, "collect_demos", [f"out={demos}"]))
    with pytest.raises(FileExistsError, match=r"never overwritten"):
        train_map.main(
            configure(TrainMap, "train_map", ["run.wandb=false", f"demos.path={demos}", f"out={map_file}"])
        )


def test_a_context_key_that_the_environment_lacks(map_file, tmp_path):
    with pytest.raises(ValueError, match=r"trained on .*joint_angle.*, env.context_keys are .*elbow"):
        train(tmp_path / "run", map_file, "env.context_keys=[tool_position,elbow]")
    assert not (tmp_path / "run").exists()


def test_a_map_for_another_robot(tmp_path):
    other = nht.NHT(10, 6, 2, hidden=(8,))
    other.context_keys = ("tool_position", "joint_angle")
    path = nht.save_map(other, tmp_path / "other.safetensors")
    with pytest.raises(ValueError, match=r"6.*7|7.*6"):
        train(tmp_path / "run", path)


def test_a_map_of_another_kind(map_file, tmp_path):
    with pytest.raises(ValueError, match=r"holds a NHT, but map.kind is 'svd'"):
        train(tmp_path / "run", map_file, "map=svd")


def test_demonstrations_of_another_env(demos, tmp_path):
    found = nht.load_demos(demos)
    nht.save_demos(found.data, tmp_path / "demos", env="cheetah", seed=0, expert="unknown")
    with pytest.raises(ValueError, match=r"of env 'cheetah', expected 'wam_wipe'"):
        train_map.main(
            configure(
                TrainMap, "train_map", ["run.wandb=false", f"demos.path={tmp_path / 'demos'}", "out=unused"]
            )
        )


def test_a_jacobian_without_an_arm():
    config = configure(TrainMap, "train_map", ["map=jacobian", "out=unused"])
    wide = replace(config.env, context_keys=["tool_position", "joint_angle"])
    assert map_context_keys(config.map, wide) == ["joint_angle"]  # whatever the task says
    cheetah = replace(config.env, name="half_cheetah")
    with pytest.raises(
        ValueError, match=r"kinematics: \['wam_grasp', 'wam_wipe'\] are, 'half_cheetah' is not"
    ):
        make_map(config.map, 17, 6, 0, cheetah)


def test_heads_for_a_map_that_has_none():
    config = configure(TrainMap, "train_map", ["map=scl", "map.multi_head=true", "out=unused"])
    with pytest.raises(ValueError, match=r"map.multi_head is an option of nht, not of 'scl'"):
        make_map(config.map, 10, 7, seed=0)


def test_heads_reach_the_map():
    config = configure(TrainMap, "train_map", ["map=nht", "map.multi_head=true", "out=unused"])
    assert make_map(config.map, 10, 7, seed=0).init_args()["multi_head"] is True


def test_a_lipschitz_limit_for_a_map_that_has_none():
    config = configure(TrainMap, "train_map", ["map=laser", "map.lipschitz=2", "out=unused"])
    with pytest.raises(ValueError, match=r"map.lipschitz is an option of nht and scl, not of 'laser'"):
        make_map(config.map, 10, 7, 0)


@pytest.mark.parametrize(("kind", "gain"), [("nht", 2 * 3**0.5), ("scl", 1.0)])
def test_a_lipschitz_limit_of_every_layer(kind, gain):
    told = [f"map={kind}", "map.action_dim=3", "map.hidden=[16,16]", "map.lipschitz=0.5", "out=unused"]
    whole = configure(TrainMap, "train_map", told)
    each = configure(TrainMap, "train_map", [*told, "map.lipschitz_per_layer=true"])
    assert make_map(whole.map, 10, 7, seed=0).init_args()["lipschitz"] == 0.5
    map = make_map(each.map, 10, 7, seed=0)
    assert map.init_args()["lipschitz"] == pytest.approx(gain * 0.5**3)  # two hidden layers and the last
    assert LipschitzProjection(map).limits == pytest.approx([0.5] * 3, rel=1e-5)  # tanh is no steeper than 1


def test_an_unknown_option_of_the_task(tmp_path):
    config = configure(CollectDemos, "collect_demos", [f"out={tmp_path / 'demos'}"])
    wrong = replace(config, env=replace(config.env, options={"startt": "fixed"}))
    with pytest.raises(ValueError, match=r"unexpected keyword argument 'startt'.*'start'"):
        collect_demos.main(wrong)
    assert not list(tmp_path.iterdir())


def test_evaluating_what_is_no_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"holds no run: it has no config.yaml"):
        evaluate.main(configure(Evaluate, "evaluate", [f"run={tmp_path}"]))


def test_reporting_where_there_is_no_run(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no metrics.csv in or below"):
        report.main(
            configure(
                Report,
                "report",
                [*PLAIN, f"runs=[{tmp_path}]", f"out={tmp_path / 'out'}"],
            )
        )


def test_the_training_of_a_map_stands_on_the_dashboard_with_what_it_was_made_from(demos, tmp_path):
    out = tmp_path / "maps" / "small.safetensors"
    told = [f"demos.path={demos}", f"out={out}", "map.max_steps=600", "map.hidden=[8]", "seed=2"]
    train_map.main(configure(TrainMap, "train_map", told))
    found = wandb_file.read_run(out.parent)
    assert (found.run.display_name, found.run.job_type, found.exit_code) == ("small", "train_map", 0)
    assert found.config["map"]["max_steps"] == 600
    errors = [row["map/validation_error"] for row in found.rows if "map/validation_error" in row]
    assert len(errors) > 1
    assert found.metrics["map/*"].step_metric == "map_steps"
    fingerprint = nht.load_demos(demos).fingerprint[:8]
    demonstrations = found.artifacts[f"demos-wam_wipe-{fingerprint}"]
    map = found.artifacts[f"map-k2-{fingerprint}"]
    assert (demonstrations.type, demonstrations.use_after_commit) == ("demonstrations", True)
    assert (map.type, map.use_after_commit) == ("action-map", False)
    metadata = json.loads(map.metadata)
    assert metadata["class"] == "NHT"
    assert metadata["validation_error"] == found.summary["map/validation_error"]
    assert [content.path for content in demonstrations.manifest.contents] == ["manifest.json"]


def test_a_training_of_a_map_that_fails_is_closed_as_failed(demos, tmp_path, monkeypatch):
    monkeypatch.setattr(train_map, "trained_map", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        train_map.main(configure(TrainMap, "train_map", [f"demos.path={demos}", f"out={tmp_path / 'map'}"]))
    assert wandb_file.read_run(tmp_path).exit_code == 1
