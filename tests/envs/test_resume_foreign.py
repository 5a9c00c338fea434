"""Saved simulators of others go on bit for bit: every MuJoCo task of Gymnasium, the hands, mazes, the suite."""

import os
import pickle
from contextlib import closing
from importlib.util import find_spec
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from fresh_process import run
from nht.envs import make_dm_control, make_gymnasium

# What tasks read before they step, and what the sensors, contacts or Python remember.
QUICK = [
    "Ant-v5",
    "Humanoid-v5",
    "HalfCheetah-v5",
    "Pusher-v5",
    "Reacher-v5",
    "AdroitHandPen-v1",
    "Pendulum-v1",
]
QUICK_SUITE = ["quadruped-walk", "manipulator-bring_ball", "finger-turn_hard"]
NEEDS_OPENGL = "quadruped-escape"  # it draws the terrain at every reset

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")


def mujoco_tasks():
    """The ids of Gymnasium and of Gymnasium-Robotics that can be made with MuJoCo 3: Pusher-v4 is for MuJoCo 2."""
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    found = []
    for name, spec in gymnasium.registry.items():
        entry = str(spec.entry_point)
        ours = "gymnasium.envs.mujoco" in entry and name.endswith(("v4", "v5")) and name != "Pusher-v4"
        hands = "adroit" in entry and "Sparse" not in name
        mazes = "maze" in entry and "UMaze" in name and "Dense" not in name and name.endswith(("v3", "v5"))
        if (ours or hands or mazes) and name not in QUICK:
            found.append(name)
    return sorted(found)


def suite_tasks():
    if find_spec("dm_control") is None:
        return []
    from dm_control import suite

    return sorted(
        f"{domain}-{task}" for domain, task in suite.ALL_TASKS if f"{domain}-{task}" not in QUICK_SUITE
    )


def goes_on_exactly(env, before=12, after=6):
    """Plays, saves, plays on, and plays on again from what was saved: here, and in another environment."""
    low, high = -1.0, 1.0
    generator = torch.Generator().manual_seed(0)
    shape = (before + after, *env.action_spec.shape)
    actions = env.action_spec.project(torch.rand(shape, generator=generator) * (high - low) + low)
    current = env.reset()
    for action in actions[:before]:
        _, current = env.step_and_maybe_reset(current.set("action", action))
    saved = pickle.dumps(env.task.state_dict())

    def play(env):
        tensordict, frames = current.clone(), []
        for action in actions[before:]:
            frame, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            frames.append(frame["next"].clone())
        return [*frames, env.reset()]

    expected = play(env)
    env.rollout(3)
    for other in (env, pickle.loads(pickle.dumps(env))):
        other.task.load_state_dict(pickle.loads(saved))
        for mine, theirs in zip(play(other), expected, strict=True):
            differing = [key for key in theirs.keys(True, True) if not torch.equal(mine[key], theirs[key])]
            assert differing == []


@pytest.mark.parametrize("name", QUICK)
def test_gymnasium(name):
    with closing(make_gymnasium(name, num_envs=2, seed=0)) as env:
        goes_on_exactly(env)


@pytest.mark.slow
@pytest.mark.parametrize("name", mujoco_tasks())
def test_all_of_gymnasium(name):
    with closing(make_gymnasium(name, num_envs=2, seed=0)) as env:
        goes_on_exactly(env, before=25)


@pytest.mark.parametrize("name", QUICK_SUITE)
def test_suite(name):
    with closing(make_dm_control(name, seed=0)) as env:
        goes_on_exactly(env, before=5, after=3)


@pytest.mark.slow
@pytest.mark.parametrize("name", suite_tasks())
def test_all_of_the_suite(name):
    with closing(make_dm_control(name, seed=0)) as env:
        goes_on_exactly(env, before=5, after=3)


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK[:5])
def test_the_saved_numbers_stay_as_many(name):
    """Whatever touches whatever: another number of contacts makes no array longer."""
    with closing(make_gymnasium(name, seed=0)) as env:
        current, sizes = env.reset(), set()
        for _ in range(60):
            sizes.add(env.task.state_dict()["copy0"]["derived"].size)
            _, current = env.step_and_maybe_reset(env.rand_action(current))
    assert len(sizes) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("can_render")
def test_a_task_that_draws_at_every_reset():
    code = f"""
import torch
from test_resume_foreign import goes_on_exactly
from nht.envs import make_dm_control
goes_on_exactly(make_dm_control({NEEDS_OPENGL!r}, seed=0), before=5, after=3)
"""
    folders = Path(__file__).parent, Path(__file__).parents[1] / "support"
    found = run(code, MUJOCO_GL="egl", PYTHONPATH=os.pathsep.join(map(str, folders)))
    assert found.returncode == 0, found.stderr


# Files from before.


def test_states_of_older_files_load():
    """Without what a step leaves behind, and without Python's attributes."""
    with closing(make_gymnasium("HalfCheetah-v5", seed=0)) as env:
        env.rollout(3)
        saved = env.task.state_dict()
        qpos = env.task.copies[0].simulator.data.qpos.copy()
        older = {"copy0": {key: saved["copy0"][key] for key in ("state", "model", "progress")}}
        env.rollout(5)
        env.task.load_state_dict(older)
        np.testing.assert_array_equal(env.task.copies[0].simulator.data.qpos, qpos)


def test_a_state_of_another_model_is_refused():
    with closing(make_gymnasium("HalfCheetah-v5", seed=0)) as env:
        saved = env.task.state_dict()
        saved["copy0"]["derived"] = saved["copy0"]["derived"][1:]
        with pytest.raises(
            ValueError, match=r"has \d+ derived numbers, this one \d+: .* another version of MuJoCo"
        ):
            env.task.load_state_dict(saved)


def test_a_saved_state_leaves_options_alone():
    with (
        closing(make_gymnasium("HalfCheetah-v5", seed=0)) as env,
        closing(make_gymnasium("HalfCheetah-v5", seed=0, ctrl_cost_weight=7.0)) as other,
    ):
        env.rollout(2)
        other.task.load_state_dict(env.task.state_dict())
        cost = env.rollout(1)["next", "reward"], other.rollout(1)["next", "reward"]
    assert cost[0] != cost[1]


@pytest.mark.parametrize("name", ["FetchReach-v4", "HandReach-v3"])
def test_what_cannot_be_made(name):
    """By Gymnasium-Robotics with this MuJoCo, without us; if it can again, its tasks belong into the lists above."""
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    try:
        gymnasium.make(name).close()
    except AssertionError:
        return
    with closing(make_gymnasium(name, seed=0)) as env:
        goes_on_exactly(env)
