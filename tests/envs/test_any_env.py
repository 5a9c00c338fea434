"""Any environment of Gymnasium or TorchRL with continuous actions, MuJoCo or not, as the recipes take it."""

import math
from contextlib import closing
from functools import partial
from typing import ClassVar

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, Dict, Discrete
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import DMControlEnv, EnvBase, GymEnv, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

import nht
from nht.envs import make_dm_control, make_env, make_gymnasium, make_torchrl
from nht.envs.python_state import decoded, encoded
from nht.transforms import ActionMapTransform
from toy_envs import ToyArm

FLAGS = ("success", "failure", "diverged")


class Toy(gymnasium.Env):
    """A point, pushed; a picture of where it is. What it observes and does is told."""

    metadata: ClassVar = {"render_modes": ["rgb_array"], "render_fps": 25}

    def __init__(self, observation_space=None, action_space=None, render_mode=None, extra=None):
        self.observation_space = observation_space or Box(-9.0, 9.0, (2,), np.float64)
        self.action_space = action_space or Box(-1.0, 1.0, (2,), np.float32)
        self.render_mode = render_mode
        self.extra = extra
        self.memory = {"visited": [], "best": (0.0, 0)}

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(-1, 1, 2)
        self.memory = {"visited": [], "best": (0.0, 0)}
        return self._seen(), self._info()

    def step(self, action):
        assert action.dtype == self.action_space.dtype
        self.place = self.place + np.asarray(action, dtype=np.float64).ravel()[:2]
        self.memory["visited"].append(float(self.place[0]))
        seen = self._seen()
        return seen, float(len(self.memory["visited"]) + self.place.sum()), False, False, self._info()

    def _seen(self):
        space = self.observation_space
        if isinstance(space, Dict):
            return {key: np.resize(self.place, each.shape).astype(each.dtype) for key, each in space.items()}
        return np.resize(self.place, space.shape).astype(space.dtype) if isinstance(space, Box) else 0

    def _info(self):
        return {"goal": self.place * 2, "level": 3, "is_success": bool(self.place[0] > 0)}

    def render(self):
        picture = np.zeros((30, 40, 3), dtype=np.uint8)
        picture[:, : int(20 + 5 * np.clip(self.place[0], -3, 3))] = 200
        return picture


gymnasium.register("Toy-v0", Toy)


# Gymnasium.


@pytest.mark.parametrize("name", ["Pendulum-v1", "MountainCarContinuous-v0", "Toy-v0", "nht/WAMWipe-v0"])
def test_specs_and_maps(name):
    with closing(make_gymnasium(name, num_envs=2, seed=0)) as env:
        check_env_specs(env)
        data = env.rollout(3)["next"]
        assert all(data[flag].shape == (2, 3, 1) for flag in FLAGS)
        for key, size in env.task.observation_sizes.items():
            assert data[key].shape == (2, 3, size)
            assert data[key].dtype == torch.float32
        n = env.action_spec.shape[-1]
        width = env.task.observation_sizes["observation"]
        map = nht.NHT(width, n, 1, hidden=(4,)) if n > 1 else nht.Identity(1)
        keys = ["observation"] if n > 1 else None
        check_env_specs(TransformedEnv(env, ActionMapTransform(map, keys, action_scale=1.0)))


def test_our_own_task_is_what_make_env_makes():
    """The raw keys, the flags and the range of rewards come through Gymnasium."""
    with closing(make_gymnasium("nht/WAMWipe-v0", num_envs=1, seed=0)) as theirs:
        ours = make_env("wam_wipe", num_envs=1, seed=0)
        current, mine = theirs.reset(), ours.reset()
        ours.task.load_state_dict(theirs.task.copies[0].task.state_dict())
        assert theirs.task.observation_sizes == ours.task.observation_sizes
        assert theirs.task.reward_range == (-1.0, 0.0)
        assert theirs.task.time_per_step == ours.task.time_per_step
        assert theirs.task.max_episode_steps == 200
        for _ in range(30):
            action = torch.full((1, 7), 0.3)
            current = theirs.step(current.set("action", action.clone()))["next"].exclude("reward")
            mine = ours.step(mine.set("action", action))["next"].exclude("reward")
            for key in (*ours.task.observation_sizes, *FLAGS):
                assert torch.equal(current[key], mine[key]), key
        assert mine["failure"].all()


def test_entries_of_info_as_observations():
    with closing(make_gymnasium("Toy-v0", num_envs=2, seed=0, info_keys=["goal", "level"])) as env:
        check_env_specs(env)
        data = env.rollout(3)["next"]
        assert torch.equal(data["goal"], 2 * data["observation"])
        assert data["level"].eq(3.0).all()
        assert data["level"].shape == (2, 3, 1)
        assert torch.equal(data["success"], data["observation"][..., :1] > 0), "is_success"
        assert env.task.observation_sizes == {"observation": 2, "goal": 2, "level": 1}
    with pytest.raises(
        KeyError, match=r"the info of Toy-v0 lacks \['speed'\] after a reset; it has \['goal'"
    ):
        make_gymnasium("Toy-v0", info_keys=["speed"])


def test_what_consists_of_python_values_goes_on_exactly():
    with closing(make_gymnasium("Toy-v0", num_envs=2, seed=0)) as env:
        assert env.task.can_resume
        assert env.task.resume_obstacle == ""
        current = env.rollout(4)[:, -1]["next"].exclude("reward")
        saved, action = env.task.state_dict(), torch.full((2, 2), 0.25)
        expected = [
            env.step(current.clone().set("action", action))["next", "reward"].clone() for _ in range(3)
        ]
        first = env.reset()["observation"].clone()
        env.rollout(7)
        env.task.load_state_dict(saved)
        again = [env.step(current.clone().set("action", action))["next", "reward"] for _ in range(3)]
        assert all(map(torch.equal, again, expected))
        assert torch.equal(env.reset()["observation"], first)


def test_what_else_it_consists_of_is_named():
    with closing(make_gymnasium("Toy-v0", seed=0, extra=iter([1]))) as env:
        assert not env.task.can_resume
        assert (
            env.task.resume_obstacle
            == "its simulator cannot be saved (Toy.extra is a builtins.list_iterator)"
        )


@pytest.mark.parametrize(
    "value", [[1, (2.5, "a")], {"b": {"c"}, "d": None}, np.float32(0.1), np.arange(3), frozenset({1})]
)
def test_values_survive_being_written_down(value):
    back = decoded(encoded(value))
    assert type(back) is type(value)
    assert np.array_equal(back, value) if isinstance(value, np.ndarray) else back == value


@pytest.mark.parametrize("precision", ["float16", "float32", "float64"])
def test_every_precision(precision):
    spaces = {
        "observation_space": Dict(a=Box(-9, 9, (2,), precision), b=Box(-9, 9, (2, 2), precision)),
        "action_space": Box(-1, 1, (2,), precision),
    }
    with closing(make_gymnasium("Toy-v0", num_envs=2, seed=0, disable_env_checker=True, **spaces)) as env:
        check_env_specs(env)
        assert env.action_spec.dtype == torch.float32
        data = env.rollout(3)
        assert {data["next", key].dtype for key in ("a", "b", "observation", "reward")} == {torch.float32}
        assert data["observation"].shape == (2, 3, 6)


def test_mazes_have_no_step_of_their_own():
    with closing(make_gymnasium("PointMaze_UMaze-v3", num_envs=1, seed=0)) as env:
        check_env_specs(env)
        core = env.task.copies[0].core
        assert env.task.time_per_step == core.point_env.dt
        assert env.task.observation_sizes == {"achieved_goal": 2, "desired_goal": 2, "observation": 8}


# TorchRL.


class Slide(EnvBase):
    """One joint in double precision that knows no end."""

    def __init__(self, batch_size=(), action=None, key="action"):
        super().__init__(batch_size=batch_size)
        self.observation_spec = Composite(
            joint=Unbounded((*batch_size, 1), dtype=torch.float64), shape=batch_size
        )
        self.action_spec = Bounded(-1, 1, (*batch_size, 2), dtype=torch.float64) if action is None else action
        self.reward_spec = Unbounded((*batch_size, 1), dtype=torch.float64)
        self.generator = torch.Generator()

    def _reset(self, tensordict=None, **_):
        self.joint = torch.rand((1,), generator=self.generator, dtype=torch.float64)
        return self.full_done_spec.zero().set("joint", self.joint)

    def _step(self, tensordict):
        assert tensordict["action"].dtype == torch.float64
        self.joint = self.joint + tensordict["action"].sum(-1, keepdim=True)
        return self.full_done_spec.zero().update({"joint": self.joint, "reward": self.joint.clone()})

    def _set_seed(self, seed):
        self.generator.manual_seed(seed)

    def render(self):
        return np.full((20, 20, 3), 7, dtype=np.uint8)


def test_an_environment_of_ones_own():
    with closing(make_torchrl(Slide, num_envs=2, seed=0, max_episode_steps=4, time_per_step=0.1)) as env:
        check_env_specs(env)
        assert (env.task.max_episode_steps, env.task.time_per_step) == (4, 0.1)
        assert env.task.observation_sizes == {"joint": 1, "observation": 1}
        data = env.rollout(9, break_when_any_done=False)["next"]
        assert data["truncated"][0].flatten().nonzero().flatten().tolist() == [3, 7]
        assert data["reward"].dtype == torch.float32
        assert not env.task.can_resume
        assert env.task.resume_obstacle == "nothing says how to save the simulator of a Slide"
        assert env.task.state_dict() == {"copy0": {}, "copy1": {}}
        env.task.load_state_dict(env.task.state_dict())
        assert env.render(width=32, height=16).shape == (2, 16, 32, 3)
        assert env.render(width=32, height=16).min() == 7


def test_a_seed_repeats_it():
    starts = []
    for seed in (3, 3, 4, None, None):
        with closing(make_torchrl(Slide, num_envs=2, seed=seed)) as env:
            starts.append(env.reset()["observation"])
    assert torch.equal(starts[0], starts[1])
    assert len(torch.unique(torch.cat(starts[1:]), dim=0)) == 8


@pytest.mark.parametrize(
    ("factory", "resumes"),
    [
        (partial(GymEnv, "HalfCheetah-v5"), True),
        (partial(DMControlEnv, "reacher", "easy"), True),
        (lambda: TransformedEnv(GymEnv("HalfCheetah-v5"), StepCounter(30)), False),
    ],
)
def test_what_torchrl_wraps(factory, resumes):
    with closing(make_torchrl(factory, seed=0)) as env:
        check_env_specs(env)
        assert env.task.can_resume == resumes
        assert env.task.max_episode_steps == 1_000


def test_a_factory_by_its_import_path():
    with closing(make_torchrl("torchrl.envs:GymEnv", seed=0, env_name="Pendulum-v1")) as env:
        assert env.rollout(2)["observation"].shape == (1, 2, 3)
    with pytest.raises(ImportError, match=r"torchrl\.envs has no 'NoneSuch'"):
        make_torchrl("torchrl.envs:NoneSuch")


# What recipes ask.


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_env("hopper", num_envs=2, seed=0),
        lambda: make_gymnasium("Toy-v0", num_envs=2, seed=0),
        lambda: make_dm_control("reacher-easy", num_envs=2, seed=0),
        lambda: make_torchrl(Slide, num_envs=2, seed=0),
    ],
)
def test_every_kind_is_a_simulation(make):
    with closing(make()) as env:
        task = env.task
        assert task.num_envs == 2
        assert task.observation_sizes["observation"] == env.observation_spec["observation"].shape[-1]
        assert isinstance(task.max_episode_steps, int)
        assert 0 < task.time_per_step < 1
        low, high = task.reward_range
        assert low < high
        assert task.can_resume == (task.resume_obstacle == "")
        env.reset()
        task.load_state_dict(task.state_dict())
        assert callable(task.renderer)


def test_reward_ranges():
    for name, expected in (("cheetah-run", (0.0, 1.0)), ("lqr-lqr_2_1", (-math.inf, math.inf))):
        with closing(make_dm_control(name, seed=0)) as env:
            assert env.task.reward_range == expected


# Pictures.


def test_an_environment_without_mujoco_draws_itself():
    with closing(make_gymnasium("Toy-v0", num_envs=2, seed=0)) as env:
        env.reset()
        renderer = env.task.renderer(80, 60)
        one, other = renderer.frame(0), renderer.frame(1, trail=np.zeros((3, 3)))
        assert one.shape == (60, 80, 3)
        assert one.dtype == np.uint8
        assert (one != other).any()
        assert env.render(width=40, height=30).shape == (2, 30, 40, 3)
        with pytest.raises(ValueError, match="through no other camera, got 'side'"):
            env.render(camera="side")


def test_an_environment_that_cannot_be_drawn():
    class Blind(Toy):
        metadata: ClassVar = {"render_modes": ["ansi"]}

    gymnasium.register("Blind-v0", Blind)
    with (
        closing(make_gymnasium("Blind-v0", seed=0)) as env,
        pytest.raises(RuntimeError, match=r"cannot be drawn: .*\['ansi'\]"),
    ):
        env.task.renderer()
    pendulum = make_torchrl(partial(GymEnv, "Pendulum-v1"), seed=0)
    with closing(pendulum), pytest.raises(RuntimeError, match="not made with render_mode='rgb_array'"):
        pendulum.render()


# What cannot be driven.


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("CartPole-v1", {}, r"CartPole-v1 has discrete actions \(OneHot of shape \(2,\), int64\)"),
        ("Toy-v0", {"action_space": Discrete(3)}, r"Toy-v0 has discrete actions"),
        ("Toy-v0", {"action_space": Box(0, 5, (2,), np.int64)}, r"Toy-v0 has discrete actions .*int64"),
        (
            "Toy-v0",
            {"action_space": Box(-1, 1, (2, 2), np.float32)},
            r"actions of shape \(2, 2\), expected a vector",
        ),
        (
            "Toy-v0",
            {"observation_space": Box(0, 255, (8, 8, 3), np.uint8)},
            r"observes an image, 'pixels' .*\(8, 8, 3\), uint8",
        ),
        ("Toy-v0", {"observation_space": Discrete(4)}, r"discrete observation 'observation' \(OneHot"),
        (
            "Toy-v0",
            {"observation_space": Dict(a=Box(0, 1, (2,)), b=Discrete(3))},
            r"discrete observation 'b'",
        ),
    ],
)
def test_spaces_that_cannot_be_driven(name, options, message):
    with pytest.raises(ValueError, match=message):
        make_gymnasium(name, seed=0, disable_env_checker=True, **options)


def test_factories_of_what_cannot_be_driven():
    with pytest.raises(ValueError, match=r"nested observation \('raw', 'joint'\)"):
        make_torchrl(ToyArm)
    with pytest.raises(ValueError, match=r"environment of test_.*batch size \(3,\), expected one copy"):
        make_torchrl(lambda: Slide(batch_size=(3,)))
    with pytest.raises(ValueError, match=r"has the actions \[\('arm', 'motor'\)\], expected one, 'action'"):
        make_torchrl(lambda: Slide(action=Composite(arm=Composite(motor=Bounded(-1, 1, (2,))))))
