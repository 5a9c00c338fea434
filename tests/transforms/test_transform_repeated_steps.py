"""Transforms that step the environment themselves, before or behind the map: what is executed, from values by hand."""

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.envs import (
    ActionScaling,
    Compose,
    ConditionalPolicySwitch,
    ConditionalSkip,
    FrameSkipTransform,
    MultiAction,
    NoopResetEnv,
    ObservationNorm,
    RewardSum,
    SerialEnv,
    StepCounter,
    Transform,
    TransformedEnv,
    VecNormV2,
    check_env_specs,
)

from nht import SVD, Identity
from nht.envs import make_env
from nht.transforms import ActionMapTransform
from toy_envs import CONTEXT_KEYS, LIMIT, SCALE, ToyArm, assert_mapped, toy_map, toy_transform

pytestmark = pytest.mark.filterwarnings("ignore:Support of VecNormV2:UserWarning")

FRAMES = 3


class StepsAgain(Transform):
    """A frame skip of one's own, which copies what it hands over."""

    def _step(self, tensordict, next_tensordict):
        for _ in range(FRAMES - 1):
            following = self.parent.step(tensordict.clone())["next"]
            next_tensordict = following.set("reward", following["reward"] + next_tensordict["reward"])
        return next_tensordict


def norm():
    return ObservationNorm(loc=1.0, scale=3.0, in_keys=CONTEXT_KEYS)


def skip():
    return FrameSkipTransform(FRAMES)


def context_of(observed):
    return torch.cat([observed["raw", key] for key in CONTEXT_KEYS], -1)


def actuation_of(action, observed, map=None, limit=LIMIT):
    with torch.no_grad():
        return (map or toy_map())(SCALE * action, context_of(observed)).clamp(-limit, limit)


CHAINS = {
    "before": lambda: [skip(), toy_transform()],
    "behind": lambda: [toy_transform(), skip()],
    "counted before": lambda: [StepCounter(), skip(), RewardSum(), toy_transform()],
    "counted behind": lambda: [RewardSum(), toy_transform(), StepCounter(), skip()],
    "normalised, before": lambda: [norm(), skip(), toy_transform()],
    "before, normalised": lambda: [skip(), norm(), toy_transform()],
    "normalised, behind": lambda: [norm(), toy_transform(), skip()],
    "nested before": lambda: [Compose(norm(), skip()), Compose(toy_transform())],
    "nested behind": lambda: [Compose(norm(), toy_transform()), skip()],
    "own, before": lambda: [StepsAgain(), toy_transform()],
    "own, behind": lambda: [toy_transform(), StepsAgain()],
    "own, behind a norm": lambda: [VecNormV2(in_keys=["joint"]), StepsAgain(), toy_transform()],
}


@pytest.mark.parametrize("chain", CHAINS.values(), ids=CHAINS)
@pytest.mark.parametrize("rows", [(), (3,)], ids=["single", "batched"])
def test_an_actuation_is_repeated(chain, rows):
    """Joints move by the actuation at every frame, and the reward is its first entry: three times as much of both."""
    env = TransformedEnv(ToyArm(rows), Compose(*chain()))
    observed = env.reset()
    for _ in range(2):
        before = observed.clone()
        observed["action"] = torch.rand(*rows, 2) * 2 - 1
        after = env.step(observed)["next"]
        actuation = actuation_of(observed["action"], before)
        torch.testing.assert_close(after["actuation"], actuation, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(
            after["raw", "joint"], before["raw", "joint"] + FRAMES * actuation, atol=1e-5, rtol=1e-5
        )
        torch.testing.assert_close(after["reward"], FRAMES * actuation[..., :1], atol=1e-5, rtol=1e-5)
        assert torch.equal(after["context"], context_of(after))
        assert not {key for key in set(after.keys()) if key.startswith("_")}
        observed = env.step_mdp(observed)


@pytest.mark.parametrize("chain", CHAINS.values(), ids=CHAINS)
def test_rollouts_with_repeated_actuations(chain):
    env = TransformedEnv(ToyArm((3,)), Compose(*chain()))
    check_env_specs(env)
    assert_mapped(env.rollout(10, break_when_any_done=False))


def test_over_batched_environments():
    for chain in (CHAINS["before"], CHAINS["behind"], CHAINS["normalised, before"]):
        assert_mapped(TransformedEnv(SerialEnv(2, ToyArm), Compose(*chain())).rollout(4))
        inside = SerialEnv(2, lambda chain=chain: TransformedEnv(ToyArm(), Compose(*chain())))
        assert_mapped(inside.rollout(4))


@pytest.mark.parametrize("order", ["before", "behind"])
def test_a_map_whose_action_is_as_wide_as_the_actuation(order):
    """Here no width would betray an actuation that is mapped again: 0.5 becomes 0.25, and three frames of it 0.75."""
    scaled = ActionMapTransform(Identity(3), action_scale=0.5)
    chain = [skip(), scaled] if order == "before" else [scaled, skip()]
    env = TransformedEnv(ToyArm((2,)), Compose(*chain))
    observed = env.reset()
    start = observed["joint"].clone()
    after = env.step(observed.set("action", torch.full((2, 3), 0.5)))["next"]
    torch.testing.assert_close(after["joint"], start + 0.75)
    torch.testing.assert_close(after["actuation"], torch.full((2, 3), 0.25))


def test_two_maps_and_a_scaling_are_repeated_as_one():
    outer = ActionMapTransform(
        SVD(2, 1), action_scale=0.5, context_key="outer context", executed_key="outer actuation"
    )
    env = TransformedEnv(ToyArm((2,)), Compose(ActionScaling(), toy_transform(), outer, skip()))
    observed = env.reset()
    before = observed.clone()
    after = env.step(observed.set("action", torch.full((2, 1), 0.8)))["next"]
    inner_action = torch.tensor([[0.4, 0.0]]).expand(2, 2)
    actuation = LIMIT * actuation_of(inner_action, before, limit=1.0)
    torch.testing.assert_close(after["actuation"], actuation, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(after["joint"], before["joint"] + FRAMES * actuation, atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("order", ["before", "behind"])
def test_half_cheetah_skips_frames_as_without_a_map(order):
    map = SVD(6, 2)
    mapped = ActionMapTransform(map, action_scale=0.7)
    chain = [skip(), mapped] if order == "before" else [mapped, skip()]
    env = TransformedEnv(make_env("half_cheetah", num_envs=2, seed=0), Compose(*chain))
    plain = TransformedEnv(make_env("half_cheetah", num_envs=2, seed=0), skip())
    observed, raw = env.reset(), plain.reset()
    for _ in range(5):
        action = torch.rand(2, 2) * 2 - 1
        observed = env.step(observed.set("action", action))["next"]
        raw = plain.step(raw.set("action", map(0.7 * action, action[:, :0])))["next"]
        for key in ("observation", "reward"):
            torch.testing.assert_close(observed[key], raw[key])


def test_a_sequence_of_actions_is_mapped_one_by_one():
    """MultiAction behind the map: each action with the context that the one before led to."""
    env = TransformedEnv(ToyArm((3,)), Compose(toy_transform(), MultiAction()))
    observed = env.reset()
    actions = torch.rand(3, 3, 2) * 2 - 1
    joint = observed["joint"].clone()
    after = env.step(observed.set("action", actions))["next"]
    for action in actions.unbind(1):
        raw = TensorDict(raw={"joint": joint, "tool": joint[:, :2].cos()})
        actuation = actuation_of(action, raw)
        joint = joint + actuation
    torch.testing.assert_close(after["joint"], joint, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(after["actuation"], actuation, atol=1e-5, rtol=1e-5)


def test_a_map_without_context_maps_a_sequence_of_actuations():
    map = SVD(3, 2)
    env = TransformedEnv(ToyArm((3,)), Compose(MultiAction(), ActionMapTransform(map, saturation="clip")))
    observed = env.reset()
    start = observed["joint"].clone()
    actions = torch.rand(3, 3, 2) * 2 - 1
    after = env.step(observed.set("action", actions))["next"]
    actuations = map(actions, actions[..., :0]).clamp(-LIMIT, LIMIT)
    torch.testing.assert_close(after["joint"], start + actuations.sum(1))
    torch.testing.assert_close(after["actuation"], actuations[:, -1])


@pytest.mark.parametrize("order", ["before", "behind", "normalised, before"])
def test_random_steps_at_a_reset(order):
    chains = {
        "before": [NoopResetEnv(3), toy_transform()],
        "behind": [toy_transform(), NoopResetEnv(3)],
        "normalised, before": [norm(), NoopResetEnv(3), toy_transform()],
    }
    env = TransformedEnv(ToyArm(), Compose(*chains[order]))
    for _ in range(5):
        data = env.rollout(3)
        for root in (data, data["next"]):
            assert torch.equal(root["context"], context_of(root))
        torch.testing.assert_close(
            data["next", "actuation"], actuation_of(data["action"], data), atol=1e-5, rtol=1e-5
        )


def test_another_policy_steps_in():
    """The switch asks its policy for a fresh action in the middle of a step: that is mapped, with the new context."""
    policy = TensorDictModule(lambda joint: torch.full_like(joint[..., :2], 0.3), ["joint"], ["action"])
    switch = ConditionalPolicySwitch(policy, condition=lambda data: data["step"].all())
    env = TransformedEnv(ToyArm(), Compose(toy_transform(), switch))
    observed = env.reset()
    joint = observed["joint"].clone()
    after = env.step(observed.set("action", torch.tensor([0.9, -0.2])))["next"]
    for action in (torch.tensor([0.9, -0.2]), torch.tensor([0.3, 0.3])):
        raw = TensorDict(raw={"joint": joint, "tool": joint[:2].cos()})
        actuation = actuation_of(action, raw)
        joint = joint + actuation
    torch.testing.assert_close(after["joint"], joint, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(after["actuation"], actuation, atol=1e-5, rtol=1e-5)


class MaskedArm(ToyArm):
    """Rows whose step is masked stand still, as TorchRL asks of environments that are locked to a batch size."""

    def _step(self, tensordict):
        mask = tensordict.get("_step", torch.ones(self.rows, dtype=torch.bool))
        before = self.joint.clone(), self.step_count
        after = super()._step(tensordict)
        self.joint = torch.where(mask[:, None], self.joint, before[0])
        self.step_count = torch.where(mask[:, None], self.step_count, before[1])
        return after.update(self._observe(torch.where(mask[:, None], after["received"], 0.0)))


@pytest.mark.parametrize("order", ["before", "behind"])
@pytest.mark.parametrize("rows", [[True, False, True], [False, False, False]])
def test_copies_whose_step_is_skipped_keep_the_actuation_of_their_last_step(order, rows):
    rows = torch.tensor(rows)
    skipping = ConditionalSkip(lambda data: ~rows & (data["step"].view(-1) == 1))
    chain = [skipping, toy_transform()] if order == "before" else [toy_transform(), skipping]
    env = TransformedEnv(MaskedArm((3,)), Compose(*chain))
    first = env.step(env.rand_action(env.reset()))["next"].exclude("reward")
    second = env.step(env.rand_action(first.clone()))["next"]
    for key in ("actuation", "context", "joint"):
        assert torch.equal(second[key][~rows], first[key][~rows])
        assert not torch.isclose(second[key][rows], first[key][rows]).all() or not rows.any()
