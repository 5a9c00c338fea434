"""ActionMapTransform on a single environment: specs, data, the way back, copies of it, and errors."""

import copy
import pickle

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import (
    Bounded,
    LazyMemmapStorage,
    LazyTensorStorage,
    ReplayBuffer,
    Unbounded,
)
from torchrl.envs import GymEnv, SerialEnv, TransformedEnv, check_env_specs

from nht import NHT, SVD, Identity, save_map
from nht.transforms import ActionMapTransform
from toy_envs import (
    CONTEXT_KEYS,
    LIMIT,
    SCALE,
    ToyArm,
    ToyTeam,
    assert_mapped,
    mapped_arm,
    toy_map,
    toy_transform,
)

both_batch_sizes = pytest.mark.parametrize("rows", [(), (3,)], ids=["single", "batched"])


@both_batch_sizes
def test_specs_and_data(rows):
    env = mapped_arm(rows)
    assert env.action_spec == Bounded(-1, 1, (*rows, 2), dtype=torch.float32)
    assert env.observation_spec["context"] == Unbounded((*rows, 5))
    assert env.observation_spec["actuation"] == Unbounded((*rows, 3))
    check_env_specs(env)
    data = env.rollout(30, break_when_any_done=False)
    assert_mapped(data)
    assert data["action"].shape == (*rows, 30, 2)
    assert data["action"].abs().max() > 0.9
    assert data["next", "done"].any()


def test_some_actuations_are_clipped_to_the_environments_own_bounds():
    size = mapped_arm((3,)).rollout(50, break_when_any_done=False)["next", "actuation"].abs()
    assert size.max() == LIMIT
    assert (size < LIMIT).any()


def test_rand_action_fills_the_policys_spec():
    env = mapped_arm((500,))
    action = env.rand_action(env.reset())["action"]
    assert action.shape == (500, 2)
    assert action.min() < -0.95
    assert action.max() > 0.95
    assert env.action_spec.is_in(action)


def test_at_the_root_stands_the_actuation_of_the_step_before_and_zero_after_a_reset():
    data = mapped_arm((3,)).rollout(30, break_when_any_done=False)
    fresh = data["step"].squeeze(-1) == 0
    assert fresh.sum() > 3
    assert not data["actuation"][fresh].any()
    previous, later = data["next", "actuation"][:, :-1], data["actuation"][:, 1:]
    assert torch.equal(later[~fresh[:, 1:]], previous[~fresh[:, 1:]])


def test_a_partial_reset_touches_its_rows_only():
    env = mapped_arm((3,))
    before = env.rand_step(env.reset())["next"].exclude("reward")
    mask = torch.tensor([[True], [False], [True]])
    after = env.reset(before.clone().set("_reset", mask))
    for key in ("context", "actuation"):
        assert torch.equal(after[key][1], before[key][1])
        assert not torch.isclose(after[key][0], before[key][0]).any()
    assert not after["actuation"][[0, 2]].any()
    assert torch.equal(after["context"], torch.cat([after["raw", key] for key in CONTEXT_KEYS], -1))


def test_inverse_transforms_do_not_run_at_reset(monkeypatch):
    env = mapped_arm((3,))
    data = env.rand_step(env.reset())["next"]
    monkeypatch.setattr(env.transform, "_inv_call", lambda tensordict: pytest.fail("inverted at reset"))
    env.reset()
    env.reset(data.set("_reset", torch.ones(3, 1, dtype=torch.bool)))


def test_the_context_is_a_copy():
    env = TransformedEnv(ToyArm((2,), reuse_buffers=True), toy_transform())
    data = env.rollout(6, break_when_any_done=False)
    assert not torch.equal(data["joint"], data["raw", "joint"])
    assert_mapped(data)


def test_the_module_keeps_no_state():
    env = mapped_arm((3,))
    data = env.rollout(3)
    before = dict(vars(env.transform)), dict(env.transform.named_buffers())
    env.rollout(3)
    after = dict(vars(env.transform)), dict(env.transform.named_buffers())
    for old, new in zip(before, after, strict=True):
        assert old.keys() == new.keys()
        assert all(old[name] is new[name] for name in old)
    # Rows of another time, in another batch, are as good as those just seen.
    again = env.transform.inv(data.reshape(-1))
    torch.testing.assert_close(again["action"], data["next", "actuation"].reshape(-1, 3))


def test_the_map_is_a_frozen_copy_in_eval_mode():
    map = toy_map().train()
    transform = ActionMapTransform(map, CONTEXT_KEYS)
    transform.train()
    assert transform.training
    assert not any(module.training for module in transform.map.modules())
    assert not any(parameter.requires_grad for parameter in transform.parameters())
    assert map.training
    assert all(parameter.requires_grad for parameter in map.parameters())
    assert transform.map is not map


def test_keys_and_scale_default_to_the_maps_own(tmp_path):
    map = toy_map()
    map.context_keys = tuple(CONTEXT_KEYS)
    map.action_scale.fill_(SCALE)
    path = save_map(map, tmp_path / "map.safetensors")
    for transform in (ActionMapTransform(map), ActionMapTransform.from_file(path)):
        assert_mapped(TransformedEnv(ToyArm((2,)), transform).rollout(10))
    scaled = ActionMapTransform.from_file(path, action_scale=0.5)
    assert_mapped(TransformedEnv(ToyArm((2,)), scaled).rollout(10), scale=0.5)


@pytest.mark.parametrize("map", [SVD(3, 2), Identity(3)], ids=lambda map: type(map).__name__)
@pytest.mark.parametrize("keys", [None, ()])
def test_a_map_without_context_needs_no_snapshot(map, keys):
    env = TransformedEnv(ToyArm((3,)), ActionMapTransform(map, keys, action_scale=SCALE, saturation="clip"))
    check_env_specs(env)
    data = env.rollout(10)
    assert "context" not in env.observation_spec
    assert "context" not in data
    expected = map(SCALE * data["action"], data["joint"][..., :0]).clamp(-LIMIT, LIMIT)
    torch.testing.assert_close(data["next", "received"], expected)
    assert torch.equal(data["next", "actuation"], data["next", "received"])


@pytest.mark.parametrize("key", ["action", "motor", ("arm", "motor")])
@pytest.mark.parametrize("action_key", ["action", "latent", ("arm", "latent")])
@both_batch_sizes
def test_nested_and_differing_keys(rows, action_key, key):
    transform = ActionMapTransform(
        toy_map(),
        [("raw", "tool"), ("raw", "joint")],
        action_scale=SCALE,
        action_key=action_key,
        actuation_key=key,
        context_key=("map", "context"),
        executed_key=("map", "actuation"),
    )
    env = TransformedEnv(ToyArm(rows, key=key), transform)
    assert env.action_keys == [action_key]
    check_env_specs(env)
    data = env.rollout(20, break_when_any_done=False)
    for root in (data, data["next"]):
        root["context"], root["actuation"] = root["map", "context"], root["map", "actuation"]
    data["action"] = data[action_key]
    assert_mapped(data)


@both_batch_sizes
def test_dimensions_between_the_batchs_and_the_last(rows):
    transform = ActionMapTransform(
        NHT(3, 3, 2, hidden=(8,)),
        [("team", "joint")],
        saturation="clip",
        action_key=("team", "action"),
        actuation_key=("team", "motor"),
        context_key=("team", "context"),
        executed_key=("team", "actuation"),
    )
    env = TransformedEnv(ToyTeam(rows), transform)
    check_env_specs(env)
    team = env.rollout(3)["team"]
    assert team["action"].shape == (*rows, 3, 2, 2)
    expected = transform.map(team["action"], team["joint"]).clamp(-1, 1)
    torch.testing.assert_close(
        env.rollout(1)["next", "team", "actuation"].shape, torch.Size([*rows, 1, 2, 3])
    )
    torch.testing.assert_close(team["actuation"][..., 1:, :, :], expected[..., :-1, :, :])


@pytest.mark.parametrize("floats", [torch.float32, torch.float64])
@pytest.mark.parametrize("map_floats", [torch.float32, torch.float64])
def test_policies_see_the_maps_dtype_and_environments_their_own(floats, map_floats):
    map = toy_map(map_floats)
    env = TransformedEnv(
        ToyArm((3,), dtype=floats), ActionMapTransform(map, CONTEXT_KEYS, action_scale=SCALE)
    )
    check_env_specs(env)
    data = env.rollout(10)
    assert data["action"].dtype == data["context"].dtype == map_floats
    assert data["actuation"].dtype == data["next", "actuation"].dtype == floats
    assert_mapped(data, map)


def test_an_unbounded_action_spec_clips_nothing():
    env = TransformedEnv(ToyArm((3,), limit=None), toy_transform())
    check_env_specs(env)
    data = env.rollout(30, break_when_any_done=False)
    assert_mapped(data, limit=torch.inf)
    assert data["next", "actuation"].abs().max() > 1


def test_every_copy_has_its_own_bounds():
    arms = SerialEnv(2, [lambda: ToyArm(limit=0.1), lambda: ToyArm(limit=0.2)])
    data = TransformedEnv(arms, toy_transform()).rollout(30, break_when_any_done=False)
    assert_mapped(data[0], limit=0.1)
    assert_mapped(data[1], limit=0.2)


def test_without_environment_nothing_is_clipped():
    data = TensorDict({"action": torch.full((4, 2), 9.0), "context": torch.randn(4, 5)}, [4])
    assert toy_transform().inv(data)["action"].abs().max() > 5
    assert data["action"].shape == (4, 2)


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
def test_a_replay_buffer_of_demonstrations_gives_actions(storage):
    data = TensorDict(
        tool=torch.randn(20, 2), joint=torch.randn(20, 3), actuation=torch.randn(20, 3), batch_size=20
    )
    transform = toy_transform(actuation_key="actuation", forward_only=True)
    buffer = ReplayBuffer(storage=storage(20), transform=transform, batch_size=8)
    buffer.extend(data)
    assert torch.equal(buffer.storage[:]["actuation"], data["actuation"])
    assert "action" not in buffer.storage[:]
    sample = buffer.sample()
    context = torch.cat([sample[key] for key in CONTEXT_KEYS], -1)
    torch.testing.assert_close(sample["action"], transform.map.project(sample["actuation"], context) / SCALE)


def test_forward_gives_back_the_actions_of_collected_data():
    data = TransformedEnv(ToyArm((3,), limit=None), toy_transform()).rollout(20)
    back = ActionMapTransform(
        toy_map(),
        ["context"],
        action_scale=SCALE,
        actuation_key=("next", "actuation"),
        action_key="recovered",
        forward_only=True,
    )
    recovered = back(data)
    torch.testing.assert_close(recovered["recovered"], data["action"], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))])
def test_copies_and_pickles(copied):
    env = mapped_arm((3,))
    env.rollout(3)
    twin = copied(env)
    assert_mapped(twin.rollout(10))
    assert twin.transform.container is twin
    assert_mapped(TransformedEnv(ToyArm((2,)), copied(toy_transform())).rollout(10))
    assert_mapped(TransformedEnv(ToyArm((2,)), env.transform.clone()).rollout(10))
    assert_mapped(env.rollout(10))


def test_state_dict_holds_map_and_scale_whether_attached_or_not():
    other = ActionMapTransform(NHT(5, 3, 2, hidden=(8,), seed=1), CONTEXT_KEYS, saturation="clip")
    state = mapped_arm((3,)).state_dict()
    assert state.keys() == other.state_dict().keys()
    other.load_state_dict(state)
    assert_mapped(TransformedEnv(ToyArm((2,)), other).rollout(10))


@pytest.mark.parametrize("attached", [True, False])
@pytest.mark.parametrize("backend", ["eager", pytest.param("inductor", marks=pytest.mark.slow)])
def test_policy_and_transform_compile_as_one_graph(attached, backend):
    env = mapped_arm((3,))
    transform = env.transform if attached else toy_transform()
    policy = TensorDictModule(torch.nn.Linear(3, 2), in_keys=["joint"], out_keys=["action"])

    def act(tensordict):
        return transform.inv(policy(tensordict))

    data = env.reset().select("joint", "context")
    with torch.no_grad():
        compiled = torch.compile(act, fullgraph=True, backend=backend)(data.clone())
        torch.testing.assert_close(compiled["action"], act(data.clone())["action"], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize(
    "device",
    [
        "cpu",
        pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")),
    ],
)
def test_the_map_moves_to_the_environments_device(device):
    transform = ActionMapTransform(Identity(1, context_dim=3), ["observation"], action_scale=5.0)
    env = TransformedEnv(GymEnv("Pendulum-v1", device=device), transform)
    check_env_specs(env)
    data = env.rollout(5)
    assert {data[key].device.type for key in ("action", "context", "actuation")} == {device}
    assert torch.equal(data["next", "actuation"], (5 * data["action"]).clamp(-2, 2))
