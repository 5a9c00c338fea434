"""What is wrong is told in one line with what mends it, before anything takes long; and nothing stays open."""

import socket
import sys
from pathlib import Path

import pytest

import fresh_process
import nht
from nht.recipes import steer
from nht.recipes.config import Steer
from nht.recipes.launch import launch
from nht.recipes.live import opening
from steered import map_file, random_map


@pytest.fixture
def told(tmp_path, monkeypatch):
    """Runs the recipe in an empty folder, in which no map can be trained; gives the error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(nht, "train_map", lambda *_, **__: pytest.fail("a map was trained"))
    monkeypatch.setattr("nht.recipes.steer.keep_pace", lambda *_: pytest.fail("the page was opened"))

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["steer", "port=0", *words])
        with pytest.raises(SystemExit) as ended:
            launch(steer.main, Steer, "steer")
        error = str(ended.value)
        assert error.startswith("error: ")
        assert len(error.splitlines()) == 1
        return error

    return run


def test_a_port_in_use_comes_before_everything_else(told, monkeypatch):
    monkeypatch.setattr(opening, "open_session", lambda _: pytest.fail("a session was opened"))
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        error = told(f"port={port}")
    assert f"port {port} of 127.0.0.1 is in use: choose another, port={port + 1}" in error


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["map.file=none.safetensors"],
            "no map none.safetensors: train one, python -m nht.recipes.train_map map=nht",
        ),
        (["run=nowhere"], "nowhere holds no run"),
        (["maps=[scl,nht]"], "['scl', 'nht'] are trained on demonstrations: name them, demos.path=FOLDER"),
        (["maps=[pca]"], "no map pca, nor a kind of that name among ['cae', 'jacobian', "),
        (["tool=hand"], "the model has no part 'hand': its sites are ['tool']"),
        (["env.name=moon"], "unknown environment 'moon'"),
        (["env=gymnasium", "env.name=Pendulum-v1"], "Pendulum-v1 has no MuJoCo model to draw"),
        (["speed=0"], "speed must lie in (0, 10], got 0.0"),
        (["max_episode_steps=0"], "max_episode_steps must be at least 1, got 0"),
        (["port=70000"], "port must be in 0 ... 65535, got 70000"),
        (["host=192.0.2.1"], "cannot listen on 192.0.2.1"),
        (["demos.path=nowhere"], "nowhere"),
    ],
)
def test_mistakes_are_told(told, tmp_path, words, message):
    assert message in told(*words)
    assert list(tmp_path.iterdir()) == []


def test_a_map_that_does_not_fit_is_told_with_the_command_that_trains_one(told, tmp_path):
    file = map_file(tmp_path)
    error = told(f"map.file={file}", "env=half_cheetah")
    assert f"{file} does not fit half_cheetah: the map drives 7 actuators, the environment's action" in error
    assert error.endswith(
        "python -m nht.recipes.train_map env=half_cheetah demos.path=FOLDER map=nht out=runs/nht.safetensors."
    )
    error = told(f"map.file={file}", "env=gymnasium", "env.name=Pusher-v5")
    assert "no context key 'tool_position'" in error
    assert "train_map env=gymnasium env.name=Pusher-v5 demos.path=FOLDER map=nht" in error
    wide = random_map()
    wide.context_keys = ("joint_angle",)
    nht.save_map(wide, tmp_path / "wide.safetensors")
    assert "the map's context has 10 entries, the context keys 7" in told(
        f"map.file={tmp_path / 'wide.safetensors'}"
    )


def test_a_file_that_is_no_map_is_told(told, tmp_path):
    (tmp_path / "map.safetensors").write_bytes(b"no map")
    assert "map.safetensors" in told("map.file=map.safetensors")


WITHOUT = f"""
import runpy, sys
sys.path.insert(0, {str(Path(fresh_process.__file__).parent)!r})
from without_extras import hide
hide({{"viser"}})
sys.argv = ["steer", "port=0"]
runpy._run_module_as_main("nht.recipes.steer")
"""


def test_a_missing_extra_is_told_in_one_line():
    done = fresh_process.run(WITHOUT)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == (
        "error: steering in the browser needs viser: pip install 'nht[steer]'."
    )
    assert "Traceback" not in done.stderr
