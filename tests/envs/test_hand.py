"""The Adroit hand, and other MuJoCo environments of Gymnasium, through TorchRL's wrapper and through maps."""

import math
import sys
from contextlib import closing

import gymnasium
import pytest
import torch
from torchrl.envs.utils import check_env_specs

import nht
from nht.envs import make_gymnasium
from nht.recipes.agents.returns import reward_range
from nht.recipes.config import DDPG
from nht.recipes.launch import configure
from nht.recipes.run.environments import check_env, mapped_env
from nht.recipes.sections import EnvConfig

SIZES = {"AdroitHandRelocate-v1": (39, 30), "AdroitHandDoor-v1": (39, 28)}

pytestmark = pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")


@pytest.fixture(params=[*SIZES, "HalfCheetah-v5"], scope="module")
def env(request):
    with closing(make_gymnasium(request.param, num_envs=2, seed=0)) as env:
        env.asked_for = request.param
        yield env


def hand_made_demos(env, episodes=6, steps=40, synergies=3, seed=0):
    """Nobody's skill: the motors follow a few directions, whose strengths come and go smoothly; and some tremor."""
    generator = torch.Generator().manual_seed(seed)
    n = env.action_spec.shape[-1]
    directions = torch.linalg.qr(torch.randn(n, synergies, generator=generator)).Q
    clock = torch.arange(steps)[:, None] / steps
    rows = []
    for episode in range(episodes):
        phase = torch.rand(synergies, generator=generator)
        strength = 0.8 * torch.sin(2 * math.pi * (clock + phase))
        current = env.reset()
        tremor = 0.02 * torch.randn(steps, n, generator=generator)
        for actuation in strength @ directions.mT + tremor:
            frame, current = env.step_and_maybe_reset(current.set("action", actuation.expand(2, -1).clone()))
            rows.append((frame["observation"][0], actuation, torch.tensor(episode)))
    context, actuation, index = (torch.stack(column) for column in zip(*rows, strict=True))
    return nht.Demos.from_tensors(context={"observation": context}, actuation=actuation, episode=index)


def test_specs(env):
    check_env_specs(env)
    data = env.rollout(3)["next"]
    assert data["observation"].dtype == data["reward"].dtype == torch.float32
    assert all(data[flag].shape == (2, 3, 1) for flag in ("success", "failure", "diverged"))
    assert env.task.observation_sizes["observation"] == SIZES.get(env.asked_for, (17, 6))[0]
    assert env.action_spec.shape == (2, SIZES.get(env.asked_for, (17, 6))[1])
    assert reward_range(env) == (-math.inf, math.inf)


def test_episodes_are_gymnasiums_own(env):
    env.set_seed(5)
    theirs = gymnasium.make(env.asked_for)
    theirs.reset(seed=5)  # TorchRL's seeding makes one
    current = env.reset()
    assert current["observation"][0].numpy() == pytest.approx(theirs.reset()[0], rel=1e-6, abs=1e-6)
    for _ in range(4):
        action = env.full_action_spec.rand()["action"]
        frame, current = env.step_and_maybe_reset(current.set("action", action))
        observation, reward, *_, info = theirs.step(action[0].numpy())
        assert frame["next", "observation"][0].numpy() == pytest.approx(observation, rel=1e-5, abs=1e-5)
        assert frame["next", "reward"][0].item() == pytest.approx(reward, rel=1e-5)
        assert frame["next", "success"][0].item() == info.get("success", False)


def test_success_is_what_the_environment_says(monkeypatch):
    with closing(make_gymnasium("AdroitHandRelocate-v1", seed=0)) as env:
        core = env.task.copies[0].core
        current = env.rand_action(env.reset())
        core.model.site_pos[core.target_obj_site_id] = core.data.xpos[core.obj_body_id]  # the ball is there
        assert env.step(current)["next", "success"].all()
        assert not env.reset()["success"].any()


def test_going_on_from_a_saved_state_is_exact(env):
    current = env.rollout(3, break_when_any_done=False)[:, -1]["next"].exclude("reward")
    saved, actions = env.task.state_dict(), [env.full_action_spec.rand()["action"] for _ in range(4)]

    def play():
        tensordict = current.clone()
        frames = []
        for action in actions:
            frame, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
            frames.append(frame["next", "observation"].clone())
        return torch.stack([*frames, env.reset()["observation"]])

    first = play()
    env.rollout(5)
    env.task.load_state_dict(saved)
    assert torch.equal(play(), first)


@pytest.mark.parametrize("action_dim", [2, 9])
def test_the_hand_is_driven_through_a_map_of_its_demonstrations(action_dim):
    config = EnvConfig("AdroitHandRelocate-v1", "gymnasium", ["observation"], num_envs=2)
    with closing(make_gymnasium(config.name, num_envs=2)) as env:
        demos = hand_made_demos(env)
    energy = torch.linalg.svdvals(demos.actuation).square()
    assert energy[:3].sum() / energy.sum() > 0.98
    map = nht.NHT(39, 30, action_dim, hidden=(32,))
    metrics = nht.train_map(demos, map, context_keys=["observation"], max_steps=200).metrics
    assert metrics["validation_error"] < 1.0
    with closing(mapped_env(config, map, seed=0)) as driven:
        data = driven.rollout(5)
    assert data["action"].shape == (2, 5, action_dim)
    assert data["next", "actuation"].shape == (2, 5, 30)


def test_presets_and_raw_motors():
    for preset, name in [("adroit_relocate", "AdroitHandRelocate-v1"), ("adroit_door", "AdroitHandDoor-v1")]:
        config = configure(DDPG, "ddpg", [f"env={preset}", "map=none"]).env
        assert (config.suite, config.name) == ("gymnasium", name)
        assert check_env(config) == SIZES[name][1]


# Bad input.


def test_unknown_names():
    with pytest.raises(ValueError, match=r"no environment 'AdroitHandRelocat-v1'; .*'AdroitHandRelocate-v1'"):
        make_gymnasium("AdroitHandRelocat-v1", seed=0)


def test_an_extra_that_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium_robotics", None)
    monkeypatch.setattr(gymnasium, "registry", {})
    with pytest.raises(ImportError, match=r"pip install 'nht\[hand\]'"):
        make_gymnasium("AdroitHandDoor-v1", seed=0)
