"""Weights and Biases: what a run leaves there, read back from the file of an offline run, and who is logged in."""

import json
import struct
import sys
import time

import pytest
import yaml

import tiny_runs
from nht.recipes.config import DDPG, RunConfig
from nht.recipes.launch import configure
from nht.recipes.run.dashboard import logged_in, open_dashboard, wanted
from nht.recipes.run.folder import RunFolder
from nht.recipes.run.ranks import Ranks
from nht.recipes.run.record import Record

TINY = [
    "env.options.max_episode_steps=9",
    "algo.total_frames=200",
    "evaluation.every=100",
    "run.wandb=true",
    "run.wandb_group=together",
]
BLOCK, HEADER, ENDS = 32_768, 7, (1, 4)
"""A LevelDB log: blocks of records, each with check sum, length and whether it is whole or the last of several."""


def records(file):
    """The records of a ``.wandb`` file."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, at, parts = file.read_bytes(), HEADER, b""
    while at + HEADER <= len(data):
        if (left := BLOCK - at % BLOCK) < HEADER:
            at += left
            continue
        _, length, kind = struct.unpack_from("<IHB", data, at)
        parts += data[at + HEADER : at + HEADER + length]
        at += HEADER + length
        if kind in ENDS:
            yield Record.FromString(parts)
            parts = b""


def written(folder):
    """The records of the offline run in a folder, once W&B's own process has written the last one."""
    (file,) = folder.glob("wandb/offline-run-*/*.wandb")
    until = time.monotonic() + 60
    while not any(record.HasField("exit") for record in records(file)):
        assert time.monotonic() < until
        time.sleep(0.1)
    return list(records(file))


def read_back(folder):
    """The configuration and the rows of the offline run in a folder."""
    config, rows = {}, []
    for record in written(folder):
        for item in [*record.run.config.update, *record.config.update]:
            place = config
            *outer, last = list(item.nested_key) or [item.key]
            for name in outer:
                place = place.setdefault(name, {})
            place[last] = json.loads(item.value_json)
        if record.history.item:
            rows.append(
                {item.key or item.nested_key[0]: json.loads(item.value_json) for item in record.history.item}
            )
    return config, rows


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "tracked"
    return folder, tiny_runs.train("ddpg", folder, *TINY)


def test_every_key_of_the_configuration_is_found_again(run):
    folder, _ = run
    config, _ = read_back(folder)
    settings = yaml.safe_load((folder / "config.yaml").read_text())
    assert {"recipe", "env", "map", "algo", "run"} <= set(settings)
    assert {name: config[name] for name in settings} == settings


def test_rows_of_metrics_are_found_again(run):
    folder, metrics = run
    _, rows = read_back(folder)
    rows = [row for row in rows if "eval_return" in row]
    assert [row["_step"] for row in rows] == metrics["frames"].tolist() == [100, 200]
    for column in metrics:
        assert [row[column] for row in rows] == pytest.approx(metrics[column].tolist(), nan_ok=True)


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
    dashboard.finish(nobody / "map.safetensors", nobody / "video.mp4")
    config, rows = read_back(nobody)
    assert config["seed"] == 3
    assert rows[0]["eval_return"] == 1.0


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
        config, rows = read_back(folder)
        assert config["seed"] == number
        assert [row["eval_return"] for row in rows] == [number]


def test_a_run_that_fails_is_closed_as_failed(tmp_path, monkeypatch):
    monkeypatch.setattr(Record, "count_steps", lambda self, data: 1 / 0)
    folder = tmp_path / "run"
    with pytest.raises(ZeroDivisionError):
        tiny_runs.train("ddpg", folder, *TINY)
    assert [record.exit.exit_code for record in written(folder) if record.HasField("exit")] == [1]


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
