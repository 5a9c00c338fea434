"""Pictures from environments: TorchRL's ``PixelRenderTransform``, sizes and cameras, machines without a display."""

import socket
import threading
from contextlib import closing

import gymnasium
import numpy as np
import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.record import PixelRenderTransform

from fresh_process import run
from nht.envs import display, make_dm_control, make_env, make_gymnasium

pytestmark = pytest.mark.usefixtures("can_render")

MAKERS = {
    "ours": lambda: make_env("wam_wipe", num_envs=2, seed=0),
    "gymnasium": lambda: make_gymnasium("HalfCheetah-v5", num_envs=2, seed=0),
    "dm_control": lambda: make_dm_control("reacher-easy", num_envs=2, seed=0),
}


@pytest.fixture(params=sorted(MAKERS))
def env(request):
    with closing(MAKERS[request.param]()) as env:
        yield env


def test_a_picture_of_every_copy(env):
    env.reset()
    pictures = env.render(width=64, height=48)
    assert pictures.shape == (2, 48, 64, 3)
    assert pictures.dtype == np.uint8
    assert pictures.std() > 5
    assert not np.array_equal(pictures[0], pictures[1])
    assert env.render().shape == (2, 480, 640, 3)


def test_torchrls_transform(env):
    driven = TransformedEnv(env, PixelRenderTransform(width=32, height=24, mode="rgb_array"))
    check_env_specs(driven)
    data = driven.rollout(3)
    assert data["pixels"].shape == (2, 3, 24, 32, 3)
    assert data["pixels"].dtype == torch.uint8


def test_the_picture_shows_the_copy_as_it_stands():
    with closing(make_env("half_cheetah", num_envs=2, seed=0)) as env:
        env.reset()
        before = env.render(width=64, height=48)
        env.step(env.fake_tensordict().set("action", torch.tensor([[0.0] * 6, [1.0] * 6])))
        for _ in range(5):
            env.task.step(np.array([[0.0] * 6, [1.0] * 6]), np.array([1]))
        after = env.render(width=64, height=48)
    assert not np.array_equal(after[1], before[1])


def test_cameras():
    with closing(make_dm_control("quadruped-walk", seed=0)) as env:
        env.reset()
        names = [env.task.copies[0].simulator.model.camera(i).name for i in range(3)]
        pictures = [env.render(width=64, height=48, camera=camera) for camera in (None, 0, names[1], 1)]
        assert np.array_equal(pictures[0], pictures[1])
        assert np.array_equal(pictures[2], pictures[3])
        assert not np.array_equal(pictures[0], pictures[2])
        with pytest.raises(ValueError, match=r"no camera 'moon': choose from \['global'"):
            env.render(camera="moon")
    with closing(make_env("wam_wipe", seed=0)) as env, pytest.raises(ValueError, match=r"no camera 99"):
        env.render(camera=99)


def test_other_modes():
    with (
        closing(make_env("wam_wipe", seed=0)) as env,
        pytest.raises(ValueError, match="must be 'rgb_array', got 'human'"),
    ):
        env.render("human")


@pytest.mark.parametrize("vector", [False, True])
def test_gymnasium_takes_size_and_camera(vector):
    make = gymnasium.make_vec if vector else gymnasium.make
    options = {"num_envs": 2} if vector else {}
    env = make("nht/WAMWipe-v0", render_mode="rgb_array", width=80, height=60, camera=0, **options)
    env.reset(seed=0)
    picture = env.render()[0] if vector else env.render()
    assert picture.shape == (60, 80, 3)
    env.close()
    env = make("nht/WAMWipe-v0", render_mode="rgb_array", camera="moon", **options)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="no camera 'moon'"):
        env.render()


def test_a_plain_environments_spec_is_json():
    env = gymnasium.make("nht/WAMWipe-v0", render_mode="rgb_array", width=80, start="random")
    again = gymnasium.make(gymnasium.envs.registration.EnvSpec.from_json(env.spec.to_json()))
    assert again.spec == env.spec


# Displays.

DRAW_OURS = """
import nht.envs
print(nht.envs.make_env("wam_wipe", seed=0).render(width=32, height=24).shape)
"""


@pytest.mark.parametrize(
    "named", ["", ":99", "localhost:77", "nowhere.invalid:0", "nonsense", ":", "/tmp/x:0"]
)
def test_displays_that_nobody_serves(named, monkeypatch):
    monkeypatch.setenv("DISPLAY", named)
    assert not display.display_answers()


def test_without_a_display_that_answers_egl_is_taken():
    if run("import ctypes; ctypes.CDLL('libEGL.so.1')").returncode:
        pytest.skip("EGL is not installed")
    found = run(DRAW_OURS, DISPLAY=":99")
    assert found.stdout.strip().endswith("(1, 24, 32, 3)"), found.stderr


def test_what_was_asked_for_is_kept():
    """Nobody chooses in the place of whoever said it."""
    found = run(DRAW_OURS + "import os; print(os.environ['MUJOCO_GL'])", MUJOCO_GL="egl", DISPLAY=":99")
    if not found.returncode:
        assert found.stdout.strip().endswith("egl")


def test_a_display_that_answers(monkeypatch, tmp_path):
    """Over TCP, as ssh forwards it, and by a socket in the file system's own names."""
    server = socket.create_server(("localhost", 0))
    monkeypatch.setenv("DISPLAY", f"localhost:{server.getsockname()[1] - 6000}.0")
    accepting = threading.Thread(target=server.accept, daemon=True)
    accepting.start()
    assert display.display_answers()
    accepting.join()  # a socket in use by a thread is not closed yet
    server.close()
    assert not display.display_answers()
    monkeypatch.delenv("DISPLAY")
    assert not display.display_answers()


def test_a_local_display_that_answers(monkeypatch):
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("\0/tmp/.X11-unix/X7351")
        server.listen()
        monkeypatch.setenv("DISPLAY", ":7351")
        assert display.display_answers()
