"""Weights and Biases: what a run leaves there, read back from the file of an offline run, and who is logged in."""

import json
import sys
from types import SimpleNamespace

import numpy as np
import pandas
import pytest
import yaml

import nht
import populations
import tiny_runs
import wandb_file
from nht.recipes.config import DDPG, RunConfig
from nht.recipes.launch import configure
from nht.recipes.run.artifacts import FileSet, valid_name
from nht.recipes.run.dashboard import Dashboard, logged_in, open_dashboard, wanted
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.record import Record

TINY = [
    "env.options.max_episode_steps=9",
    "algo.total_frames=400",
    "evaluation.every=200",
    "run.wandb=true",
    "run.wandb_group=together",
    "run.wandb_tags=[first,second]",
    "run.wandb_notes=a sentence",
]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "tracked"
    return folder, tiny_runs.train("ddpg", folder, *TINY)


def test_every_key_of_the_configuration_is_found_again(run):
    folder, _ = run
    config = wandb_file.read_run(folder).config
    settings = yaml.safe_load((folder / "config.yaml").read_text())
    assert {"recipe", "env", "map", "algo", "run"} <= set(settings)
    assert {name: config[name] for name in settings} == settings
    assert {"torch", "torchrl", "mujoco", "nht", "python"} <= set(config["provenance"]["versions"])
    assert config["provenance"]["command"].startswith("python ")
    assert set(config["provenance"]["git"]) == {"nht", "here"}


def test_a_run_stands_where_it_was_told_to(run):
    found = wandb_file.read_run(run[0]).run
    assert (found.display_name, found.run_group, found.job_type) == ("tracked", "together", "ddpg")
    assert (list(found.tags), found.notes) == (["first", "second"], "a sentence")


def test_tests_are_found_again(run):
    folder, metrics = run
    rows = [row for row in wandb_file.read_run(folder).rows if "eval/return" in row]
    assert [row["_step"] for row in rows] == metrics["frames"].tolist() == [200, 400]
    assert [row["env_steps"] for row in rows] == metrics["frames"].tolist()
    for outcome in ("success", "failure", "return"):
        assert [row[f"eval/{outcome}"] for row in rows] == metrics[f"eval_{outcome}"].tolist()
    assert [row["train/updates"] for row in rows] == metrics["updates"].tolist()


def test_losses_are_charted_between_tests_and_their_mean_is_that_of_the_table(run):
    folder, metrics = run
    found = wandb_file.read_run(folder)
    for name in ("loss_actor", "loss_value", "clipped"):
        column = found.column(f"train/{name}")
        assert list(column) == [100, 200, 300, 400]
        means = np.array(list(column.values())).reshape(2, 2).mean(1)  # of as many updates each
        np.testing.assert_allclose(means, metrics[name], rtol=1e-9)


def test_every_row_has_its_rates_and_gradients(run):
    found = wandb_file.read_run(run[0])
    for name in ("time/frames_per_second", "time/updates_per_second", "train/gradient_norm_actor"):
        assert list(found.column(name)) == [100, 200, 300, 400]
        assert all(value > 0 for value in found.column(name).values())
    seconds = list(found.column("time/seconds").values())
    assert seconds == sorted(seconds)
    sections = {name.split("/")[0] for row in found.rows for name in row if not name.startswith("_")}
    assert sections == {"env_steps", "eval", "train", "time"}


def test_environment_steps_are_the_axis_and_the_best_values_are_in_the_summary(run):
    folder, metrics = run
    found = wandb_file.read_run(folder)
    assert found.metrics["*"].step_metric == "env_steps"
    assert found.metrics["eval/success"].step_metric == "env_steps"
    assert found.metrics["eval/success"].summary.max
    assert found.metrics["eval/failure"].summary.min
    best = metrics["eval_return"].max()
    assert found.summary["best/return"] == found.summary["eval/return"]["max"] == best
    assert found.summary["best/return_at"] == metrics["frames"][metrics["eval_return"].idxmax()]
    assert found.summary["final/failure"] == metrics["eval_failure"].iloc[-1]


def test_map_and_policy_are_handed_on(run):
    folder, metrics = run
    found = wandb_file.read_run(folder)
    policy = found.artifacts[f"policy-{found.run.run_id}"]
    assert policy.type == "policy"
    is_best = metrics["eval_return"].iloc[-1] >= metrics["eval_return"].max()
    assert ("best" in policy.aliases) is bool(is_best)
    assert "latest" in policy.aliases
    assert json.loads(policy.metadata)["frames"] == 400
    map = found.artifacts["map-k7-identity"]
    assert (map.type, list(map.aliases), map.use_after_commit) == ("action-map", ["latest"], False)
    assert json.loads(map.metadata)["actuation_dim"] == 7


def test_a_run_that_is_resumed_stays_one_run_and_no_step_is_charted_twice(tmp_path, monkeypatch):
    whole = tiny_runs.train("ddpg", tmp_path / "whole", *TINY)
    folder = tmp_path / "run"
    told = [*TINY, "run.checkpoint_every=200"]
    with populations.breaking_off(monkeypatch, 400), pytest.raises(KeyboardInterrupt):
        tiny_runs.train("ddpg", folder, *told)  # when 300 steps are charted, and 200 saved
    again = tiny_runs.train("ddpg", folder, *told, "run.resume=true")
    pandas.testing.assert_frame_equal(again, whole)
    one, other = map(wandb_file.OfflineRun, wandb_file.files(folder))
    assert one.run.run_id == other.run.run_id == json.loads((folder / "wandb.json").read_text())["id"]
    assert (one.exit_code, other.exit_code) == (1, 0)
    reference = wandb_file.read_run(tmp_path / "whole")
    for name in ("train/loss_value", "train/gradient_norm_critic", "train/return", "eval/return"):
        assert one.column(name).keys() & other.column(name).keys() == set()
        assert one.column(name) | other.column(name) == reference.column(name)
    assert other.summary["best/return"] == whole["eval_return"].max()


def test_learners_of_a_population_are_a_run_each_in_one_group(tmp_path):
    folder = tmp_path / "seeds"
    tiny_runs.start("ppo", folder, *TINY[:-3], "run.wandb=true", "seeds=2")
    found = [wandb_file.read_run(folder / f"seed-{seed}") for seed in (0, 1)]
    assert {each.run.run_group for each in found} == {"seeds"}
    assert found[0].run.run_id != found[1].run.run_id
    for seed, each in enumerate(found):
        metrics = pandas.read_csv(folder / f"seed-{seed}" / "metrics.csv")
        assert list(each.column("eval/return").values()) == metrics["eval_return"].tolist()
        assert len(each.column("train/loss_critic")) == 4
        assert each.column("train/gradient_norm")[400] == metrics["gradient_norm"].iloc[-1]
    assert found[0].column("train/loss_critic") != found[1].column("train/loss_critic")


def test_charting_changes_no_number(run, tmp_path):
    folder, metrics = run
    plain = tiny_runs.train("ddpg", tmp_path / "plain", *TINY[:-4])
    pandas.testing.assert_frame_equal(plain, metrics)
    weights = [(path / "policy.safetensors").read_bytes() for path in (folder, tmp_path / "plain")]
    assert weights[0] == weights[1]


def test_a_run_takes_the_map_that_another_has_handed_on(tmp_path):
    file = populations.map_of(tmp_path, 0)
    map = nht.load_map(file)
    map.data_fingerprint = "0123456789abcdef"
    file = nht.save_map(map, tmp_path / "given.safetensors")
    told = ["map=nht", f"map.file={file}", *TINY]
    tiny_runs.train("ddpg", tmp_path / "run", *told)
    taken = wandb_file.read_run(tmp_path / "run").artifacts["map-k2-01234567"]
    assert taken.use_after_commit
    (content,) = taken.manifest.contents
    assert content.path == "map.safetensors"
    assert content.size == file.stat().st_size


@pytest.fixture
def nobody(tmp_path, monkeypatch):
    """A user without a key, in an empty home."""
    for name in ("WANDB_API_KEY", "WANDB_BASE_URL", "NETRC", "WANDB_MODE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def test_a_key_in_the_environment_is_a_login_and_an_empty_one_is_none(nobody, monkeypatch):
    assert not logged_in()
    monkeypatch.setenv("WANDB_API_KEY", "")
    assert not logged_in()
    monkeypatch.setenv("WANDB_API_KEY", "0" * 40)
    assert logged_in()


@pytest.mark.parametrize(
    ("text", "server", "found"),
    [
        ("machine api.wandb.ai login user password key\n", None, True),
        ("machine api.wandb.ai login user password key\n", "", True),
        ("machine elsewhere.example login user password key\n", None, False),
        ("default login user password key\n", None, False),
        ("machine wandb.lab.example login user password key\n", "https://wandb.lab.example:8080/", True),
        ("machine api.wandb.ai login user password key\n", "https://wandb.lab.example", False),
        ("this is no netrc", None, False),
    ],
)
def test_a_login_is_one_for_the_server_in_use(nobody, monkeypatch, text, server, found):
    if server is not None:
        monkeypatch.setenv("WANDB_BASE_URL", server)
    (nobody / ".netrc").write_text(text)
    (nobody / ".netrc").chmod(0o600)
    assert logged_in() is found
    (nobody / ".netrc").rename(nobody / "keys")
    assert not logged_in()
    monkeypatch.setenv("NETRC", str(nobody / "keys"))
    assert logged_in() is found


def test_disabled_writes_nothing(nobody, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "disabled")
    assert not wanted(RunConfig())
    assert open_dashboard(nobody, {}, RunConfig()) is None
    assert list(nobody.iterdir()) == []


@pytest.mark.parametrize("name", ["run", "lr=0.1, é (1)", "x" * 200])
def test_an_empty_key_does_not_stop_a_run_whatever_its_folders_name(nobody, monkeypatch, name):
    nobody = nobody / name
    nobody.mkdir()
    monkeypatch.setenv("WANDB_API_KEY", "")
    dashboard = open_dashboard(nobody, {"seed": 3}, RunConfig())
    dashboard.log(10, {"eval_return": 1.0})
    (nobody / "map.safetensors").write_bytes(b"map")
    dashboard.add(FileSet(valid_name(f"map-{name}"), "action-map", {"map": nobody / "map.safetensors"}))
    dashboard.finish()
    found = wandb_file.read_run(nobody)
    assert found.config["seed"] == 3
    assert found.rows[0]["eval/return"] == 1.0
    assert len(found.artifacts) == 1


def test_a_run_does_not_write_into_one_that_this_process_has_left_open(nobody):
    folders = [nobody / "first", nobody / "second"]
    dashboards = []
    for number, folder in enumerate(folders):
        folder.mkdir()
        dashboards.append(open_dashboard(folder, {"seed": number}, RunConfig()))
        dashboards[-1].log(10, {"eval_return": float(number)})
    for dashboard in dashboards:
        dashboard.leave()
    for number, folder in enumerate(folders):
        found = wandb_file.read_run(folder)
        assert found.config["seed"] == number
        assert found.column("eval/return") == {10: number}


def test_a_run_that_fails_is_closed_as_failed(tmp_path, monkeypatch):
    monkeypatch.setattr(Record, "count_steps", lambda self, data: 1 / 0)
    folder = tmp_path / "run"
    with pytest.raises(ZeroDivisionError):
        tiny_runs.train("ddpg", folder, *TINY)
    assert wandb_file.read_run(folder).exit_code == 1


def test_an_unknown_mode_is_told_in_a_sentence(nobody, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "sometimes")
    with pytest.raises(RuntimeError, match=r"W&B does not start: .*sometimes.*run\.wandb=false"):
        open_dashboard(nobody, {}, RunConfig())


def test_without_wandb_a_run_that_wants_it_says_so_before_anything_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", None)
    folder = tmp_path / "run"
    told = tiny_runs.settings("ddpg", folder, *TINY)
    with pytest.raises(
        ImportError, match=r"needs wandb: pip install 'nht\[recipes\]', or set run.wandb=false"
    ):
        RunFolder(configure(DDPG, "ddpg", told), Ranks())
    assert not folder.exists()
    RunFolder(configure(DDPG, "ddpg", [*told, "run.wandb=false"]), Ranks()).close()


class Online:
    """What a dashboard asks of a run that is online, and of the server, which knows the best version."""

    offline, entity, project = False, "somebody", "nht"

    def __init__(self, best):
        self.best, self.asked, self.logged = best, [], []

    Error = type("Error", (Exception,), {})

    def Api(self):  # noqa: N802 - W&B's name
        return self

    def artifact(self, name, type):
        self.asked.append((name, type))
        if self.best is None:
            raise ValueError("artifact not found")
        return SimpleNamespace(metadata={"validation_error": self.best})

    def Artifact(self, name, type, metadata):  # noqa: N802
        return SimpleNamespace(name=name, add_file=lambda file, name: None)

    def log_artifact(self, artifact, aliases):
        self.logged.append((artifact.name, aliases))


@pytest.mark.parametrize(
    ("best", "error", "aliases"),
    [
        (None, 0.5, ["best", "latest"]),
        (0.4, 0.5, ["latest"]),
        (0.6, 0.5, ["best", "latest"]),
        (0.6, None, ["latest"]),
    ],
)
def test_online_the_best_map_of_all_is_the_best(tmp_path, best, error, aliases):
    online = Online(best)
    dashboard = object.__new__(Dashboard)
    dashboard._run = dashboard._wandb = online
    facts = {} if error is None else {"validation_error": error}
    dashboard.add(FileSet("map-k2-01234567", "action-map", {}, facts))
    assert online.logged == [("map-k2-01234567", aliases)]
    if error is not None:
        assert online.asked == [("somebody/nht/map-k2-01234567:best", "action-map")]
