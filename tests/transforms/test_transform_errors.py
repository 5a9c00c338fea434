"""What ActionMapTransform refuses: at construction, or when it is attached, before any step is made."""

import re

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.data import Binary, Categorical, Composite, LazyTensorStorage, ReplayBuffer, Unbounded
from torchrl.envs import (
    Compose,
    MultiAction,
    ObservationNorm,
    RenameTransform,
    SerialEnv,
    StepCounter,
    TransformedEnv,
)

from nht import NHT, SVD, Identity
from nht.transforms import ActionMapTransform
from toy_envs import CONTEXT_KEYS, ToyArm, ToyTeam, assert_mapped, mapped_arm, nest, toy_map, toy_transform


def trained_on(*keys):
    map = toy_map()
    map.context_keys = keys
    return map


@pytest.mark.parametrize("scale", [0.0, -1.0, torch.inf, torch.nan])
def test_action_scale_must_be_positive_and_finite(scale):
    with pytest.raises(ValueError, match=f"action_scale must be a positive, finite number, got {scale}"):
        ActionMapTransform(toy_map(), CONTEXT_KEYS, action_scale=scale)
    map = toy_map()
    map.action_scale.fill_(scale)
    with pytest.raises(ValueError, match="action_scale"):
        ActionMapTransform(map, CONTEXT_KEYS)


@pytest.mark.parametrize(
    ("error", "message", "make"),
    [
        (
            TypeError,
            "map must be an nht.ActionMap, or the path of a map's file, got Linear.",
            lambda: ActionMapTransform(torch.nn.Linear(2, 3)),
        ),
        (ValueError, "context_keys must name .* context of 5", lambda: ActionMapTransform(toy_map())),
        (
            ValueError,
            r"context has 5 entries, got context_keys \[\]",
            lambda: ActionMapTransform(toy_map(), []),
        ),
        (ValueError, r"context has 0 entries, .*'joint'", lambda: ActionMapTransform(SVD(3, 2), ["joint"])),
        (
            ValueError,
            r"trained on context_keys \['joint', 'tool'\], in this order; got \['tool', 'joint'\]",
            lambda: ActionMapTransform(trained_on("joint", "tool"), ["tool", "joint"]),
        ),
        (
            ValueError,
            "context_key 'action' and executed_key 'actuation' must differ .* 'action'",
            lambda: toy_transform(context_key="action"),
        ),
        (ValueError, "must differ", lambda: toy_transform(context_key="same", executed_key="same")),
        (ValueError, "must differ", lambda: toy_transform(actuation_key="actuation")),
        (FileNotFoundError, "no map file", lambda: ActionMapTransform.from_file("nowhere.safetensors")),
        (FileNotFoundError, "no map file", lambda: ActionMapTransform("nowhere.safetensors")),
        (
            ValueError,
            "saturation must be one of scale, clip, got 'bend'",
            lambda: toy_transform(saturation="bend"),
        ),
    ],
)
def test_at_construction(error, message, make):
    with pytest.raises(error, match=message):
        make()


@pytest.mark.parametrize(
    ("error", "message", "transform"),
    [
        (
            KeyError,
            "no context key 'goal'; it has .*'joint', 'tool'.*'raw', 'joint'",
            lambda: ActionMapTransform(toy_map(), ["tool", "goal"]),
        ),
        (
            ValueError,
            "context has 5 entries, the context keys 6 ('joint': 3, 'received': 3)",
            lambda: ActionMapTransform(toy_map(), ["joint", "received"]),
        ),
        (
            ValueError,
            "drives 7 actuators, the environment's action 'action' has the shape (2, 3)",
            lambda: ActionMapTransform(NHT(5, 7, 2), CONTEXT_KEYS),
        ),
        (
            TypeError,
            "context key 'step' must be of floats, got torch.int64",
            lambda: ActionMapTransform(NHT(1, 3, 2), ["step"]),
        ),
        (KeyError, "no action 'motor'; it has ['action']", lambda: toy_transform(actuation_key="motor")),
        (ValueError, "there is another entry 'joint' already", lambda: toy_transform(context_key="joint")),
        (
            ValueError,
            "there is another entry 'received' already",
            lambda: toy_transform(executed_key="received"),
        ),
        (
            ValueError,
            "forward_only transform is for replay buffers",
            lambda: toy_transform(forward_only=True),
        ),
    ],
)
@pytest.mark.parametrize(
    "attach",
    [
        lambda transform: TransformedEnv(ToyArm((2,)), transform),
        lambda transform: TransformedEnv(SerialEnv(2, ToyArm), Compose(StepCounter(), Compose(transform))),
        lambda transform: TransformedEnv(ToyArm((2,))).append_transform(transform),
    ],
    ids=["alone", "nested", "appended"],
)
def test_when_attached(error, message, transform, attach):
    pattern = message if ".*" in message else re.escape(message)
    with pytest.raises(error, match=pattern):
        attach(transform())


def test_entries_must_have_the_dimensions_of_the_actuation():
    message = r"context key \('flat', 'joint'\) must have the shape \(4, 2, width\), .* got \(4, 3\)"
    env = ToyTeam((4,))
    env.observation_spec = Composite(env.observation_spec, flat=nest("joint", Unbounded((4, 3))), shape=(4,))
    transform = ActionMapTransform(NHT(3, 3, 2), [("flat", "joint")], actuation_key=("team", "motor"))
    with pytest.raises(ValueError, match=message):
        TransformedEnv(env, transform)


@pytest.mark.parametrize("spec", [Categorical(3), Binary(3)])
def test_actions_must_be_continuous(spec):
    env = ToyArm()
    env.action_spec = spec
    with pytest.raises(TypeError, match=f"'action' is not continuous: {type(spec).__name__}"):
        TransformedEnv(env, ActionMapTransform(Identity(3)))


@pytest.mark.parametrize("key", ["tool", "joint_2"])
def test_no_transform_rewrites_a_context_that_another_one_made(key):
    make = RenameTransform(["joint"], ["joint_2"], create_copy=True)
    rewrite = ObservationNorm(loc=0.0, scale=1.0, in_keys=[key])
    message = f"ObservationNorm rewrites context key '{key}': put the ActionMapTransform in front of it"
    with pytest.raises(ValueError, match=message):
        TransformedEnv(ToyArm(), Compose(make, rewrite, ActionMapTransform(toy_map(), ["tool", "joint_2"])))


def test_two_maps_need_different_keys():
    second = ActionMapTransform(NHT(5, 2, 1), CONTEXT_KEYS, executed_key="second")
    with pytest.raises(ValueError, match="there is another entry 'context' already"):
        TransformedEnv(ToyArm(), Compose(toy_transform(), second))


@pytest.mark.parametrize("width", [1, 3])
@pytest.mark.parametrize("batched", [False, True], ids=["alone", "in workers"])
def test_a_policy_of_another_width(width, batched):
    env = SerialEnv(2, mapped_arm) if batched else mapped_arm()
    policy = TensorDictModule(torch.nn.Linear(3, width), ["joint"], ["action"])
    message = rf"NHT takes an action of width 2, got one of shape \({width},\)\."
    with pytest.raises(ValueError, match=message):
        env.rollout(3, policy)


def recorded(**more):
    return TensorDict(
        action=torch.ones(4, 3), tool=torch.ones(4, 2), joint=torch.ones(4, 3), **more, batch_size=4
    )


@pytest.mark.parametrize(
    ("make", "data"),
    [
        (toy_transform, recorded()),
        (toy_transform, recorded(context=torch.ones(4, 5))),
        (lambda: ActionMapTransform(Identity(3)), recorded(next={"joint": torch.ones(4, 3)})),
        (lambda: mapped_arm((4,)).transform.clone(), mapped_arm((4,)).rollout(1)[:, 0]),
    ],
    ids=["no context", "no policy's action", "transitions", "a clone of an environment's"],
)
def test_a_replay_buffer_needs_a_transform_that_goes_forward_only(make, data):
    buffer = ReplayBuffer(storage=LazyTensorStorage(4))
    buffer.append_transform(make())
    with pytest.raises(ValueError, match=r"of a replay buffer, make a transform with forward_only=True\."):
        buffer.extend(data)


def test_without_an_environment_a_chain_maps_a_policys_action():
    data = TensorDict(action=torch.ones(4, 2), context=torch.ones(4, 5), batch_size=4)
    mapped = Compose(toy_transform()).inv(data)
    expected = toy_map()(1.5 * data["action"], data["context"])
    torch.testing.assert_close(mapped["action"], expected.detach())


def test_several_actuations_at_once_have_no_context():
    with pytest.raises(ValueError, match=r"one context for all of them: put MultiAction behind the Action"):
        TransformedEnv(ToyArm((2,)), Compose(MultiAction(), toy_transform()))


class Odd(Compose):
    """A Compose that does something else."""

    def _step(self, tensordict, next_tensordict):
        return super()._step(tensordict, next_tensordict)


def test_a_compose_of_ones_own_must_not_hide_the_map_behind_other_transforms():
    norm = ObservationNorm(loc=0.0, scale=1.0, in_keys=["joint"])
    with pytest.raises(ValueError, match="in a Compose with a _step or _reset of its own"):
        TransformedEnv(ToyArm(), Odd(norm, toy_transform()))
    assert_mapped(TransformedEnv(ToyArm(), Odd(toy_transform(), norm.clone())).rollout(3))


def test_a_step_needs_the_context_and_the_action():
    env = mapped_arm()
    data = env.rand_action(env.reset())
    with pytest.raises(KeyError, match="no 'context' beside the action"):
        env.step(data.select("action"))
    with pytest.raises(KeyError, match="action"):
        env.step(data.exclude("action"))
