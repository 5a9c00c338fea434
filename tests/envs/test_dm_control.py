"""dm_control's suite through TorchRL's wrapper and through the recipes."""

import subprocess
import sys
from contextlib import closing

import numpy as np
import pandas
import pytest
import torch
from torchrl.envs import TransformedEnv
from torchrl.envs.utils import check_env_specs

import nht
from nht.envs import foreign_copies, make_dm_control
from nht.envs.dm_control import MISSING
from nht.recipes import ddpg, evaluate
from nht.recipes.agents.returns import reward_range
from nht.recipes.config import DDPG, Evaluate
from nht.recipes.launch import configure
from nht.recipes.run.environments import base_env, mapped_env
from nht.recipes.sections import EnvConfig
from nht.transforms import ActionMapTransform

suite = pytest.importorskip("dm_control.suite", reason=MISSING)

# Flat entries, a matrix among them, a target that moves in the model, and a task without time limit or reward bounds.
SOME = ["cheetah-run", "stacker-stack_2", "reacher-easy", "lqr-lqr_6_2"]
FLAGS = ("success", "failure", "diverged")
TINY = [
    *("algo.total_frames=160", "algo.frames_per_batch=40", "algo.updates_per_batch=2"),
    *("algo.warmup_frames=40", "algo.hidden=[16]", "algo.buffer_size=1000", "run.wandb=false"),
    *("evaluation.every=80", "evaluation.episodes=2", "evaluation.video=false", "run.checkpoint_every=80"),
    *("env=dm_control", "env.name=reacher-easy", "env.num_envs=2", "+env.options.time_limit=0.3"),
]


@pytest.fixture(params=SOME, scope="module")
def env(request):
    with closing(make_dm_control(request.param, num_envs=2, seed=0)) as env:
        env.asked_for = request.param
        yield env


def play(env, tensordict, actions):
    frames = []
    for action in actions:
        frame, tensordict = env.step_and_maybe_reset(tensordict.clone().set("action", action))
        frames.append(frame["next"].clone())
    return torch.stack(frames), tensordict


def assert_same(one, other):
    assert [key for key in one.keys(True, True) if not torch.equal(one[key], other[key])] == []


def test_specs(env):
    check_env_specs(env)
    assert env.batch_size == (2,)
    data = env.rollout(3)["next"]
    assert all(data[flag].shape == (2, 3, 1) and not data[flag].any() for flag in FLAGS)
    sizes = env.task.observation_sizes
    assert all(
        data[key].shape == (2, 3, size) and data[key].dtype == torch.float32 for key, size in sizes.items()
    )
    parts = [data[key] for key in sizes if key != "observation"]
    assert torch.equal(data["observation"], torch.cat(parts, -1))


def test_episodes_are_the_suites_own(env):
    env.set_seed(5)
    tensordict = env.reset()
    actions = random_actions(env, 5)
    theirs = suite.load(*env.asked_for.split("-"), task_kwargs={"random": 0})
    theirs.task._random = np.random.RandomState(5)
    theirs.reset()  # TorchRL's seeding makes one
    np.testing.assert_allclose(tensordict["observation"][0], flat(theirs.reset()), rtol=1e-6, atol=1e-6)
    data, _ = play(env, tensordict, actions)
    for action, step in zip(actions[:, 0], data[:, 0], strict=True):
        time_step = theirs.step(action.double().numpy())
        np.testing.assert_allclose(step["observation"], flat(time_step), rtol=1e-6, atol=1e-6)
        assert step["reward"].item() == pytest.approx(time_step.reward, rel=1e-6, abs=1e-6)


def test_going_on_from_a_saved_state_is_exact(env):
    """Through the next episode, whose start the generator and the model's own changes decide."""
    tensordict, _ = play(env, env.reset(), random_actions(env, 3))[1], None
    saved = env.task.state_dict()
    actions = random_actions(env, 6)
    steps, _ = play(env, tensordict, actions)
    start = env.reset()
    play(env, start, actions)
    env.task.load_state_dict(saved)
    again, _ = play(env, tensordict, actions)
    assert_same(again, steps)
    assert_same(env.reset(), start)


def test_runs_through_a_map(env):
    n = env.action_spec.shape[-1]
    map = nht.NHT(env.task.observation_sizes["observation"], n, max(1, n // 2), hidden=(8,))
    driven = TransformedEnv(env, ActionMapTransform(map, context_keys=["observation"], saturation="clip"))
    check_env_specs(driven)
    data = driven.rollout(3)
    assert data["action"].shape[-1] == max(1, n // 2)
    expected = map(data["action"], data["observation"]).clamp(-1, 1)
    torch.testing.assert_close(data["next", "actuation"], expected)


def test_rewards_know_their_bounds(env):
    lqr = env.asked_for.startswith("lqr")
    assert reward_range(env) == ((-np.inf, np.inf) if lqr else (0.0, 1.0))


def test_episodes_end_though_the_suite_knows_no_limit(monkeypatch):
    monkeypatch.setattr(foreign_copies, "LONGEST_EPISODE", 4)
    with closing(make_dm_control("lqr-lqr_2_1", seed=0)) as env:
        assert env.task.max_episode_steps == 4
        data = env.rollout(9, break_when_any_done=False)["next"]
        assert data["truncated"].flatten().nonzero().flatten().tolist() == [3, 7]


def test_any_observation_may_be_the_context():
    config = EnvConfig("reacher-easy", "dm_control", ["position", "to_target"], num_envs=2)
    with closing(mapped_env(config, nht.NHT(4, 2, 1, hidden=(8,)), seed=0)) as env:
        data = env.rollout(3)
    assert torch.equal(data["context"], torch.cat([data["position"], data["to_target"]], -1))


# The recipes.


def train(folder, *overrides):
    ddpg.main(configure(DDPG, "ddpg", [*TINY, "map=none", f"run.folder={folder}", *overrides]))
    return pandas.read_csv(folder / "metrics.csv").drop(columns="seconds")


def test_ddpg_trains_resumes_and_is_evaluated(tmp_path, capsys):
    whole = train(tmp_path / "whole")
    assert whole["eval_return"].between(0, 50).all()
    assert whole["loss_value"].notna().all()
    train(tmp_path / "stopped", "algo.total_frames=80")
    resumed = train(tmp_path / "stopped", "run.resume=true")
    pandas.testing.assert_frame_equal(resumed, whole)
    evaluate.main(configure(Evaluate, "evaluate", [f"run={tmp_path / 'whole'}", "episodes=2", "video=false"]))
    assert "eval_return" in capsys.readouterr().out


def test_the_command_line_names_domain_and_task():
    config = configure(
        DDPG, "ddpg", ["env=dm_control", "env.name=walker-walk", "env.context_keys=[orientations]"]
    )
    assert (config.env.suite, config.env.name) == ("dm_control", "walker-walk")
    assert config.run.folder == "runs/ddpg-walker-walk-nht-seed0"


# Bad input.


def test_unknown_names():
    with pytest.raises(ValueError, match=r"no domain 'cheeta', as in 'cheeta-run': .*'cheetah'.*'walker'"):
        make_dm_control("cheeta-run", seed=0)
    with pytest.raises(
        ValueError, match=r"no task 'walker-fly': .*\['walker-run', 'walker-stand', 'walker-walk'\]"
    ):
        make_dm_control("walker-fly", seed=0)
    with pytest.raises(ValueError, match=r"no task 'walker': the domain 'walker' has"):
        make_dm_control("walker", seed=0)
    with pytest.raises(
        ValueError, match=r"unknown env.suite 'dmc': .*\['nht', 'dm_control', 'gymnasium', 'torchrl'\]"
    ):
        base_env(EnvConfig("cheetah-run", "dmc"), seed=0)


def test_a_context_key_that_the_task_lacks():
    config = EnvConfig("reacher-easy", "dm_control", ["joint_angle"], num_envs=1)
    with pytest.raises(KeyError, match=r"no context key 'joint_angle'; it has \['position', 'to_target'"):
        mapped_env(config, nht.NHT(2, 2, 1, hidden=(8,)), seed=0)


def test_settings_that_make_no_sense():
    with pytest.raises(ValueError, match="num_envs must be at least 1, got 0"):
        make_dm_control("reacher-easy", num_envs=0, seed=0)
    with pytest.raises(ValueError, match=r"steps its copies in one thread, got env.num_threads=2"):
        base_env(EnvConfig("reacher-easy", "dm_control", num_threads=2), seed=0)


def test_an_extra_that_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "dm_control", None)
    monkeypatch.setitem(sys.modules, "dm_control.suite", None)
    how = (
        r"pip install 'nht\[dm_control\]', and on Python 3.13 or newer, .* --no-deps dm_control after that\.$"
    )
    with pytest.raises(ImportError, match=how):
        make_dm_control("cheetah-run", seed=0)
    with pytest.raises(ImportError, match=r"pip install 'nht\[dm_control\]'"):
        nht.envs.make_env("cheetah_run", seed=0)


def test_neither_importing_nor_making_needs_a_way_to_render():
    code = """
import sys, nht.envs
assert not {"dm_control", "gymnasium_robotics"} & set(sys.modules), "imported though nobody asked"
nht.envs.make_dm_control("reacher-easy", seed=0).rollout(2)
nht.envs.make_env("cheetah_run", seed=0).rollout(2)
"""
    command = [sys.executable, "-c", code]
    without = {"MUJOCO_GL": "disable", "PATH": ""}
    found = subprocess.run(command, env=without, capture_output=True, text=True, timeout=200)
    assert found.returncode == 0, found.stderr


def flat(time_step):
    return np.concatenate([np.ravel(values) for values in time_step.observation.values()])


def random_actions(env, count):
    return torch.stack([env.full_action_spec.rand()["action"].clamp(-1, 1) for _ in range(count)])
