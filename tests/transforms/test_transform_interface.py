"""What an action means is the map's alone: scale, saturation, context keys; maps from files; states saved earlier."""

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Bounded
from torchrl.envs import Compose, ObservationNorm, TransformedEnv, check_env_specs

from nht import NHT, SCL, SVD, Demos, save_map
from nht.transforms import ActionMapTransform
from toy_envs import CONTEXT_KEYS, LIMIT, SCALE, ToyArm, ToyTeam, assert_mapped, toy_map, toy_transform


def saturated(kind):
    map = toy_map()
    map.context_keys = tuple(CONTEXT_KEYS)
    map.set_action_scale(4.0)
    map.saturation = kind
    return map


def executed(transform, rows=(50,)):
    env = TransformedEnv(ToyArm(rows), transform)
    check_env_specs(env)
    torch.manual_seed(0)
    return env.rollout(5, break_when_any_done=False)


@pytest.mark.parametrize("kind", ["clip", "scale"])
def test_the_maps_own_scale_and_saturation_hold(kind, tmp_path):
    map = saturated(kind)
    path = save_map(map, tmp_path / "map.safetensors")
    plain = toy_map()
    transforms = [
        ActionMapTransform(map),
        ActionMapTransform(path),
        ActionMapTransform(str(path)),
        ActionMapTransform.from_file(path),
        ActionMapTransform(plain, CONTEXT_KEYS, action_scale=4.0, saturation=kind),
        ActionMapTransform(plain, [*CONTEXT_KEYS], action_scale=torch.tensor(4.0), saturation=kind),
    ]
    limit = torch.full((3,), LIMIT)
    for transform in transforms:
        data = executed(transform)
        expected = map.decode(data["action"], data["context"], -limit, limit).detach()
        torch.testing.assert_close(data["next", "actuation"], expected)
        assert torch.equal(data["next", "actuation"], data["next", "received"])
        assert transform.action_scale == 4.0
    assert plain.action_scale == 1.0  # what is laid over is laid over a copy
    within = data["next", "actuation"].abs().amax() <= LIMIT
    assert within


def test_scaled_actuations_stay_in_the_span_of_the_map():
    """With "scale" the residual of the actuation outside Q(c) is zero up to rounding, with "clip" it is not."""
    residuals = {}
    for kind in ("clip", "scale"):
        data = executed(ActionMapTransform(saturated(kind)))
        map, actuation, context = toy_map(), data["next", "actuation"], data["context"]
        with torch.no_grad():
            spanned = map(map.project(actuation, context), context)
        residuals[kind] = (actuation - spanned).abs().max()
    assert residuals["scale"] < 1e-6 < 0.1 < residuals["clip"]


def test_the_map_in_the_transform_is_the_only_owner_of_the_scale():
    transform = toy_transform()
    with pytest.raises(AttributeError):
        transform.action_scale = 3.0
    transform.map.set_action_scale(0.5)
    assert transform.action_scale == 0.5
    assert_mapped(executed(transform), scale=0.5)
    back = toy_transform(actuation_key="actuation", forward_only=True)
    back.map.set_action_scale(0.5)
    data = TensorDict(actuation=torch.rand(4, 3), tool=torch.rand(4, 2), joint=torch.rand(4, 3), batch_size=4)
    context = torch.cat([data[key] for key in CONTEXT_KEYS], -1)
    torch.testing.assert_close(back(data)["action"], back.map.project(data["actuation"], context) / 0.5)


def test_every_agent_is_scaled_by_itself():
    transform = ActionMapTransform(
        SVD(3, 2),
        action_scale=3.0,
        saturation="scale",
        action_key=("team", "motor"),
        actuation_key=("team", "motor"),
        executed_key=("team", "actuation"),
    )
    env = TransformedEnv(ToyTeam((4,)), transform)
    observed = env.rand_action(env.reset())
    action = 3 * observed["team", "motor"]
    after = env.step(observed)["next", "team", "actuation"]
    shrunk = action / action.abs().amax(-1, keepdim=True).clamp_min(1.0)
    torch.testing.assert_close(after[..., :2], shrunk)
    assert not after[..., 2].any()


def test_states_saved_when_the_transform_had_a_scale_of_its_own():
    """The scale stood beside the map and held instead of the map's: there were both."""
    old = {f"map.{key}": value for key, value in saturated("clip").state_dict().items()}
    old["action_scale"] = torch.tensor(SCALE)
    other = NHT(5, 3, 2, hidden=(8,), seed=1)
    for state, target in (
        (
            old,
            TransformedEnv(ToyArm((3,)), ActionMapTransform(other, CONTEXT_KEYS, saturation="clip")),
        ),
        (
            {f"transforms.1.{key}": value for key, value in old.items()},
            TransformedEnv(
                ToyArm((3,)),
                Compose(
                    ObservationNorm(loc=0.0, scale=1.0, in_keys=["joint"]),
                    ActionMapTransform(other, CONTEXT_KEYS, saturation="clip"),
                ),
            ),
        ),
    ):
        left = target.transform.load_state_dict(state, strict=False)
        assert not left.unexpected_keys
        assert_mapped(target.rollout(5))
        assert "action_scale" not in target.state_dict()


@pytest.mark.parametrize("floats", [torch.float16, torch.bfloat16])
@pytest.mark.parametrize("env_floats", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("make", [NHT, SCL, SVD])
@pytest.mark.parametrize("saturation", ["clip", "scale"])
def test_maps_of_half_precision(floats, env_floats, make, saturation):
    map = SVD(3, 2, context_dim=5) if make is SVD else make(5, 3, 2, hidden=(8,))
    transform = ActionMapTransform(map.to(floats), CONTEXT_KEYS, action_scale=2.0, saturation=saturation)
    env = TransformedEnv(ToyArm((3,), dtype=env_floats), transform)
    check_env_specs(env)
    assert env.action_spec == Bounded(-1, 1, (3, 2), dtype=floats)
    data = env.rollout(4)
    assert data["context"].dtype == floats
    assert data["next", "actuation"].dtype == env_floats
    assert torch.equal(data["next", "actuation"], data["next", "received"])
    assert data["next", "actuation"].abs().max() <= LIMIT  # not beyond it by rounding to fewer digits
    exact = transform.map.double().decode(
        data["action"],
        data["context"],
        *(sign * torch.full((3,), LIMIT, dtype=torch.float64) for sign in (-1, 1)),
    )
    torch.testing.assert_close(data["next", "actuation"].double(), exact, atol=0.05, rtol=0.05)


def test_keys_as_json_has_them():
    """Lists stand for nested keys, as neither JSON nor YAML has tuples."""
    nested = ActionMapTransform(toy_map(), [["raw", "tool"], ["raw", "joint"]], action_scale=SCALE)
    assert nested.context_keys == [("raw", "tool"), ("raw", "joint")]
    assert_mapped(executed(nested))


def test_demonstrations_of_a_rollout_through_the_map():
    """The executed actuation stands under "next"; at the root, that of the step before is refused."""
    data = TransformedEnv(ToyArm((3,)), toy_transform()).rollout(30, break_when_any_done=False)
    right = Demos.from_tensordict(data, actuation_key=("next", "actuation"), context=["context", "joint"])
    assert len(right.actuation) > 60
    expected = toy_map()(SCALE * data["action"], data["context"]).clamp(-LIMIT, LIMIT).detach()
    torch.testing.assert_close(right.actuation[:4], expected[0, :4], atol=1e-5, rtol=1e-5)
    message = r"'actuation' also stands under 'next': .* actuation_key=\('next', 'actuation'\)\."
    with pytest.raises(ValueError, match=message):
        Demos.from_tensordict(data, actuation_key="actuation", context=["context"])


def test_no_action_executes_the_maps_rest():
    map = SVD(3, 2, offset="constant")
    rest = torch.tensor([0.5, -0.2, 0.1])
    map.fit(TensorDict(actuation=rest + 0.01 * torch.randn(50, 3), context=torch.empty(50, 0), batch_size=50))
    env = TransformedEnv(ToyArm((2,)), ActionMapTransform(map, action_scale=9.0, saturation="scale"))
    observed = env.reset()
    after = env.step(observed.set("action", torch.zeros(2, 2)))["next"]
    torch.testing.assert_close(after["actuation"], map.rest(torch.empty(2, 0)))
    torch.testing.assert_close(after["actuation"], rest.expand(2, 3), atol=0.02, rtol=0.0)
