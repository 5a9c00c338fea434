"""Action maps around Gymnasium environments, single and vectors, against TorchRL's transform and by their laws."""

import copy
import re

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Box, Dict, Discrete
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as vector_wrappers
from stable_baselines3 import DDPG, PPO
from stable_baselines3.common.env_checker import check_env as check_for_stable_baselines
from stable_baselines3.common.vec_env import DummyVecEnv
from torchrl.envs import TransformedEnv

from nht import NHT, SVD, Identity, save_map
from nht.envs import make_env
from nht.transforms import ActionMapTransform, ActionMapVectorWrapper, ActionMapWrapper

WIPE = "nht/WAMWipe-v0"
WIPE_KEYS = ["tool_position", "joint_angle"]
LIMIT, SCALE = 0.8, 1.5  # of each actuation, less than the scale: some are clipped


def wipe_map():
    torch.manual_seed(0)
    return NHT(context_dim=10, actuation_dim=7, action_dim=2, hidden=(16,))


def wrapped_wipe(**options):
    return ActionMapWrapper(gymnasium.make(WIPE, **options), wipe_map(), WIPE_KEYS, action_scale=SCALE)


class Toy(gymnasium.Env):
    """Three joints that move as far as they are told; what is observed and what stands in info is up to tests.

    Args:
        observed: keys of a Dict observation, or None for the whole as one array.
        length: steps in an episode.
        dtype: of the action space and the joints.
    """

    def __init__(self, observed=None, length=4, dtype=np.float32):
        self.observed, self.length, self.dtype = observed, length, dtype
        self.action_space = Box(-LIMIT, LIMIT, (3,), dtype)
        joint = Box(-np.inf, np.inf, (3,), dtype)
        spaces = {"joint": joint, "arm": Dict(tool=Box(-1, 1, (2,), dtype)), "count": Discrete(100)}
        self.observation_space = joint if observed is None else Dict({key: spaces[key] for key in observed})

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.joint = self.np_random.normal(size=3).astype(self.dtype)
        self.count = 0
        return self.observe()

    def observe(self, **more):
        everything = {
            "joint": self.joint.copy(),
            "arm": {"tool": np.cos(self.joint[:2])},
            "count": self.count,
        }
        info = {"height": float(self.joint.sum()), "raw": {"joint": 2 * self.joint}, "name": "toy", **more}
        if self.observed is None:
            return self.joint.copy(), info
        return {key: everything[key] for key in self.observed}, info

    def step(self, action):
        assert action.dtype == self.dtype
        self.joint = self.joint + action
        self.count += 1
        observation, info = self.observe(received=action.copy())
        action[:] = 0.0  # what callers hand over they must not need again
        return observation, 0.0, False, self.count >= self.length, info


def expected_actuation(map, action, context, dtype=np.float32):
    with torch.no_grad():
        actuation = map(torch.as_tensor(action) * SCALE, torch.as_tensor(context, dtype=torch.float32))
    return actuation.numpy().astype(dtype).clip(-LIMIT, LIMIT)


# Agreement with TorchRL's transform.


def test_an_episode_equals_that_of_the_transform():
    scale = 4.0  # beyond the joints' speed: some are clipped
    batched = TransformedEnv(
        make_env("wam_wipe", seed=3), ActionMapTransform(wipe_map(), WIPE_KEYS, action_scale=scale)
    )
    env = ActionMapWrapper(gymnasium.make(WIPE, seed=3), wipe_map(), WIPE_KEYS, action_scale=scale)
    tensordict = batched.reset()
    observation, _ = env.reset()
    env.action_space.seed(0)
    clipped = 0
    for _ in range(200):
        np.testing.assert_allclose(observation, tensordict["observation"][0], atol=1e-5)
        action = env.action_space.sample()
        tensordict = batched.step(tensordict.set("action", torch.tensor(action)[None]))["next"]
        observation, reward, terminated, truncated, info = env.step(action)
        np.testing.assert_allclose(info["actuation"], tensordict["actuation"][0], atol=1e-5)
        assert (reward, terminated, truncated, info["failure"]) == tuple(
            tensordict[key].item() for key in ("reward", "terminated", "truncated", "failure")
        )
        clipped += (np.abs(info["actuation"]) == 2.0).any()
    assert truncated
    assert 20 < clipped < 180


def test_a_vector_equals_the_transform():
    options = {"seed": 3, "max_episode_steps": 15}
    batched = TransformedEnv(
        make_env("wam_wipe", num_envs=3, **options),
        ActionMapTransform(wipe_map(), WIPE_KEYS, action_scale=SCALE),
    )
    vector = gymnasium.make_vec(WIPE, num_envs=3, autoreset_mode=AutoresetMode.SAME_STEP, **options)
    env = ActionMapVectorWrapper(vector, wipe_map(), WIPE_KEYS, action_scale=SCALE)
    tensordict = batched.reset()
    observations, _ = env.reset()
    env.action_space.seed(0)
    for _ in range(40):
        np.testing.assert_allclose(observations, tensordict["observation"], atol=1e-5)
        actions = env.action_space.sample()
        frame, tensordict = batched.step_and_maybe_reset(tensordict.set("action", torch.tensor(actions)))
        observations, rewards, _, truncations, infos = env.step(actions)
        np.testing.assert_allclose(infos["actuation"], frame["next", "actuation"], atol=1e-5)
        assert infos["_actuation"].all()
        np.testing.assert_array_equal(rewards.astype(np.float32), frame["next", "reward"][:, 0])
        np.testing.assert_array_equal(truncations, frame["next", "truncated"][:, 0])


# Where the context stands.


@pytest.mark.parametrize(
    ("observed", "keys"),
    [
        (None, ["observation"]),
        (None, ["height", "observation"]),
        (None, [("raw", "joint")]),
        (["joint", "arm"], [("arm", "tool"), "joint"]),
        (["joint"], [("raw", "joint"), "height", "joint"]),
    ],
)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_context_is_read_from_the_observation_or_info(observed, keys, dtype):
    def read(observation, info):
        entries = observation if isinstance(observation, dict) else {"observation": observation}
        found = {**info, **entries}
        parts = [found[key] if isinstance(key, str) else found[key[0]][key[1]] for key in keys]
        return np.concatenate([np.atleast_1d(part) for part in parts])

    base = Toy(observed, dtype=dtype)
    map = NHT(read(*base.reset(seed=0)).size, 3, 2, hidden=(8,))
    env = ActionMapWrapper(base, map, keys, action_scale=SCALE, saturation="clip")
    assert env.action_space == Box(-1, 1, (2,), np.float32)
    env.action_space.seed(0)
    context = read(*env.reset(seed=1))
    for _ in range(4):
        action = env.action_space.sample()
        observation, *_, info = env.step(action)
        expected = expected_actuation(map, action, context, dtype)
        np.testing.assert_allclose(info["actuation"], expected, atol=1e-6)
        np.testing.assert_array_equal(info["actuation"], info["received"])
        assert info["actuation"].dtype == dtype
        context = read(observation, info)


def test_a_map_without_a_context():
    env = ActionMapWrapper(Toy(), Identity(3), action_scale=0.5)
    env.reset(seed=0)
    info = env.step(np.array([1.0, -0.4, 0.0], dtype=np.float32))[-1]
    np.testing.assert_allclose(info["actuation"], [0.5, -0.2, 0.0])


def test_the_maps_own_keys_and_scale_are_the_default(tmp_path):
    map = wipe_map()
    map.context_keys = tuple(WIPE_KEYS)
    map.action_scale.fill_(SCALE)
    save_map(map, tmp_path / "map.safetensors")
    envs = [
        wrapped_wipe(),
        ActionMapWrapper(gymnasium.make(WIPE), map),
        ActionMapWrapper.from_file(gymnasium.make(WIPE), tmp_path / "map.safetensors"),
    ]
    vector = ActionMapVectorWrapper.from_file(
        gymnasium.make_vec(WIPE, num_envs=1), tmp_path / "map.safetensors", action_scale=2 * SCALE
    )
    for parameter in map.parameters():
        parameter.data.zero_()  # the wrappers have copies
    action = np.array([0.3, -0.6], dtype=np.float32)
    for env in (*envs, vector):
        env.reset(seed=0)
    first, *others = [env.step(action)[-1]["actuation"] for env in envs]
    for other in (*others, vector.step(action[None] / 2)[-1]["actuation"][0]):
        np.testing.assert_allclose(other, first, atol=1e-6)


# Vectors.


def toys(observed, mode, lengths=(3, 5)):
    return SyncVectorEnv([lambda n=n: Toy(observed, n) for n in lengths], autoreset_mode=mode)


@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
@pytest.mark.parametrize(
    ("observed", "keys"),
    [
        (None, ["observation", "height"]),
        (["joint", "arm"], [("arm", "tool"), "joint"]),
        (None, [("raw", "joint")]),
    ],
)
def test_a_wrapped_vector_equals_a_vector_of_wrapped(observed, keys, mode):
    map = NHT({1: 3, 2: 4}[len(keys)] + ("joint" in keys), 3, 2, hidden=(8,))
    outside = ActionMapVectorWrapper(toys(observed, mode), map, keys, action_scale=SCALE)
    makers = [lambda n=n: ActionMapWrapper(Toy(observed, n), map, keys, action_scale=SCALE) for n in (3, 5)]
    inside = SyncVectorEnv(makers, autoreset_mode=mode)
    assert outside.action_space == inside.action_space
    assert outside.single_action_space == inside.single_action_space
    outside.reset(seed=0)
    inside.reset(seed=0)
    outside.action_space.seed(0)
    waits = 0
    for _ in range(14):
        actions = outside.action_space.sample()
        ours, theirs = outside.step(actions), inside.step(actions)
        for left, right in zip(leaves(ours[0]), leaves(theirs[0]), strict=True):
            np.testing.assert_allclose(left, right, atol=1e-6)
        np.testing.assert_array_equal(ours[3], theirs[3])
        infos, their_infos = ours[-1], theirs[-1]
        if mode is AutoresetMode.NEXT_STEP:  # the other mode has it in final_info
            np.testing.assert_array_equal(
                infos["_actuation"], their_infos.get("_actuation", np.zeros(2, dtype=bool))
            )
        mask = their_infos.get("_actuation", np.zeros(2, dtype=bool))
        if mask.any():
            np.testing.assert_allclose(infos["actuation"][mask], their_infos["actuation"][mask], atol=1e-6)
        assert not infos["actuation"][~infos["_actuation"]].any()
        waits += (~infos["_actuation"]).sum()
    assert waits == (5 if mode is AutoresetMode.NEXT_STEP else 0)


def leaves(observation):
    if not isinstance(observation, dict):
        return [observation]
    return [leaf for value in observation.values() for leaf in leaves(value)]


@pytest.mark.parametrize("keys", [["observation"], [("raw", "joint")]])
def test_a_masked_reset_changes_the_context_of_its_rows_only(keys):
    map = NHT(3, 3, 2, hidden=(8,))
    env = ActionMapVectorWrapper(
        toys(None, AutoresetMode.DISABLED), map, keys, action_scale=SCALE, saturation="clip"
    )
    mask = np.array([True, False])
    with pytest.raises(ResetNeeded, match="first reset must be of all copies"):
        env.reset(options={"reset_mask": mask})
    env.reset(seed=0)
    actions = np.array([[0.2, 0.1], [-0.3, 0.2]], dtype=np.float32)
    env.step(actions)
    env.reset(options={"reset_mask": mask})
    context = np.stack([toy.joint for toy in env.unwrapped.envs]) * (1 if keys == ["observation"] else 2)
    actuation = env.step(actions)[-1]["actuation"]
    np.testing.assert_allclose(actuation, expected_actuation(map, actions, context), atol=1e-6)


def test_gymnasiums_wrappers_around_it():
    vector = gymnasium.make_vec(WIPE, num_envs=2, max_episode_steps=5)
    env = ActionMapVectorWrapper(vector, wipe_map(), WIPE_KEYS)
    env = vector_wrappers.NormalizeObservation(vector_wrappers.RecordEpisodeStatistics(env))
    env.reset(seed=0)
    lengths = []
    for _ in range(12):
        *_, infos = env.step(env.action_space.sample())
        lengths += infos["episode"]["l"].tolist() if "episode" in infos else []
    assert lengths == [5] * 4


# Checkers, specs, what is passed on.


@pytest.mark.filterwarnings("error")
def test_passes_stable_baselines3s_checker_without_a_warning():
    check_for_stable_baselines(wrapped_wipe())


@pytest.mark.filterwarnings("ignore:.*(different from the unwrapped|value is -?infinity):UserWarning")
@pytest.mark.filterwarnings("error")
def test_passes_gymnasiums_checker():
    check_env(wrapped_wipe(), skip_render_check=True)


def test_gymnasium_makes_it_again_from_its_spec():
    env = wrapped_wipe(start="random")
    again = gymnasium.make(env.spec)
    action = np.array([0.3, -0.6], dtype=np.float32)
    for one in (env, again):
        one.reset(seed=0)
    np.testing.assert_array_equal(env.step(action)[0], again.step(action)[0])


def test_an_action_that_is_not_a_number_is_passed_on():
    env = wrapped_wipe()
    env.reset(seed=0)
    _, _, terminated, _, info = env.step(np.array([np.nan, 0.1], dtype=np.float32))
    assert np.isnan(info["actuation"]).any()
    assert terminated
    assert info["diverged"]


def test_copies_go_their_own_ways():
    env = wrapped_wipe()
    env.reset(seed=0)
    twin = ActionMapWrapper(gymnasium.make(WIPE), copy.deepcopy(wipe_map()), WIPE_KEYS, action_scale=SCALE)
    twin.reset(seed=0)
    action = np.array([0.3, -0.6], dtype=np.float32)
    twin.step(action)
    first = env.step(action)[-1]["actuation"]
    second = env.step(action)[-1]["actuation"]
    assert not np.array_equal(first, second), "the context moves on"


# Learning.


def assert_learned(algorithm, before, steps):
    assert algorithm.num_timesteps >= steps
    after = algorithm.policy.state_dict()
    assert all(values.isfinite().all() for values in after.values())
    changed = {key for key, values in after.items() if not torch.equal(values, before[key])}
    assert {
        key for key in after if key.startswith(("actor", "critic.", "action_net", "value_net"))
    } <= changed


def test_stable_baselines3_ddpg_learns_on_it():
    env = wrapped_wipe(start="random", max_episode_steps=50)
    policy = {"net_arch": [32, 32]}
    algorithm = DDPG("MlpPolicy", env, learning_starts=50, batch_size=32, policy_kwargs=policy, seed=0)
    before = copy.deepcopy(algorithm.policy.state_dict())
    algorithm.learn(300)
    assert algorithm.replay_buffer.actions.shape[-1] == 2
    assert_learned(algorithm, before, 300)


def test_stable_baselines3_ppo_learns_on_two_of_it():
    env = DummyVecEnv([lambda: wrapped_wipe(start="random", max_episode_steps=50)] * 2)
    policy = {"net_arch": [32, 32]}
    algorithm = PPO("MlpPolicy", env, n_steps=64, batch_size=32, n_epochs=2, policy_kwargs=policy, seed=0)
    before = copy.deepcopy(algorithm.policy.state_dict())
    algorithm.learn(256)
    assert_learned(algorithm, before, 256)


# Bad input.


@pytest.mark.parametrize(
    ("error", "message", "make"),
    [
        (
            TypeError,
            "map must be an nht.ActionMap, or the path of a map's file, got Linear.",
            lambda: (Toy(), torch.nn.Linear(3, 3)),
        ),
        (ValueError, "context_keys must name .* context of 3", lambda: (Toy(), NHT(3, 3, 2))),
        (ValueError, "positive, finite number, got -1", lambda: (Toy(), SVD(3, 2), None, -1.0)),
        (
            ValueError,
            "drives 7 actuators, the environment's actions have the shape (3,)",
            lambda: (Toy(), SVD(7, 2)),
        ),
        (
            TypeError,
            "the environment's actions are not continuous: Discrete(2)",
            lambda: (gymnasium.make("CartPole-v1"), SVD(3, 2)),
        ),
        (
            ValueError,
            "context has 5 entries, the context keys 3 ('observation': 3)",
            lambda: (Toy(), NHT(5, 3, 2), ["observation"]),
        ),
        (
            TypeError,
            "context key 'count' must be of floats, got int64",
            lambda: (Toy(["count"]), NHT(1, 3, 2), ["count"]),
        ),
    ],
)
def test_at_construction(error, message, make):
    env, map, keys, scale = (*make(), None, None)[:4]
    pattern = message if ".*" in message else re.escape(message)
    with pytest.raises(error, match=pattern):
        ActionMapWrapper(env, map, keys, action_scale=scale)


@pytest.mark.parametrize(
    ("error", "message", "observed", "keys", "width"),
    [
        (
            KeyError,
            "no context key 'goal': the observation has ['joint', 'arm'], info has ['height', 'raw', 'name']",
            ["joint", "arm"],
            ["goal"],
            3,
        ),
        (
            KeyError,
            "no context key ('raw', 'tool'): the observation has ['observation']",
            None,
            [("raw", "tool")],
            3,
        ),
        (
            ValueError,
            "context has 5 entries, the context keys 4 ('height': 1, 'joint': 3)",
            ["joint"],
            ["height", "joint"],
            5,
        ),
        (TypeError, "context key 'name' must be of floats, got <U3", None, ["name"], 1),
        (TypeError, "context key 'raw' must be of floats, got object", None, ["raw"], 3),
    ],
)
def test_at_the_first_reset(error, message, observed, keys, width):
    env = ActionMapWrapper(Toy(observed), NHT(width, 3, 2), keys)
    with pytest.raises(error, match=re.escape(message)):
        env.reset()


def test_a_vector_belongs_into_the_other_wrapper():
    with pytest.raises(TypeError, match="ActionMapVectorWrapper is for vector environments"):
        ActionMapWrapper(gymnasium.make_vec(WIPE, num_envs=2), wipe_map(), WIPE_KEYS)
    with pytest.raises(TypeError, match=r"VectorEnv"):
        ActionMapVectorWrapper(gymnasium.make(WIPE), wipe_map(), WIPE_KEYS)


def test_entries_of_a_vector_have_a_row_for_each_copy():
    message = r"context key 'goal' must have the shape \(2, width\), got \(3, 1\)"
    env = ActionMapVectorWrapper(gymnasium.make_vec(WIPE, num_envs=2), NHT(1, 7, 2), ["goal"])
    bad = {"goal": np.zeros((3, 1), dtype=np.float32)}
    with pytest.raises(ValueError, match=message):
        env._mapping.context(np.zeros((2, 16)), bad)


def test_a_copy_without_the_entry_is_named():
    class Reticent(Toy):
        def observe(self, **more):
            observation, info = super().observe(**more)
            return (observation, {}) if self.length == 5 else (observation, info)

    vector = SyncVectorEnv([lambda n=n: Reticent(None, n) for n in (3, 5)])
    env = ActionMapVectorWrapper(vector, NHT(1, 3, 2), ["height"])
    with pytest.raises(KeyError, match=r"info has no 'height' of the copies \[1\]"):
        env.reset()


def test_wrong_steps():
    action = np.zeros(2, dtype=np.float32)
    env = wrapped_wipe()
    with pytest.raises(ResetNeeded, match="call reset before the first step"):
        env.step(action)
    env.reset()
    with pytest.raises(ValueError, match=r"expected an action of shape \(2,\), got \(7,\)"):
        env.step(np.zeros(7, dtype=np.float32))
    vector = ActionMapVectorWrapper(gymnasium.make_vec(WIPE, num_envs=3), wipe_map(), WIPE_KEYS)
    vector.reset()
    with pytest.raises(ValueError, match=r"expected an action of shape \(3, 2\), got \(2,\)"):
        vector.step(action)
