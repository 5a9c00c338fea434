"""Gymnasium's wrappers with maps from files and settings from JSON; who else takes them: TorchRL and Minari."""

import contextlib
import gc
import json
import sys

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import RecordEpisodeStatistics
from minari.dataset.minari_storage import MinariStorage
from torchrl.envs import GymWrapper, check_env_specs

import nht.envs  # noqa: F401 (registers the environment)
from nht import NHT, save_map
from nht.transforms import ActionMapVectorWrapper, ActionMapWrapper

WIPE = "nht/WAMWipe-v0"
KEYS = ["tool_position", "joint_angle"]
ACTION = np.array([0.3, -0.6], dtype=np.float32)


def wipe_map():
    return NHT(context_dim=10, actuation_dim=7, action_dim=2, hidden=(8,))


@pytest.fixture
def path(tmp_path):
    return save_map(wipe_map(), tmp_path / "map.safetensors")


def actuation(env, action=ACTION):
    env.reset(seed=0)
    return env.step(action)[-1]["actuation"]


@pytest.mark.parametrize("given", [str, lambda path: path])
def test_a_path_stands_for_its_map(path, given):
    wanted = actuation(ActionMapWrapper(gymnasium.make(WIPE), wipe_map(), KEYS))
    np.testing.assert_array_equal(
        actuation(ActionMapWrapper(gymnasium.make(WIPE), given(path), KEYS)), wanted
    )
    vector = ActionMapVectorWrapper(gymnasium.make_vec(WIPE, num_envs=2), given(path), KEYS)
    np.testing.assert_allclose(actuation(vector, np.stack([ACTION] * 2))[0], wanted, atol=1e-6)


def test_the_specification_goes_through_json_and_back(path):
    """All of it: scale, saturation, nested keys, and the wrappers around."""
    keys = [("joint_angle",), "tool_position"]
    env = RecordEpisodeStatistics(
        ActionMapWrapper(gymnasium.make(WIPE), path, keys, action_scale=np.float32(20.0), saturation="scale")
    )
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(actuation(again), actuation(env))
    assert np.abs(actuation(env)).max() == pytest.approx(2.0)  # the arm's limit: nothing else is on it
    assert (np.abs(actuation(env)) < 2.0).sum() == 6


def test_settings_of_a_configuration(path):
    """As configurations name wrappers: an import path and JSON values."""
    settings = json.loads(json.dumps({"map": str(path), "context_keys": KEYS, "action_scale": 1.5}))
    spec = gymnasium.spec(WIPE)
    wrapper = ActionMapWrapper.wrapper_spec(**settings)
    made = gymnasium.make(EnvSpec(**{**vars_of(spec), "additional_wrappers": (wrapper,)}))
    wanted = actuation(ActionMapWrapper(gymnasium.make(WIPE), wipe_map(), KEYS, action_scale=1.5))
    np.testing.assert_array_equal(actuation(made), wanted)


def vars_of(spec):
    return {name: value for name, value in vars(spec).items() if name not in ("namespace", "name", "version")}


def test_a_map_in_memory_makes_the_environment_again_but_is_no_json():
    env = RecordEpisodeStatistics(ActionMapWrapper(gymnasium.make(WIPE), wipe_map(), KEYS))
    np.testing.assert_array_equal(actuation(gymnasium.make(env.spec)), actuation(env))
    with pytest.raises(TypeError, match=r"is an object, which JSON cannot hold: save it, and give the path"):
        env.spec.to_json()


def test_an_environment_that_nobody_registered_has_no_specification(path):
    bare = gymnasium.make(WIPE).unwrapped
    bare.spec = None
    for map in (path, wipe_map()):
        assert ActionMapWrapper(bare, map, KEYS).spec is None


@pytest.mark.parametrize("stored", [True, False], ids=["file", "object"])
def test_a_minari_data_set_knows_the_environment_that_it_was_recorded_in(path, stored, tmp_path):
    """With a file; without, Minari warns in our words, and goes on."""
    env = ActionMapWrapper(gymnasium.make(WIPE), path if stored else wipe_map(), KEYS, action_scale=1.5)
    spaces = {"observation_space": env.observation_space, "action_space": env.action_space}
    told = contextlib.nullcontext()
    if not stored:
        told = pytest.warns(UserWarning, match="save it, and give the path of its file")
    with told:
        storage = MinariStorage.new(tmp_path, env_spec=env.spec, **spaces)
    assert ("env_spec" in storage.metadata) == stored
    if stored:
        again = gymnasium.make(EnvSpec.from_json(storage.metadata["env_spec"]))
        np.testing.assert_array_equal(actuation(again), actuation(env))


@pytest.mark.parametrize("floats", [torch.float16, torch.bfloat16])
def test_maps_of_half_precision(floats, tmp_path):
    """NumPy has no bfloat16: such a map takes actions of single precision."""
    path = save_map(wipe_map().to(floats), tmp_path / "half.safetensors")
    env = ActionMapWrapper(gymnasium.make(WIPE), path, KEYS)
    kind = np.float16 if floats is torch.float16 else np.float32
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (2,), kind)
    exact = actuation(ActionMapWrapper(gymnasium.make(WIPE), wipe_map(), KEYS))
    assert actuation(env).dtype == np.float32
    np.testing.assert_allclose(actuation(env, ACTION.astype(kind)), exact, atol=0.05)


def test_a_class_of_ones_own_is_imported_if_allowed(tmp_path, monkeypatch):
    (tmp_path / "own_map_module.py").write_text("from nht import SVD\n\n\nclass Own(SVD):\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    from own_map_module import Own

    path = save_map(Own(7, 2), tmp_path / "own.safetensors")
    del Own, sys.modules["own_map_module"]
    gc.collect()  # the class, or it would be found in memory
    with pytest.raises(ValueError, match="own_map_module"):
        ActionMapWrapper(gymnasium.make(WIPE), path)
    env = ActionMapWrapper(gymnasium.make(WIPE), path, allow=["own_map_module"])
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    np.testing.assert_array_equal(actuation(again), actuation(env))


# TorchRL around the wrappers.


def test_torchrl_takes_the_wrapper():
    env = GymWrapper(ActionMapWrapper(gymnasium.make(WIPE), wipe_map(), KEYS))
    check_env_specs(env)
    assert env.action_spec.shape == (2,)
    assert env.rollout(5)["action"].shape == (5, 2)


@pytest.mark.parametrize("mode", [AutoresetMode.SAME_STEP, AutoresetMode.DISABLED])
def test_torchrl_takes_the_vector_wrapper(mode):
    vector = gymnasium.make_vec(WIPE, num_envs=2, max_episode_steps=4, autoreset_mode=mode)
    env = GymWrapper(ActionMapVectorWrapper(vector, wipe_map(), KEYS))
    check_env_specs(env)
    data = env.rollout(10, break_when_any_done=False)
    assert data["action"].shape == (2, 10, 2)
    assert data["next", "done"].sum() == 4
    if mode is AutoresetMode.SAME_STEP:  # in this mode TorchRL reads info
        context = torch.cat([data[key] for key in KEYS], -1)
        limit = torch.full((7,), 2.0)
        expected = wipe_map().decode(data["action"], context.float(), -limit, limit).detach()
        torch.testing.assert_close(data["next", "actuation"].float(), expected, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("mode", AutoresetMode)
def test_autoreset_modes_may_be_given_as_text(mode):
    vector = SyncVectorEnv([lambda: gymnasium.make(WIPE, max_episode_steps=2)] * 2, autoreset_mode=mode)
    vector.metadata = {**vector.metadata, "autoreset_mode": mode.value}
    env = ActionMapVectorWrapper(vector, wipe_map(), KEYS)
    assert env.autoreset_mode is mode
    env.reset(seed=[0, 1])
    actions = np.stack([ACTION] * 2)
    executed = [env.step(actions)[-1]["_actuation"].all() for _ in range(2)]
    assert executed == [True, True]
    if mode is not AutoresetMode.DISABLED:
        assert env.step(actions)[-1]["_actuation"].all() == (mode is AutoresetMode.SAME_STEP)
