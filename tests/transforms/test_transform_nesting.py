"""ActionMapTransform among other transforms, inside and over batched environments, in collectors, on Gymnasium."""

import copy
import pickle
from functools import partial

import gymnasium
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import AsyncCollector, Collector, MultiAsyncCollector, MultiSyncCollector
from torchrl.envs import (
    ActionScaling,
    CatTensors,
    Compose,
    DoubleToFloat,
    GymEnv,
    GymWrapper,
    ObservationNorm,
    ParallelEnv,
    RenameTransform,
    RewardSum,
    SerialEnv,
    StepCounter,
    TransformedEnv,
    VecNorm,
    VecNormV2,
    check_env_specs,
)

from nht import NHT, Identity
from nht.transforms import ActionMapTransform
from toy_envs import CONTEXT_KEYS, LIMIT, SCALE, ToyArm, assert_mapped, mapped_arm, toy_map, toy_transform

pytestmark = [
    pytest.mark.filterwarnings("ignore:Nested TransformedEnvs are automatically unwrapped:UserWarning"),
    pytest.mark.filterwarnings("ignore:Support of VecNormV2:UserWarning"),
    pytest.mark.filterwarnings("ignore:.*VecNorm:FutureWarning"),
]

OTHERS = {
    "ObservationNorm": lambda: ObservationNorm(loc=1.0, scale=3.0, in_keys=CONTEXT_KEYS),
    "VecNorm": lambda: VecNorm(in_keys=CONTEXT_KEYS),
    "VecNormV2": lambda: VecNormV2(in_keys=CONTEXT_KEYS),
    "CatTensors": lambda: CatTensors(CONTEXT_KEYS, "observation", del_keys=True),
    "DoubleToFloat": DoubleToFloat,
    "StepCounter": StepCounter,
    "RewardSum": RewardSum,
}
other_transforms = pytest.mark.parametrize("other", OTHERS.values(), ids=OTHERS)
both_batch_sizes = pytest.mark.parametrize("rows", [(), (3,)], ids=["single", "batched"])


def rollout(env):
    check_env_specs(env)
    return env.rollout(20, break_when_any_done=False)


@other_transforms
@both_batch_sizes
@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_the_map_sees_the_raw_context_in_any_order(other, rows, after):
    chain = [other(), toy_transform()] if after else [toy_transform(), other()]
    env = TransformedEnv(ToyArm(rows), Compose(*chain))
    data = rollout(env)
    assert_mapped(data)
    assert env.action_spec.shape == (*rows, 2)
    if isinstance(chain[not after], ObservationNorm | VecNorm | VecNormV2):
        assert not torch.isclose(data["joint"], data["raw", "joint"]).all()


@both_batch_sizes
def test_many_at_once(rows):
    before = [OTHERS[name]() for name in ("StepCounter", "ObservationNorm", "RewardSum")]
    after = [OTHERS[name]() for name in ("VecNormV2", "CatTensors")]
    assert_mapped(rollout(TransformedEnv(ToyArm(rows), Compose(*before, toy_transform(), *after))))


@pytest.mark.parametrize(
    "build",
    [
        lambda norm: TransformedEnv(ToyArm((3,)), Compose(norm, Compose(StepCounter(), toy_transform()))),
        lambda norm: TransformedEnv(ToyArm((3,)), Compose(Compose(norm), Compose(toy_transform()))),
        lambda norm: TransformedEnv(ToyArm((3,)), Compose(Compose(toy_transform()), norm)),
        lambda norm: TransformedEnv(ToyArm((3,)), norm).append_transform(toy_transform()),
        lambda norm: TransformedEnv(TransformedEnv(ToyArm((3,)), norm), toy_transform()),
        lambda norm: TransformedEnv(
            TransformedEnv(ToyArm((3,)), Compose(norm, toy_transform())), StepCounter()
        ),
        lambda norm: TransformedEnv(mapped_arm((3,)), norm),
        lambda norm: mapped_arm((3,)).append_transform(norm),
        lambda norm: TransformedEnv(mapped_arm((3,)), norm, auto_unwrap=False),
    ],
)
def test_nested_appended_and_unwrapped(build):
    env = build(OTHERS["ObservationNorm"]())
    assert_mapped(rollout(env))
    again = TransformedEnv(ToyArm((2,)), env.transform.clone())
    data = rollout(again)
    if "context" in again.observation_spec:
        assert_mapped(data)


def test_the_map_puts_nothing_into_the_chain():
    """Indices, names and saved states of the other transforms are those that they have without the map."""

    def chain(*last):
        norm = ObservationNorm(in_keys=["joint"])
        return Compose(norm, StepCounter(), ObservationNorm(loc=1.0, scale=2.0, in_keys=["tool"]), *last)

    plain = TransformedEnv(ToyArm((3,)), chain())
    mapped = TransformedEnv(ToyArm((3,)), chain(toy_transform(), StepCounter(step_count_key="late")))
    assert [type(one) for one in mapped.transform][:3] == [type(one) for one in plain.transform]
    assert [type(one) for one in mapped.transform][3:] == [ActionMapTransform, StepCounter]
    for env in (plain, mapped):
        env.transform[0].init_stats(20, reduce_dim=(0, 1), cat_dim=0)
    plain.transform[0].loc.fill_(7.0)
    plain.rollout(5)
    left = mapped.transform.load_state_dict(plain.transform.state_dict(), strict=False)
    assert not left.unexpected_keys
    assert all(key.startswith("transforms.3.") for key in left.missing_keys)
    assert (mapped.transform[0].loc == 7.0).all()
    assert_mapped(rollout(mapped))


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda thing: pickle.loads(pickle.dumps(thing))])
def test_copies_of_a_chain_read_the_raw_context_too(copied):
    env = TransformedEnv(ToyArm((3,)), Compose(OTHERS["ObservationNorm"](), toy_transform()))
    env.rollout(3)
    twin = copied(env)
    for one in (twin, env):
        assert_mapped(rollout(one))
        assert one.transform.container is one
    del env.transform[1]
    env.empty_cache()
    assert "context" not in env.rollout(3)
    assert_mapped(rollout(twin))


@pytest.mark.parametrize("first", [[], ["ObservationNorm"]])
def test_transforms_may_be_inserted_in_front_afterwards(first):
    env = TransformedEnv(ToyArm((3,)), Compose(*(OTHERS[name]() for name in first), toy_transform()))
    data = env.rollout(2)
    env.insert_transform(0, ObservationNorm(loc=1.0, scale=2.0, in_keys=CONTEXT_KEYS))
    after = env.step(env.rand_action(data[:, -1].clone()))["next"]  # before any spec is asked for
    env.insert_transform(0, ObservationNorm(loc=1.0, scale=2.0, in_keys=CONTEXT_KEYS))
    for observed in (after, env.reset()):
        assert torch.equal(observed["context"], torch.cat([observed["raw", key] for key in CONTEXT_KEYS], -1))
    assert_mapped(rollout(env))
    env.append_transform(OTHERS["VecNormV2"]())
    assert_mapped(rollout(env))
    alone = mapped_arm((3,))
    alone.insert_transform(0, OTHERS["CatTensors"]())
    assert_mapped(rollout(alone))


def test_a_context_that_another_transform_makes():
    double = [
        RenameTransform(["joint"], ["doubled"], create_copy=True),
        ObservationNorm(loc=0.0, scale=2.0, in_keys=["doubled"], out_keys=["made"], standard_normal=False),
    ]
    transform = ActionMapTransform(toy_map(), ["tool", "made"], action_scale=SCALE)
    env = TransformedEnv(ToyArm((3,)), Compose(*double, transform, OTHERS["ObservationNorm"]()))
    data = rollout(env)
    context = torch.cat([data["raw", "tool"], 2 * data["raw", "joint"]], -1)
    assert torch.equal(data["context"], context)
    expected = toy_map()(SCALE * data["action"], context).clamp(-LIMIT, LIMIT)
    torch.testing.assert_close(data["next", "actuation"], expected.detach(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_statistics_can_be_initialised_later(after):
    norm = ObservationNorm(in_keys=["joint"])
    chain = [norm, toy_transform()] if after else [toy_transform(), norm]
    env = TransformedEnv(ToyArm((3,)), Compose(*chain))
    norm.init_stats(20, reduce_dim=(0, 1), cat_dim=0)
    assert_mapped(rollout(env))


def test_with_scaled_actuations_the_record_is_of_what_was_executed():
    env = TransformedEnv(ToyArm((3,)), Compose(ActionScaling(), toy_transform()))
    data = rollout(env)
    assert torch.equal(data["next", "actuation"], data["next", "received"])
    expected = toy_map()(SCALE * data["action"], data["context"]).clamp(-1, 1) * LIMIT
    torch.testing.assert_close(data["next", "actuation"], expected, atol=1e-5, rtol=1e-5)


def test_two_maps_in_one_chain():
    """The second map's actuation is the first one's action: base environment 3, first map 2, second map 1."""
    outer = ActionMapTransform(
        NHT(3, 2, 1, hidden=(8,)),
        ["joint"],
        saturation="clip",
        context_key="joint_context",
        executed_key="inner",
    )
    env = TransformedEnv(ToyArm((3,)), Compose(toy_transform(), outer))
    data = rollout(env)
    assert data["action"].shape[-1] == 1
    inner_action = outer.map(data["action"], data["raw", "joint"]).clamp(-1, 1)
    assert_mapped(data.set("action", inner_action.detach()))


@pytest.mark.parametrize(
    "batched", [SerialEnv, partial(ParallelEnv, mp_start_method="fork")], ids=["serial", "parallel"]
)
@pytest.mark.parametrize("place", ["inside", "over", "inside, normalised outside"])
@both_batch_sizes
def test_inside_and_over_batched_environments(batched, place, rows):
    norm = OTHERS["ObservationNorm"]()
    if place == "over":
        env = TransformedEnv(batched(2, partial(ToyArm, rows)), Compose(norm, toy_transform()))
    else:
        env = batched(2, partial(mapped_arm, rows))
        env = TransformedEnv(env, norm) if place != "inside" else env
    try:
        assert env.action_spec.shape == (2, *rows, 2)
        assert_mapped(rollout(env))
    finally:
        env.close()


@pytest.mark.slow
@pytest.mark.parametrize("place", ["inside", "over"])
def test_parallel_environments_in_spawned_processes(place):
    make = mapped_arm if place == "inside" else ToyArm
    env = ParallelEnv(2, partial(make, (3,)), mp_start_method="spawn")
    try:
        assert_mapped(rollout(env if place == "inside" else TransformedEnv(env, toy_transform())))
    finally:
        env.close()


@pytest.mark.parametrize(
    "collector",
    [
        Collector,
        pytest.param(AsyncCollector, marks=pytest.mark.slow),
        pytest.param(MultiSyncCollector, marks=pytest.mark.slow),
        pytest.param(MultiAsyncCollector, marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("random", [False, True], ids=["policy", "random"])
@pytest.mark.timeout(120)
def test_collectors_keep_context_and_actuation(collector, random):
    linear = torch.nn.Sequential(torch.nn.Linear(3, 2), torch.nn.Tanh())
    policy = None if random else TensorDictModule(linear, in_keys=["joint"], out_keys=["action"])
    make = partial(mapped_arm, (3,))
    makers = [make, make] if collector in (MultiSyncCollector, MultiAsyncCollector) else make
    collected = collector(
        makers, policy, frames_per_batch=60, total_frames=300, auto_register_policy_transforms=False
    )
    frames = 0
    try:
        for batch in collected:
            assert_mapped(batch)
            assert batch["next", "actuation"].any()
            assert batch["next", "done"].any()
            frames += batch.numel()
    finally:
        collected.shutdown()
    assert frames == 300


@both_batch_sizes
def test_pendulum(rows):
    def make():
        return GymEnv("Pendulum-v1")

    transform = ActionMapTransform(Identity(1, context_dim=3), ["observation"], action_scale=5.0)
    env = TransformedEnv(SerialEnv(3, make) if rows else make(), transform)
    data = rollout(env)
    assert data["action"].shape == (*rows, 20, 1)
    assert torch.equal(data["context"], data["observation"])
    assert torch.equal(data["next", "actuation"], (5 * data["action"]).clamp(-2, 2))


@pytest.mark.parametrize("before", [[], [StepCounter]], ids=["alone", "after StepCounter"])
def test_gymnasiums_own_vector_environments(before):
    """They reset themselves; the context must be that of the reset row, as TorchRL puts it right."""
    vector = gymnasium.make_vec(
        "Pendulum-v1",
        num_envs=2,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": gymnasium.vector.AutoresetMode.SAME_STEP},
        max_episode_steps=5,
    )
    transform = ActionMapTransform(Identity(1, context_dim=3), ["observation"])
    env = TransformedEnv(GymWrapper(vector), Compose(*(make() for make in before), transform))
    data = rollout(env)
    assert data["next", "done"].sum() == 8
    for root in (data, data["next"]):
        assert torch.equal(root["context"], root["observation"])


@pytest.mark.parametrize("before", [[], [partial(VecNormV2, in_keys=["observation"]), DoubleToFloat]])
def test_half_cheetah(before, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its log to the working directory
    map = NHT(context_dim=17, actuation_dim=6, action_dim=2, hidden=(16,))
    transform = ActionMapTransform(map, ["observation"], action_scale=3.0, saturation="clip")
    env = TransformedEnv(GymEnv("HalfCheetah-v5"), Compose(*(make() for make in before), transform))
    env.set_seed(0)
    data = env.rollout(20)
    check_env_specs(env)
    assert data["action"].shape == (20, 2)
    with torch.no_grad():
        expected = map(3 * data["action"], data["context"]).clamp(-1, 1)
    torch.testing.assert_close(data["next", "actuation"], expected, atol=1e-5, rtol=1e-5)

    plain = GymEnv("HalfCheetah-v5")
    plain.set_seed(0)
    observed = plain.reset()
    for step in data.unbind(0):
        assert torch.equal(step["context"], observed["observation"].float())
        observed = plain.step(observed.set("action", step["next", "actuation"]))["next"]
    assert torch.equal(data["context"], data["observation"].float()) == (not before)
