"""What MuJoCo warns of is told once, to the log, and no file appears where the user stands."""

import logging
import subprocess
import sys
import textwrap
from contextlib import closing

import mujoco
import pytest

from nht.envs import make_env, make_gymnasium, mujoco_log
from nht.envs.dm_control import MISSING

LOGGER = "nht.envs.mujoco_log"


@pytest.fixture(autouse=True)
def fresh(tmp_path, monkeypatch):
    """An empty working folder, nothing told yet, and MuJoCo as it is where nobody has imported dm_control."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(mujoco_log, "_told", set())
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(None)
    yield tmp_path
    mujoco.set_mju_user_warning(previous)


def diverge(env):
    """Two steps, of which MuJoCo finds the numbers too large."""
    for _ in range(2):
        env.reset()
        env.task.state[:, 1 + env.task.model.nq] = 1e12
        assert env.rand_step()["next", "diverged"].all()


@pytest.mark.parametrize("threads", [1, 2])
def test_a_simulation_that_diverges_warns_once_and_writes_nothing(threads, fresh, caplog):
    with closing(make_env("ant", 4, threads, seed=0)) as env, caplog.at_level("WARNING", LOGGER):
        diverge(env)
    assert [record.levelno for record in caplog.records] == [logging.WARNING]
    assert caplog.messages[0].startswith("MuJoCo: Nan, Inf or huge value in QVEL")
    assert list(fresh.iterdir()) == []
    assert mujoco.get_mju_user_warning() is None


def test_an_environment_of_gymnasium_warns_once_and_writes_nothing(fresh, caplog):
    with caplog.at_level("WARNING", LOGGER):
        for _ in range(2):
            make_gymnasium("HalfCheetah-v5", num_envs=2, seed=0).close()
    assert len(caplog.records) == 1
    assert "settotalmass" in caplog.messages[0]
    assert list(fresh.iterdir()) == []


def test_a_users_own_handler_stays(fresh, caplog):
    heard = []
    mujoco.set_mju_user_warning(heard.append)
    with closing(make_env("ant", seed=0)) as env, caplog.at_level("WARNING", LOGGER):
        diverge(env)
    assert heard
    assert not caplog.records
    assert mujoco.get_mju_user_warning() is not None


def test_making_and_stepping_our_tasks_says_and_writes_nothing(fresh):
    """In a process of its own, as a user's, where no test has taken MuJoCo's words away."""
    pytest.importorskip("dm_control", reason=MISSING)
    code = """
        import nht.envs
        for name in nht.envs.TASKS:
            env = nht.envs.make_env(name, 2, seed=0)
            env.reset()
            env.rand_step()
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    process = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert process.returncode == 0, process.stderr
    assert "MuJoCo" not in process.stdout + process.stderr
    assert "WARNING" not in process.stdout + process.stderr
    assert list(fresh.iterdir()) == []
