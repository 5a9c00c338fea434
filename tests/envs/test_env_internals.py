"""Contracts: the parts of other libraries that are not public still are what ``nht.envs`` relies on."""

import gymnasium
import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, Unbounded
from torchrl.envs import DMControlEnv, EnvBase, GymEnv, SerialEnv

from nht.envs import gymnasium_internals as of_gymnasium
from nht.envs import torchrl_internals as of_torchrl
from nht.envs.dm_control import MISSING
from nht.envs.dm_control_internals import SuiteClock


class Small(of_torchrl.WholeSteps):
    """Returns what it is told to, be it whole or not."""

    def __init__(self):
        super().__init__()
        self.observation_spec = Composite(x=Unbounded((1,)))
        self.action_spec = self.reward_spec = Unbounded((1,))
        self.outcome = TensorDict({"x": torch.zeros(1)})

    def _reset(self, tensordict=None, **_):
        return self.full_done_spec.zero().set("x", torch.zeros(1))

    def _step(self, tensordict):
        return self.outcome

    def _set_seed(self, seed): ...


def test_torchrl_hands_what_a_step_returns_to_step_proc_data():
    env = Small()
    stepped = env.step(env.reset().set("action", torch.zeros(1)))
    assert set(stepped["next"].keys()) == {"x"}, "TorchRL adds nothing"
    assert "done" in EnvBase._step_proc_data(env, env.outcome.set("reward", torch.zeros(1)))


def test_tensordict_packs_without_looking():
    values = torch.zeros(2, 3)
    packed = of_torchrl.packed({"x": values}, torch.Size([2]), torch.device("cpu"))
    assert type(packed) is TensorDict
    assert packed.batch_size == (2,)
    assert packed.device == torch.device("cpu")
    assert packed["x"].data_ptr() == values.data_ptr()


def test_torchrls_wrappers_know_what_they_wrap():
    assert isinstance(of_torchrl.wrapped(GymEnv("Pendulum-v1")), gymnasium.Env)
    assert hasattr(of_torchrl.wrapped(DMControlEnv("reacher", "easy")), "physics")


def test_a_serial_env_knows_its_members():
    env = SerialEnv(3, Small)
    env.start()
    members = of_torchrl.members(env)
    assert [type(member) for member in members] == [Small] * 3
    env.close()


def test_gymnasiums_clock():
    env = gymnasium.make("Pendulum-v1", max_episode_steps=7)
    clock = of_gymnasium.EpisodeClock(env)
    assert clock.limit == 7
    env.reset(seed=0)
    env.step(env.action_space.sample())
    assert clock.steps == 1
    clock.steps = 6
    assert env.step(env.action_space.sample())[3], "truncated"
    without = of_gymnasium.EpisodeClock(env.unwrapped)
    without.steps = 3
    assert (without.limit, without.steps) == (None, None)


def test_gymnasiums_generator():
    env = gymnasium.make("Pendulum-v1").unwrapped
    assert vars(env).get(of_gymnasium.GENERATOR) is None
    generator = env.np_random
    assert vars(env)[of_gymnasium.GENERATOR] is generator


@pytest.mark.parametrize(
    ("domain", "task", "limit"), [("reacher", "easy", 1_000), ("lqr", "lqr_2_1", float("inf"))]
)
def test_the_suites_clock(domain, task, limit):
    suite = pytest.importorskip("dm_control.suite", reason=MISSING)
    env = suite.load(domain, task, task_kwargs={"random": 0})
    clock = SuiteClock(env)
    assert clock.limit == limit
    assert clock.ended
    env.reset()
    env.step([0.0] * env.action_spec().shape[0])
    assert (clock.steps, clock.ended) == (1, False)
    if limit < float("inf"):
        clock.steps = 999
        assert env.step([0.0, 0.0]).last()
        assert clock.ended
    clock.ended = True
    assert env.step([0.0] * env.action_spec().shape[0]).first()
